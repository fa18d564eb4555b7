"""DDS topics of an emulated Go2: it writes states and reads commands."""

from __future__ import annotations

import time
from collections import deque

from surefoot.deploy.dds import types
from surefoot.deploy.dds.bus import LOW_COMMAND_TOPIC, LOW_STATE_TOPIC, Bus
from surefoot.deploy.dds.low_level import LOW_COMMAND, BadMessageError, Record, decode, encode

_QUEUE_DEPTH = 16
"""Maximum number of commands between two servo steps; the robot follows the newest."""


class LowLevelLink:
    """Topics rt/lowstate and rt/lowcmd of a robot; a `Transport`. It sends only on request."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus  # its topics end with it
        self._states = bus.writer(LOW_STATE_TOPIC, types.LowState)
        self._commands = bus.reader(LOW_COMMAND_TOPIC, types.LowCmd, _QUEUE_DEPTH, others=True)
        self._own = bus.writer(LOW_COMMAND_TOPIC, types.LowCmd)
        self._outbound: deque[tuple[float, bytes]] = deque()
        self.inbound: list[Record] = []
        """Received undamaged commands of other programs, oldest first."""
        self.sent = self.received = self.damaged = 0
        """Number of states sent; of commands received, including damaged ones; and of commands with a wrong length or
        checksum."""
        self.unplugged = False
        """Whether the cable is pulled, so that no message is transmitted."""

    def counts(self) -> list[str]:
        """Return statistics of the link, for the summary."""
        return [f"states sent {self.sent}", f"commands received {self.received}, damaged {self.damaged}"]

    @property
    def next_departure(self) -> float:
        """Time at which the next state is sent [us]; infinite if none is queued."""
        return self._outbound[0][0] if self._outbound else float("inf")

    def send(self, at: float, data: bytes) -> None:
        """Queue an encoded state, to be sent at time `at` [us]."""
        self._outbound.append((at, data))

    def publish_command(self, command: Record) -> None:
        """Publish a command of the robot's own controller on rt/lowcmd."""
        if not self.unplugged:
            self._own.write(encode(command))

    def poll(self, now: int) -> None:
        """Read the commands that have arrived."""
        for data in self._commands.take(_QUEUE_DEPTH):
            self.received += 1
            try:
                command = decode(LOW_COMMAND, data)
            except BadMessageError:
                self.damaged += 1  # a robot does not report them
            else:
                if not self.unplugged:
                    self.inbound.append(command)

    def flush(self, now: int) -> None:
        """Publish the states that are due by now."""
        while self._outbound and self._outbound[0][0] <= now:
            _, data = self._outbound.popleft()
            if not self.unplugged:
                self._states.write(data)
                self.sent += 1

    def wait(self, timeout: float) -> bool:
        """Sleep for `timeout` [s]; commands apply from the next servo step on, so none needs to wake the loop."""
        time.sleep(max(timeout, 0.0))
        return True
