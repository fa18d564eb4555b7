"""Watchdog process of a Go2: damps the motors if the supervisor dies or hangs.

What a Go2 does when commands stop has not been measured; it may hold the last one. This second process therefore waits
for the supervisor's heartbeat. Its own DDS participant and writer exist before the motors are armed. It also asks the
robot which controller is active, and answers each heartbeat with the controller's name.
"""

from __future__ import annotations

import select
import sys
import time

from surefoot.deploy.dds import services, types
from surefoot.deploy.dds.bus import LOW_COMMAND_TOPIC, Bus
from surefoot.deploy.dds.low_level import STATE_PERIOD
from surefoot.deploy.dds.processes import LinkConfig, await_readers, serve
from surefoot.deploy.dds.socket_port import SocketPort
from surefoot.deploy.dds.supervisor import ACTIVE, DONE, damping_frame
from surefoot.deploy.robot_link import LinkLostError

HEARTBEAT_TIMEOUT, MIN_POLLS = 0.020, 2
"""Time without a heartbeat after which the motors are damped, if commands were being written [s], and how often this
process must have polled in that time: if all processes of the computer were stopped, the supervisor has not hung."""
DAMPING_TIME = 3.0
"""Time for which damping commands are sent, at 500 Hz [s]."""
_REQUEST_PERIOD, _RESPONSE_PERIOD = 0.5, 0.02
"""Periods of requests for the active controller, and of reading their responses [s]."""


class Watchdog:
    """Waits for the supervisor's heartbeat, and damps the motors if it stops."""

    def __init__(self, bus: Bus, supervisor: SocketPort) -> None:
        self.writer = bus.writer(LOW_COMMAND_TOPIC, types.LowCmd)
        self._supervisor, self._frame = supervisor, damping_frame()
        self._client = services.Client(bus, services.MOTION_SWITCHER)
        self._answer = b"\n"
        """Answer to each heartbeat: the name of the active controller, and a line break."""

    def run(self) -> None:
        """Run until the supervisor exits normally, or until it has failed and the motors have been damped."""
        last, next_response, next_request, silent_polls = ACTIVE[:0], 0.0, 0.0, 0
        while last != DONE and silent_polls < MIN_POLLS:
            readable = select.select([self._supervisor], (), (), HEARTBEAT_TIMEOUT / MIN_POLLS)[0]
            try:
                if readable and (data := self._supervisor.read()):
                    last, silent_polls = data[-1:], 0
                    self._supervisor.write(self._answer)
                elif last == ACTIVE:
                    silent_polls += 1
            except LinkLostError:
                break
            now = time.monotonic()
            if now >= next_response:
                next_response = now + _RESPONSE_PERIOD
                for code, answer in self._client.responses().values():
                    if not code:
                        self._answer = f"{services.mode_name(answer)}\n".encode()
            if now >= next_request:
                next_request = now + _REQUEST_PERIOD
                self._client.send(services.CHECK_MODE)
        if last == ACTIVE:
            self._damp()

    def _damp(self) -> None:
        self.writer.write(self._frame)
        self._supervisor.close()  # a supervisor that still runs detects this and damps as well
        end = time.monotonic() + DAMPING_TIME
        while time.monotonic() < end:
            self.writer.write(self._frame)
            time.sleep(STATE_PERIOD)


def main() -> int:
    """Run the watchdog process."""

    def prepare(config: LinkConfig, bus: Bus, ports: list[SocketPort]) -> Watchdog:
        watchdog = Watchdog(bus, *ports)
        await_readers(watchdog.writer)
        return watchdog

    return serve(prepare)


if __name__ == "__main__":
    sys.exit(main())
