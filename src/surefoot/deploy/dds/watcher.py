"""The watcher: damps the motors of a Go2 when the keeper dies or hangs, and asks which controller is active.

Nobody has measured what a Go2 does when commands stop; it may hold the last one. So a second process, with a
participant and a writer of its own that are made before the motors are armed, waits for the keeper's heartbeat.
"""

from __future__ import annotations

import select
import sys
import time

from surefoot.deploy.dds import services, types
from surefoot.deploy.dds.bus import LOW_COMMAND_TOPIC, Bus
from surefoot.deploy.dds.supervisor import ACTIVE, DONE, damping_frame
from surefoot.deploy.dds.low_level import STATE_PERIOD
from surefoot.deploy.dds.processes import LinkConfig, await_readers, serve
from surefoot.deploy.dds.socket_port import SocketPort
from surefoot.deploy.robot_link import LinkLostError

SILENCE, VISUALS_FILE = 0.020, 2
"""Silence of a keeper that writes commands [s] after which this process damps the motors, and how often it must have
looked meanwhile: if all processes of the computer stood still, the keeper has not hung."""
DAMPED = 3.0
"""Time [s] for which it does so, at 500 Hz."""
_CHECK_EVERY, _LOOK_EVERY = 0.5, 0.02
"""Time [s] between two questions for the active controller, and between two looks for the answer."""


class Watcher:
    """The keeper's heartbeat on one side, a writer of commands on the other."""

    def __init__(self, bus: Bus, supervisor: SocketPort) -> None:
        self.writer = bus.writer(LOW_COMMAND_TOPIC, types.LowCmd)
        self._keeper, self._frame = supervisor, damping_frame()
        self._client = services.Client(bus, services.MOTION_SWITCHER)
        self._answer = b"\n"
        """To each of the keeper's beats: the name of the active controller."""

    def run(self) -> None:
        """Run until the keeper says goodbye, or until the motors have been damped after it has stopped."""
        last, look, check, silent = ACTIVE[:0], 0.0, 0.0, 0
        while last != DONE and silent < VISUALS_FILE:
            heard = select.select([self._keeper], (), (), SILENCE / VISUALS_FILE)[0]
            try:
                if heard and (data := self._keeper.read()):
                    last, silent = data[-1:], 0
                    self._keeper.write(self._answer)
                elif last == ACTIVE:
                    silent += 1
            except LinkLostError:
                break
            now = time.monotonic()
            if now >= look:
                look = now + _LOOK_EVERY
                for code, answer in self._client.responses().values():
                    if not code:
                        self._answer = f"{services.mode_name(answer)}\n".encode()
            if now >= check:
                check = now + _CHECK_EVERY
                self._client.send(services.CHECK_MODE)
        if last == ACTIVE:
            self._damp()

    def _damp(self) -> None:
        self.writer.write(self._frame)
        self._keeper.close()  # if the keeper goes on, it sees this and damps too
        end = time.monotonic() + DAMPED
        while time.monotonic() < end:
            self.writer.write(self._frame)
            time.sleep(STATE_PERIOD)


def main() -> int:
    """Run the watcher's process."""

    def prepare(config: LinkConfig, bus: Bus, ports: list[SocketPort]) -> Watcher:
        watcher = Watcher(bus, *ports)
        await_readers(watcher.writer)
        return watcher

    return serve(prepare)


if __name__ == "__main__":
    sys.exit(main())
