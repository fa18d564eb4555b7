"""Supervisor process of a Go2: runs the board's program next to the control loop, and writes every motor command.

A Go2 has no microcontroller that surefoot could program, so this process is the board of the wire protocol. It receives
the control loop's messages through a socket and the robot's states from rt/lowstate, checks both, and writes rt/lowcmd
at 500 Hz from the first arming until the loop has ended. Then it damps the motors for `DAMPING_TIME` and exits. If the
supervisor itself dies or hangs, the watchdog process (`watchdog.py`) damps the motors.
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
from surefoot.deploy.dds.state_monitor import HAZARD_HOLD, MOTORS, StateMonitor
from surefoot.deploy.messages import Mode, Reason
from surefoot.deploy.robot_link import LISTEN_TIME, LinkLostError

PERIOD = round(STATE_PERIOD * 1e6)
"""Period of the commands to the robot [us]."""
DAMPING = 3.0
"""Derivative gain of damped motors [N m s/rad], as in the vendor's programs."""
DAMPING_TIME = 500_000
"""Time for which the supervisor damps the motors after the control loop has ended [us]."""
IDLE, ACTIVE, DONE = b"\0", b"\1", b"\2"
"""Heartbeats to the watchdog: no command written yet; commands are being written; the supervisor exits normally."""
_HAZARD_HOLDS = {Reason.OTHER_PROGRAM: microseconds(LISTEN_TIME)}
"""Time for which a hazard prevents arming after it was seen last [us]; defaults to `HAZARD_HOLD`. Another program may
send commands rarely, so it is remembered for longer."""
_HEARTBEAT_CYCLES = 2
"""Command periods between two heartbeats."""
WATCHDOG_SILENCE = 100_000
"""Time without an answer after which the watchdog counts as lost [us], measured in this process's own cycles. With
30 ms, a robot was damped because other programs with real-time priority had delayed the watchdog."""
_FIRST_STATE_TIMEOUT = 100
"""Time to wait for a state from which the clock is set to the robot's [ms]."""
_INTRUDER_CHECK_CYCLES = 5
"""Command periods between two checks for messages of other programs and of the robot's own controller."""


def damping_frame() -> bytes:
    """Return an encoded command that damps all motors."""
    command = new_command()
    motors = command["motor_cmd"][:MOTORS]
    motors["dq"], motors["kd"] = 0.0, DAMPING
    return encode(command)


def position_frame(target: Array, kp: Array, kd: Array) -> bytes:
    """Return an encoded command that holds motor angles (12,) [rad] with gains (12,) [N m/rad, N m s/rad]."""
    command = new_command()
    motors = command["motor_cmd"][:MOTORS]
    motors["q"], motors["dq"], motors["kp"], motors["kd"] = target, 0.0, kp, kd
    return encode(command)


class Supervisor:
    """The board's program, connected to the control loop by a socket and to the robot by DDS topics.

    Args:
        config: handshake and limits of the robot.
        bus: DDS participant through which the robot is reached.
        host: socket to the control loop.
        watchdog: socket to the watchdog process.
    """

    def __init__(self, config: LinkConfig, bus: Bus, host: SocketPort, watchdog: SocketPort) -> None:
        self.firmware = Firmware(config.handshake, config.limits)
        self.states = StateMonitor()
        self._gains = config.handshake.servo_kp, config.handshake.servo_kd
        self._host, self._frames = host, HostFrames(MOTORS, accelerometer=True)
        self._watchdog, self._unanswered = watchdog, 0
        self._watchdog_text = ""
        self._state_reader = bus.reader(LOW_STATE_TOPIC, types.LowState, 4)
        # The robot's own controller also writes motor commands, so it is checked first: its name is the better message.
        self._intruders: tuple[tuple[RawReader[Any], Hazard], ...] = (
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
        self._motor_command: MotorCommand | None = None
        self._exchanged = -math.inf
        """When heartbeats were last exchanged [us]."""
        self._intruder_times = [-math.inf] * len(self._intruders)
        self._intruder: Hazard | None = None
        self._controller = ""
        self._cycles = 0
        self._end_time: float = math.inf
        self._active = False

    def run(self) -> None:
        """Run until the control loop has ended and the motors have been damped.

        The clock starts at the robot's tick, then follows this computer's clock. Other recordings of the robot, such as
        motion capture, can thus be aligned by the robot's ticks.
        """
        start = time.monotonic_ns() - 1000 * self._robot_time()
        due = now = (time.monotonic_ns() - start) // 1000
        while now < self._end_time:
            running = self._end_time == math.inf
            pause = (min(due, self.firmware.next_state) if running else due) - now
            readable = select.select([self._host] if running else (), (), (), pause / 1e6 if pause > 0 else 0)[0]
            now = (time.monotonic_ns() - start) // 1000
            if readable:
                self._receive(now)
            if now >= due:
                self._cycle(now)
                # A late cycle is not made up for: the robot follows the newest command anyway.
                due = due + PERIOD if now - due < PERIOD else now + PERIOD
            if self._end_time == math.inf:
                self._answer(now)
        with contextlib.suppress(LinkLostError):
            self._watchdog.write(DONE)

    def _robot_time(self) -> int:
        """Return the robot's time [us] from the next state, or 0 if none arrives within `_FIRST_STATE_TIMEOUT`."""
        self._state_reader.take()
        for _ in range(_FIRST_STATE_TIMEOUT):
            time.sleep(0.001)
            for data in self._state_reader.take():
                with contextlib.suppress(BadMessageError):
                    return 1000 * int(decode(LOW_STATE, data)["tick"])
        return 0

    def _receive(self, now: int) -> None:
        try:
            if data := self._host.read():
                self._frames.receive(now, data, self.firmware)
        except LinkLostError:
            self._end(now)

    def _end(self, now: int) -> None:
        """Damp the motors from now on: the control loop has ended, normally or not."""
        self._host.close()
        self._end_time = now + DAMPING_TIME if self._active else now

    def _exchange_heartbeats(self) -> None:
        """Read the watchdog's answers, and send it a heartbeat."""
        try:
            if data := self._watchdog.read():
                self._unanswered = 0
                *lines, self._watchdog_text = (self._watchdog_text + data.decode(errors="replace")).split("\n")
                if lines:
                    self._controller = lines[-1]
            self._watchdog.write(ACTIVE if self._active else IDLE)
            # Heartbeats are counted, and no time is measured: if all processes of the computer were stopped, the
            # watchdog has not hung.
            self._unanswered += 1
        except LinkLostError:
            self._watchdog.close()

    def _external_hazard(self, now: int) -> Hazard | None:
        """Return why the motors must not move, for reasons other than the robot's states; None if they may."""
        if not self._watchdog.is_open or self._unanswered * _HEARTBEAT_CYCLES * PERIOD > WATCHDOG_SILENCE:
            return Reason.WATCHDOG, "the watchdog process has ended or hangs"
        if self._controller:
            return Reason.OWN_CONTROLLER, f"the robot's own controller '{self._controller}' is active"
        if self._cycles % _INTRUDER_CHECK_CYCLES == 0:
            for k, (reader, hazard) in enumerate(self._intruders):
                if reader.take():
                    self._intruder_times[k] = now
                    if not self.firmware.armed and self.firmware.owner:
                        self.firmware.announce(now, hazard)
            seen = zip(self._intruder_times, self._intruders, strict=True)
            recent = (hazard for at, (_, hazard) in seen if now - at < _HAZARD_HOLDS.get(hazard[0], HAZARD_HOLD))
            self._intruder = next(recent, None)
        return self._intruder

    def _cycle(self, now: int) -> None:
        """Read the robot's newest state, and write the motor command."""
        # By time, not by cycles: a process that was stopped must first learn that the watchdog has damped the motors.
        if now - self._exchanged > (_HEARTBEAT_CYCLES - 0.5) * PERIOD and self._watchdog.is_open:
            self._exchanged = now
            self._exchange_heartbeats()
        self.states.update(now, self._state_reader.take())
        stop = self.states.stop_hazard
        if stop is not None and self.firmware.owner and not self.firmware.armed:
            self.firmware.announce(now, stop)  # damped motors must not be armed again after a fall
        command = self.firmware.tick(now, self.states.vitals(now, self._external_hazard(now)))
        self._cycles += 1
        if self._active or self.firmware.armed:
            self._active = True
            self.writer.write(self._damping if self._end_time < math.inf else self._encode(command))

    def _encode(self, command: MotorCommand) -> bytes:
        if command is not self._motor_command:
            held = command.mode == Mode.POSITION
            self._motor_command, self._frame = (
                command,
                position_frame(command.values, *self._gains) if held else self._damping,
            )
        return self._frame

    def _read_sensors(self, now: int) -> Sensors:
        self.states.update(now, self._state_reader.take())
        return self.states.sensors()

    def _answer(self, now: int) -> None:
        self.firmware.report(now, partial(self._read_sensors, now))
        try:
            for packet in self.firmware.take():
                self._host.write(self._frames.encode(packet))
        except LinkLostError:
            self._end(now)


def main() -> int:
    """Run the supervisor process."""

    def prepare(config: LinkConfig, bus: Bus, ports: list[SocketPort]) -> Supervisor:
        supervisor = Supervisor(config, bus, *ports)
        await_readers(supervisor.writer)
        return supervisor

    return serve(prepare)


if __name__ == "__main__":
    sys.exit(main())
