"""Checks of a Go2 before its motors are armed, from its messages and services; nothing moves."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, pass_if
from surefoot.deploy.dds import types
from surefoot.deploy.dds.bus import LOW_COMMAND_TOPIC, LOW_STATE_TOPIC, SPORT_STATE_TOPIC, Bus, check_interface
from surefoot.deploy.dds.low_level import LOW_STATE, MOTOR_NAMES, SERVO, STATE_PERIOD, BadMessageError, Record, decode
from surefoot.deploy.dds.motion_service import MotionService
from surefoot.deploy.dds.state_monitor import MAX_LOST, MOTORS
from surefoot.errors import SurefootError, choices
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.rotations import quat_matrix

FIRST_STATE_TIMEOUT = 3.0
"""Maximum time to wait for the first state [s]."""
OBSERVATION_TIME = 0.5
"""Time for which messages are observed [s]."""
RATE_TOLERANCE = 0.1
"""Maximum relative error of the rate of states, and of their clock."""
MAX_DAMAGED_FRACTION = 0.01
"""Maximum fraction of damaged states."""
MAX_KP, MAX_KD = 100.0, 10.0
"""Maximum servo gains [N m/rad, N m s/rad]. The limits of the drives are not published; the vendor's programs send at
most 80 and 5."""
LIMIT_MARGIN = 0.1
"""Maximum angle of a joint beyond its limits, for example at its mechanical stop [rad]."""
MAX_GRAVITY_ANGLE, GRAVITY_TOLERANCE = 0.15, 0.1
"""Maximum angle between the gravity vectors of accelerometer and orientation [rad], and relative error of its norm."""
_LYING_KNEE_ANGLE, _LYING_MAX_MOTION, _LYING_TIME = -2.2, 0.05, 0.5
"""A Go2 counts as lying if its knee angles are below the first value [rad] and its joints move by less than the second
[rad] within a time [s]; single readings of the speed are too noisy."""
_POLL_PERIOD = 0.001
_QUEUE_DEPTH = 512
"""Messages per topic that are buffered while the computer is late."""


@dataclass
class ReceivedMessages:
    """Messages received in a period of time, by topic."""

    time: float
    """Measured duration [s]."""
    records: list[Record]
    """States on rt/lowstate."""
    damaged: list[str]
    """Errors of damaged messages on rt/lowstate."""
    commands: int
    """Number of messages on rt/lowcmd."""
    sport: int
    """Number of messages on rt/sportmodestate."""


class Inspection:
    """Checks a Go2 by its topics and services."""

    def __init__(self, bus: Bus, interface: str, domain: int) -> None:
        self.service = MotionService(bus)
        self._location = f"interface {interface}, domain {domain}"
        self._interface = interface
        self._bus = bus
        self._states = bus.reader(LOW_STATE_TOPIC, types.LowState, _QUEUE_DEPTH)
        self._commands = bus.reader(LOW_COMMAND_TOPIC, types.LowCmd, _QUEUE_DEPTH, others=True)
        self._sport = bus.reader(SPORT_STATE_TOPIC, types.SportModeState, _QUEUE_DEPTH)

    def await_robot(self) -> None:
        """Wait for the first message on rt/lowstate.

        Raises:
            SurefootError: none arrives.
        """
        end = time.monotonic() + FIRST_STATE_TIMEOUT
        while not self._states.take(1):
            if time.monotonic() > end:
                nominal = types.GO_LOW_STATE
                others = [name for name in self._bus.type_names(LOW_STATE_TOPIC) if name != nominal]
                if others:
                    error = f"{LOW_STATE_TOPIC} has type {choices(others)}; a Go2's is {nominal}"
                else:
                    error = (
                        f"no state of a robot within {FIRST_STATE_TIMEOUT:g} s; check that it is on, that this "
                        "interface leads to it (ping 192.168.123.161), its DDS domain (a Go2's is 0), and that no "
                        "firewall drops UDP"
                    )
                raise SurefootError(f"{self._location}: {error}")
            time.sleep(_POLL_PERIOD)

    def observe(self, duration: float) -> ReceivedMessages:
        """Receive messages for `duration` [s], or longer on a busy computer; see `time` of the result."""
        for reader in (self._states, self._commands, self._sport):
            reader.take(_QUEUE_DEPTH)
        received = ReceivedMessages(0.0, [], [], 0, 0)
        start = time.monotonic()
        while received.time < duration:
            time.sleep(_POLL_PERIOD)
            received.time = time.monotonic() - start
            for data in self._states.take(_QUEUE_DEPTH):
                try:
                    received.records.append(decode(LOW_STATE, data))
                except BadMessageError as error:
                    received.damaged.append(str(error))
            received.commands += len(self._commands.take(_QUEUE_DEPTH))
            received.sport += len(self._sport.take(_QUEUE_DEPTH))
        return received

    def is_lying(self) -> bool:
        """Observe the robot for half a second, and return whether it lies still."""
        records = self.observe(_LYING_TIME).records
        if not records:
            return False
        angle = np.array([record["motor_state"]["q"][:MOTORS] for record in records])
        return bool((angle[:, 2::3] < _LYING_KNEE_ANGLE).all() and (np.ptp(angle, axis=0) < _LYING_MAX_MOTION).all())

    def inspect(
        self, robot: RobotDescription, kp: ArrayLike, kd: ArrayLike, release: Callable[[str], bool]
    ) -> list[CheckResult]:
        """Check the robot, after releasing its own controller if requested.

        Args:
            robot: description of the robot.
            kp: proportional gains of the drives [N m/rad], for all or for each.
            kd: derivative gains [N m s/rad], for all or for each.
            release: called with the name of the active controller; returns whether to release it.

        Raises:
            SurefootError: no states arrive, all have another layout, or the robot does not lie down.
        """
        self.await_robot()
        name = self.service.active_controller()
        if name and release(name):
            self.service.release(self.is_lying)
            name = self.service.active_controller()
        received = self.observe(OBSERVATION_TIME)
        if not received.records:
            reason = received.damaged[-1] if received.damaged else "they have stopped"
            raise SurefootError(f"{self._location}: no state of a Go2 arrives on {LOW_STATE_TOPIC}: {reason}")
        address = check_interface(self._interface)
        angles = np.mean([record["motor_state"]["q"][:MOTORS] for record in received.records], axis=0, dtype=float)
        return [
            CheckResult("interface", True, f"{self._interface}, {address}", value=self._interface),
            check_states(received),
            _check_controller(name, received.sport),
            _check_other_programs(received, self._bus.writer_names(LOW_COMMAND_TOPIC)),
            check_motors(received.records),
            check_cells(received.records[-1], robot.battery.low),
            check_gains(kp, kd),
            check_pose(angles, robot),
            check_gravity(received.records),
        ]


def check_states(received: ReceivedMessages) -> CheckResult:
    """Check rate, ticks and checksums of states."""
    count, damaged = len(received.records), len(received.damaged)
    ticks = np.array([int(record["tick"]) for record in received.records])
    rate, expected = (count + damaged) / received.time, 1 / STATE_PERIOD
    rises = np.diff(ticks)
    clock = 1e-3 * float(ticks[-1] - ticks[0]) / received.time
    error = None
    if damaged > MAX_DAMAGED_FRACTION * (count + damaged):
        error = f"{damaged} of {count + damaged} messages are damaged: {received.damaged[-1]}"
    elif abs(rate / expected - 1) > RATE_TOLERANCE:
        error = f"{rate:.0f} per second; it must be {expected:g} within {RATE_TOLERANCE:.0%}"
    elif (rises <= 0).any():
        error = f"{int((rises <= 0).sum())} of {count} states have a repeated or decreasing tick"
    elif abs(clock - 1) > RATE_TOLERANCE:
        error = f"ticks increase by {1e3 * clock:.0f} ms per second; a tick must be a millisecond"
    return fail_if(
        "states",
        error,
        f"{rate:.0f} per second, checksums correct, ticks increase",
        "check the network cable and other network traffic; use a cable, not a radio link; restart the robot",
        rate,
    )


def _check_controller(name: str | None, sport: int) -> CheckResult:
    remedy = "let the robot lie down and release its controller: --release, or in the vendor's app"
    if name:
        return CheckResult("own controller", False, f"'{name}' is active and commands the motors", remedy, name)
    if sport:
        error = (
            f"{sport} messages on {SPORT_STATE_TOPIC} in {OBSERVATION_TIME:g} s: a controller of the robot is active"
        )
        return CheckResult("own controller", False, error, remedy, sport)
    if name is None:
        message = f"the motion switcher does not answer; no messages on {SPORT_STATE_TOPIC}"
        return CheckResult("own controller", None, message, "make sure that the robot's own controller is off")
    return CheckResult("own controller", True, "released")


def _check_other_programs(received: ReceivedMessages, writers: Sequence[str]) -> CheckResult:
    announced = f"; announced writers: {choices(writers)}" if writers else ""
    return pass_if(
        "other programs",
        not received.commands,
        f"{received.commands} messages on {LOW_COMMAND_TOPIC} in {received.time:.1f} s{announced}",
        "; no other program may command the motors",
        "stop the other program, also on the robot's own computer",
        received.commands,
    )


def check_motors(records: list[Record]) -> CheckResult:
    """Check modes and lost messages of the motors."""
    motors = records[-1]["motor_state"][:MOTORS]
    off = np.flatnonzero(motors["mode"] != SERVO)
    rise = motors["lost"].astype(np.int64) - records[0]["motor_state"]["lost"][:MOTORS].astype(np.int64)
    error = None
    if off.size:
        names = choices([MOTOR_NAMES[motor] for motor in off])
        error = f"{names}: mode {int(motors['mode'][off[0]])}; it must be {SERVO}"
    elif rise.max() >= MAX_LOST:
        error = f"{MOTOR_NAMES[int(rise.argmax())]} has lost {int(rise.max())} messages in {OBSERVATION_TIME:g} s"
    lost, hottest = motors["lost"], int(motors["temperature"].max())
    return fail_if(
        "drives",
        error,
        f"{MOTORS} on, lost messages {int(lost.min())} to {int(lost.max())} and constant, at most {hottest} degC",
        "switch the robot off and on; a motor that stays off needs its cable or drive checked",
    )


def check_cells(record: Record, low: float) -> CheckResult:
    """Check that no battery cell is below its part of the voltage `low` at which a battery must be charged [V]."""
    cells = 1e-3 * record["bms_state"]["cell_vol"]
    cells = cells[cells > 0]
    if not len(cells):
        message = f"the state has no cell voltages; {float(record['power_v']):.1f} V"
        return CheckResult("cells", None, message, "check the display of the battery")
    lowest, soc, limit = float(cells.min()), int(record["bms_state"]["soc"]), low / len(cells)
    return pass_if(
        "cells",
        lowest >= limit,
        f"{len(cells)} cells, {lowest:.2f} to {float(cells.max()):.2f} V, {soc} %",
        f"; each must have at least {limit:.2f} V",
        "charge the battery",
        lowest,
    )


def check_gains(kp: ArrayLike, kd: ArrayLike) -> CheckResult:
    """Check the servo gains that every command contains."""
    highest, damping = float(np.max(kp)), float(np.max(kd))
    return pass_if(
        "drive gains",
        float(np.min(kp)) > 0 and highest <= MAX_KP and float(np.min(kd)) >= 0 and damping <= MAX_KD,
        f"kp {float(np.min(kp)):g} to {highest:g}, kd {float(np.min(kd)):g} to {damping:g}",
        f"; kp must be over 0 and at most {MAX_KP:g} N m/rad, kd at most {MAX_KD:g} N m s/rad",
        "train with gains that the drives accept",
        highest,
    )


def check_pose(angles: Array, robot: RobotDescription) -> CheckResult:
    """Check that angles (12,) [rad] are within joint limits; with another joint order or sign they usually are not."""
    limits = [robot.urdf.joints[name].limits or (-np.inf, np.inf) for name in robot.motor_names]
    low, high = np.array(limits).T
    beyond = np.maximum(low - angles, angles - high)
    worst = int(np.argmax(beyond))
    name, span = robot.motor_names[worst], f"{low[worst]:.2f} to {high[worst]:.2f}"
    return fail_if(
        "pose",
        None if beyond[worst] <= LIMIT_MARGIN else f"{name} is at {angles[worst]:.2f} rad; its range is {span}",
        "all joints are within their limits",
        "check that this robot is a Go2 as described, with its joints calibrated",
        float(beyond[worst]),
    )


def check_gravity(records: list[Record]) -> CheckResult:
    """Check that accelerometer and orientation of a resting robot agree on the direction of gravity."""
    imu = [record["imu_state"] for record in records]
    force = np.mean([one["accelerometer"] for one in imu], axis=0, dtype=float)
    quaternion = imu[-1]["quaternion"].astype(float)
    up = quat_matrix(quaternion / max(float(np.linalg.norm(quaternion)), 1e-9)).T[:, 2]
    size = float(np.linalg.norm(force))
    angle = float(np.arccos(np.clip(up @ force / max(size, 1e-9), -1, 1)))
    passed = angle <= MAX_GRAVITY_ANGLE and abs(size / GRAVITY - 1) <= GRAVITY_TOLERANCE
    return pass_if(
        "gravity",
        bool(passed),
        f"the accelerometer measures {size:.2f} m/s2, {angle:.3f} rad from the orientation's vertical",
        f"; it must be {GRAVITY:g} within {GRAVITY_TOLERANCE:.0%}, at most {MAX_GRAVITY_ANGLE:g} rad away",
        "let the robot lie still; if it already does, restart it",
        angle,
    )
