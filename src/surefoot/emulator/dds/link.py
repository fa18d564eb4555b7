"""The emulated Go2's end of its topics: states out, commands in."""

from __future__ import annotations

import time
from collections import deque

from surefoot.deploy.dds import types
from surefoot.deploy.dds.bus import LOW_COMMAND_TOPIC, LOW_STATE_TOPIC, Bus
from surefoot.deploy.dds.low_level import LOW_COMMAND, BadMessageError, Record, decode, encode

_DEPTH = 16
"""Commands that are kept between two servo steps; a robot obeys the newest."""


class LowLevelLink:
    """rt/lowstate and rt/lowcmd of a robot; a `Transport`. It sends nothing of its own accord."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus  # its topics end with it
        self._states = bus.writer(LOW_STATE_TOPIC, types.LowState)
        self._commands = bus.reader(LOW_COMMAND_TOPIC, types.LowCmd, _DEPTH, others=True)
        self._own = bus.writer(LOW_COMMAND_TOPIC, types.LowCmd)
        self._outbound: deque[tuple[float, bytes]] = deque()
        self.inbound: list[Record] = []
        """Commands of others that have arrived and are undamaged, oldest first."""
        self.sent = self.received = self.damaged = 0
        """States sent; commands received, damaged ones included; commands with a wrong length or checksum."""
        self.dead = False
        """The cable is pulled: nothing comes or goes."""

    def counts(self) -> list[str]:
        """Return what came and went, for a line at the end."""
        return [f"states sent {self.sent}", f"commands received {self.received}, damaged {self.damaged}"]

    @property
    def next_departure(self) -> float:
        """When the next state leaves [us]; infinite if none waits."""
        return self._outbound[0][0] if self._outbound else float("inf")

    def send(self, at: float, data: bytes) -> None:
        """Put a state's bytes on its way, to arrive at a time [us]."""
        self._outbound.append((at, data))

    def publish_command(self, command: Record) -> None:
        """Publish a command of the robot's own on rt/lowcmd."""
        if not self.dead:
            self._own.write(encode(command))

    def poll(self, now: int) -> None:
        """Take the commands that have arrived."""
        for data in self._commands.take(_DEPTH):
            self.received += 1
            try:
                command = decode(LOW_COMMAND, data)
            except BadMessageError:
                self.damaged += 1  # the robot says nothing
            else:
                if not self.dead:
                    self.inbound.append(command)

    def flush(self, now: int) -> None:
        """Publish the states that leave by now."""
        while self._outbound and self._outbound[0][0] <= now:
            _, data = self._outbound.popleft()
            if not self.dead:
                self._states.write(data)
                self.sent += 1

    def wait(self, timeout: float) -> bool:
        """Sleep for `timeout` [s]: a command acts from the next servo step on, whenever it arrives before."""
        time.sleep(max(timeout, 0.0))
        return True
