"""The keeper: the board of a Go2 behind DDS, as a process beside the control loop.

It takes the loop's messages from a socket and the robot's states from rt/lowstate, and writes rt/lowcmd at 500 Hz from
the first arming until the loop is gone. Then it damps the motors for `DAMPED`, and ends. A watcher process damps them
when the keeper itself stops.
"""

from __future__ import annotations

import contextlib
import math
import select
import sys
import time
from functools import partial
from typing import Any

from surefoot.arrays import Array
from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.board.host_frames import HostFrames
from surefoot.deploy.board.signals import Hazard, MotorCommand, Sensors, microseconds
from surefoot.deploy.dds import types
from surefoot.deploy.dds.bus import LOW_COMMAND_TOPIC, LOW_STATE_TOPIC, SPORT_STATE_TOPIC, Bus, RawReader
from surefoot.deploy.dds.low_level import LOW_STATE, STATE_PERIOD, BadMessageError, decode, encode, new_command
from surefoot.deploy.dds.processes import LinkConfig, await_readers, serve
from surefoot.deploy.dds.socket_port import SocketPort
from surefoot.deploy.dds.state_monitor import MOTORS, SHOWN, StateMonitor
from surefoot.deploy.messages import Mode, Reason
from surefoot.deploy.robot_link import LISTEN_TIME, LinkLostError

PERIOD = round(STATE_PERIOD * 1e6)
"""Time [us] between two commands to the robot."""
DAMPING = 3.0
"""Gain [N m s/rad] of damped motors, as in the vendor's programs."""
DAMPED = 500_000
"""Time [us] for which the keeper damps the motors after the loop has gone."""
IDLE, ACTIVE, DONE = b"\0", b"\1", b"\2"
"""What the keeper tells the watcher: no command was written yet; commands are written; the end."""
_REMEMBERED = {Reason.OTHER_PROGRAM: microseconds(LISTEN_TIME)}
"""Time [us] for which a message keeps the robot from arming, where that is not `SHOWN`: a program that commands rarely
goes on."""
_BEAT_EVERY = 2
"""Cycles between two of these."""
WATCHDOG_SILENCE = 100_000
"""Time [us] of this process's own work without an answer of the watcher, after which that counts as gone. After 30 ms
a robot was damped because other programs with real-time priority held the watcher up."""
_FIRST_STATE = 100
"""Time [ms] within which a state must come, so that time is the robot's."""
_EVERY = 5
"""Cycles between two looks for messages that should never come."""


def damping_frame() -> bytes:
    """Return a command that damps all motors."""
    command = new_command()
    motors = command["motor_cmd"][:MOTORS]
    motors["dq"], motors["kd"] = 0.0, DAMPING
    return encode(command)


def position_frame(target: Array, kp: Array, kd: Array) -> bytes:
    """Return a command that holds motor angles (12,) [rad] with gains (12,) [N m/rad, N m s/rad]."""
    command = new_command()
    motors = command["motor_cmd"][:MOTORS]
    motors["q"], motors["dq"], motors["kp"], motors["kd"] = target, 0.0, kp, kd
    return encode(command)


class Supervisor:
    """The board's program between the loop's socket and the robot's topics.

    Args:
        config: the robot's handshake and limits.
        bus: where the robot is.
        host: the loop's socket.
        watcher: the watcher's socket.
    """

    def __init__(self, config: LinkConfig, bus: Bus, host: SocketPort, watcher: SocketPort) -> None:
        self.firmware = Firmware(config.handshake, config.limits)
        self.states = StateMonitor()
        self._gains = config.handshake.servo_kp, config.handshake.servo_kd
        self._host, self._frames = host, HostFrames(MOTORS)
        self._watcher, self._unanswered = watcher, 0
        self._watcher_text = ""
        self._state_reader = bus.reader(LOW_STATE_TOPIC, types.LowState, 4)
        # The robot's own controller also commands the motors: it is named first.
        self._strangers: tuple[tuple[RawReader[Any], Hazard], ...] = (
            (
                bus.reader(SPORT_STATE_TOPIC, types.SportModeState),
                (Reason.OWN_CONTROLLER, "the robot's own controller is active: messages on rt/sportmodestate"),
            ),
            (
                bus.reader(LOW_COMMAND_TOPIC, types.LowCmd, others=True),
                (Reason.OTHER_PROGRAM, "another program commands the motors, on rt/lowcmd"),
            ),
        )
        self.writer = bus.writer(LOW_COMMAND_TOPIC, types.LowCmd)
        self._damping = self._frame = damping_frame()
        self._order: MotorCommand | None = None
        self._exchanged = -math.inf
        """When beats were exchanged last [us]."""
        self._seen = [-math.inf] * len(self._strangers)
        self._stranger: Hazard | None = None
        self._controller = ""
        self._cycles = 0
        self._ends: float = math.inf
        self._active = False

    def run(self) -> None:
        """Run until the loop is gone and the motors have been damped.

        Time is that of the robot's tick when this begins, and then passes by this computer's clock: a recording of the
        robot by others, such as motion capture, has its ticks.
        """
        start = time.monotonic_ns() - 1000 * self._robot_time()
        due = now = (time.monotonic_ns() - start) // 1000
        while now < self._ends:
            going = self._ends == math.inf
            pause = (min(due, self.firmware.next_state) if going else due) - now
            heard = select.select([self._host] if going else (), (), (), pause / 1e6 if pause > 0 else 0)[0]
            now = (time.monotonic_ns() - start) // 1000
            if heard:
                self._hear_host(now)
            if now >= due:
                self._cycle(now)
                # A cycle that comes late is not made up for: the robot takes the last command anyway.
                due = due + PERIOD if now - due < PERIOD else now + PERIOD
            if self._ends == math.inf:
                self._answer(now)
        with contextlib.suppress(LinkLostError):
            self._watcher.write(DONE)

    def _robot_time(self) -> int:
        """Return the robot's time [us], by the next state that comes; 0, if none does within a moment."""
        self._state_reader.take()
        for _ in range(_FIRST_STATE):
            time.sleep(0.001)
            for data in self._state_reader.take():
                with contextlib.suppress(BadMessageError):
                    return 1000 * int(decode(LOW_STATE, data)["tick"])
        return 0

    def _hear_host(self, now: int) -> None:
        try:
            if data := self._host.read():
                self._frames.receive(now, data, self.firmware)
        except LinkLostError:
            self._end(now)

    def _end(self, now: int) -> None:
        """Damp from now on: the loop has gone, in good order or not."""
        self._host.close()
        self._ends = now + DAMPED if self._active else now

    def _exchange_beats(self) -> None:
        """Take the watcher's answers, and tell it that this process goes on."""
        try:
            if data := self._watcher.read():
                self._unanswered = 0
                *lines, self._watcher_text = (self._watcher_text + data.decode(errors="replace")).split("\n")
                if lines:
                    self._controller = lines[-1]
            self._watcher.write(ACTIVE if self._active else IDLE)
            # Beats are counted, not time: if all processes of the computer stood still, the watcher has not hung.
            self._unanswered += 1
        except LinkLostError:
            self._watcher.close()

    def _outside(self, now: int) -> Hazard | None:
        """Return what beside the robot's states must stop the motors."""
        if not self._watcher.is_open or self._unanswered * _BEAT_EVERY * PERIOD > WATCHDOG_SILENCE:
            return Reason.WATCHER, "the watcher process has ended or hangs"
        if self._controller:
            return Reason.OWN_CONTROLLER, f"the robot's own controller '{self._controller}' is active"
        if self._cycles % _EVERY == 0:
            for k, (reader, hazard) in enumerate(self._strangers):
                if reader.take():
                    self._seen[k] = now
                    if not self.firmware.armed and self.firmware.owner:
                        self.firmware.announce(now, hazard)
            seen = zip(self._seen, self._strangers, strict=True)
            shown = (hazard for at, (_, hazard) in seen if now - at < _REMEMBERED.get(hazard[0], SHOWN))
            self._stranger = next(shown, None)
        return self._stranger

    def _cycle(self, now: int) -> None:
        """Take the robot's newest state, and write the motors' order."""
        # By time: a process that was stopped must learn first of all that the watcher damps the motors by now.
        if now - self._exchanged > (_BEAT_EVERY - 0.5) * PERIOD and self._watcher.is_open:
            self._exchanged = now
            self._exchange_beats()
        self.states.take(now, self._state_reader.take())
        order = self.firmware.tick(now, self.states.vitals(now, self._outside(now)))
        self._cycles += 1
        if self._active or self.firmware.armed:
            self._active = True
            self.writer.write(self._damping if self._ends < math.inf else self._encode(order))

    def _encode(self, order: MotorCommand) -> bytes:
        if order is not self._order:
            held = order.mode == Mode.POSITION
            self._order, self._frame = order, position_frame(order.values, *self._gains) if held else self._damping
        return self._frame

    def _read_sensors(self, now: int) -> Sensors:
        self.states.take(now, self._state_reader.take())
        return self.states.sensors()

    def _answer(self, now: int) -> None:
        self.firmware.report(now, partial(self._read_sensors, now))
        try:
            for packet in self.firmware.take():
                self._host.write(self._frames.encode(packet))
        except LinkLostError:
            self._end(now)


def main() -> int:
    """Run the keeper's process."""

    def prepare(config: LinkConfig, bus: Bus, ports: list[SocketPort]) -> Supervisor:
        supervisor = Supervisor(config, bus, *ports)
        await_readers(supervisor.writer)
        return supervisor

    return serve(prepare)


if __name__ == "__main__":
    sys.exit(main())
