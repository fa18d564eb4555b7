"""Checks of a Go2 before its motors are armed: it is observed and asked, and nothing moves."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, judge
from surefoot.deploy.dds import types
from surefoot.deploy.dds.bus import LOW_COMMAND_TOPIC, LOW_STATE_TOPIC, SPORT_STATE_TOPIC, Bus, check_interface
from surefoot.deploy.dds.low_level import LOW_STATE, MOTOR_NAMES, SERVO, STATE_PERIOD, BadMessageError, Record, decode
from surefoot.deploy.dds.motion_service import MotionService
from surefoot.deploy.dds.state_monitor import MAX_LOST, MOTORS
from surefoot.errors import SurefootError, choices
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.rotations import quat_matrix

PATIENCE = 3.0
"""Time [s] within which the first state must come."""
OBSERVED = 0.5
"""Time [s] for which states are observed."""
RATE_TOLERANCE = 0.1
"""Greatest relative difference of the states' rate, and of their clock's, from what they should be."""
MAX_DAMAGED_FRACTION = 0.01
"""Greatest share of states that may be damaged."""
MAX_KP, MAX_KD = 100.0, 10.0
"""Greatest gains [N m/rad, N m s/rad] that are sent. What the drives take is not published; the vendor's own programs
send 80 and 5 at most."""
LIMIT_MARGIN = 0.1
"""How far [rad] a joint may be beyond the limits of the description, such as at its stop."""
MAX_GRAVITY_ANGLE, GRAVITY_TOLERANCE = 0.15, 0.1
"""Greatest angle [rad] between the accelerometer's gravity and the orientation's, and relative difference from g."""
_LYING_KNEE_ANGLE, _LYING_MAX_MOTION, _LYING_TIME = -2.2, 0.05, 0.5
"""A Go2 lies whose knees are folded below this angle [rad] and whose joints have moved by less than this [rad] for so
long [s]; single readings of speeds are too noisy."""
_POLL = 0.001
_DEPTH = 512
"""Messages on a topic that wait for a computer that is late."""


@dataclass
class ReceivedMessages:
    """What has come."""

    time: float
    """For how long [s], as measured."""
    records: list[Record]
    damaged: list[str]
    """Why messages on rt/lowstate were no states."""
    commands: int
    """Messages on rt/lowcmd."""
    sport: int
    """Messages on rt/sportmodestate."""


class Inspection:
    """A listener on a Go2's topics, and its questions to the robot."""

    def __init__(self, bus: Bus, interface: str, domain: int) -> None:
        self.service = MotionService(bus)
        self._place = f"interface {interface}, domain {domain}"
        self._interface = interface
        self._bus = bus
        self._states = bus.reader(LOW_STATE_TOPIC, types.LowState, _DEPTH)
        self._commands = bus.reader(LOW_COMMAND_TOPIC, types.LowCmd, _DEPTH, others=True)
        self._sport = bus.reader(SPORT_STATE_TOPIC, types.SportModeState, _DEPTH)

    def await_robot(self) -> None:
        """Wait for the first message on rt/lowstate.

        Raises:
            SurefootError: none comes.
        """
        end = time.monotonic() + PATIENCE
        while not self._states.take(1):
            if time.monotonic() > end:
                nominal = types.GO_LOW_STATE
                others = [name for name in self._bus.type_names(LOW_STATE_TOPIC) if name != nominal]
                if others:
                    error = f"{LOW_STATE_TOPIC} is of type {choices(others)}; a Go2's is {nominal}"
                else:
                    error = (
                        f"no state of a robot within {PATIENCE:g} s; check that it is on, that this interface leads to "
                        "it (ping 192.168.123.161), its DDS domain (a Go2's is 0), and that no firewall drops UDP"
                    )
                raise SurefootError(f"{self._place}: {error}")
            time.sleep(_POLL)

    def observe(self, duration: float) -> ReceivedMessages:
        """Observe the topics for a time [s]; on a busy computer it takes longer, and that time is in the result."""
        for reader in (self._states, self._commands, self._sport):
            reader.take(_DEPTH)
        seen = ReceivedMessages(0.0, [], [], 0, 0)
        start = time.monotonic()
        while seen.time < duration:
            time.sleep(_POLL)
            seen.time = time.monotonic() - start
            for data in self._states.take(_DEPTH):
                try:
                    seen.records.append(decode(LOW_STATE, data))
                except BadMessageError as error:
                    seen.damaged.append(str(error))
            seen.commands += len(self._commands.take(_DEPTH))
            seen.sport += len(self._sport.take(_DEPTH))
        return seen

    def lies(self) -> bool:
        """Observe the robot for a moment, and return whether it lies still."""
        records = self.observe(_LYING_TIME).records
        if not records:
            return False
        angle = np.array([record["motor_state"]["q"][:MOTORS] for record in records])
        return bool((angle[:, 2::3] < _LYING_KNEE_ANGLE).all() and (np.ptp(angle, axis=0) < _LYING_MAX_MOTION).all())

    def inspect(
        self, robot: RobotDescription, kp: ArrayLike, kd: ArrayLike, release: Callable[[str], bool]
    ) -> list[CheckResult]:
        """Observe the robot, and release its own controller where that is wanted.

        Args:
            robot: its description.
            kp: gains of its drives [N m/rad], of all or of each.
            kd: the same [N m s/rad].
            release: gets the name of the active controller, and returns whether it is to be released.

        Raises:
            SurefootError: no state comes, all are of another layout, or the robot does not lie down.
        """
        self.await_robot()
        name = self.service.active()
        if name and release(name):
            self.service.release(self.lies)
            name = self.service.active()
        seen = self.observe(OBSERVED)
        if not seen.records:
            reason = seen.damaged[-1] if seen.damaged else "they have stopped"
            raise SurefootError(f"{self._place}: no state of a Go2 comes on {LOW_STATE_TOPIC}: {reason}")
        address = check_interface(self._interface)
        angles = np.mean([record["motor_state"]["q"][:MOTORS] for record in seen.records], axis=0, dtype=float)
        return [
            CheckResult("interface", True, f"{self._interface}, {address}", value=self._interface),
            check_states(seen),
            _check_controller(name, seen.sport),
            _check_other_programs(seen, self._bus.writer_names(LOW_COMMAND_TOPIC)),
            check_motors(seen.records),
            check_cells(seen.records[-1], robot.battery.low),
            check_gains(kp, kd),
            check_pose(angles, robot),
            check_gravity(seen.records),
        ]


def check_states(seen: ReceivedMessages) -> CheckResult:
    """Judge rate, ticks and checksums of states."""
    count, damaged = len(seen.records), len(seen.damaged)
    ticks = np.array([int(record["tick"]) for record in seen.records])
    rate, expected = (count + damaged) / seen.time, 1 / STATE_PERIOD
    rises = np.diff(ticks)
    clock = 1e-3 * float(ticks[-1] - ticks[0]) / seen.time
    error = None
    if damaged > MAX_DAMAGED_FRACTION * (count + damaged):
        error = f"{damaged} of {count + damaged} messages are damaged: {seen.damaged[-1]}"
    elif abs(rate / expected - 1) > RATE_TOLERANCE:
        error = f"{rate:.0f} a second; it must be {expected:g} to {RATE_TOLERANCE:.0%}"
    elif (rises <= 0).any():
        error = f"{int((rises <= 0).sum())} of {count} states have the tick of another one, or an older one"
    elif abs(clock - 1) > RATE_TOLERANCE:
        error = f"ticks rise by {1e3 * clock:.0f} ms a second; a tick is a millisecond"
    return fail_if(
        "states",
        error,
        f"{rate:.0f} a second, checksums right, ticks rise",
        "check the network cable and what else uses the network; use a wire, not a radio; restart the robot",
        rate,
    )


def _check_controller(name: str | None, sport: int) -> CheckResult:
    remedy = "let the robot lie down and release its controller: --release, or in the vendor's app"
    if name:
        return CheckResult("own controller", False, f"'{name}' is active and commands the motors", remedy, name)
    if sport:
        error = f"{sport} messages on {SPORT_STATE_TOPIC} in {OBSERVED:g} s: a controller of the robot is active"
        return CheckResult("own controller", False, error, remedy, sport)
    if name is None:
        message = f"the motion switcher does not answer; nothing on {SPORT_STATE_TOPIC}"
        return CheckResult("own controller", None, message, "make sure that the robot's own controller is off")
    return CheckResult("own controller", True, "released")


def _check_other_programs(seen: ReceivedMessages, writers: Sequence[str]) -> CheckResult:
    announced = f"; announced as its writers: {choices(writers)}" if writers else ""
    return judge(
        "other programs",
        not seen.commands,
        f"{seen.commands} messages on {LOW_COMMAND_TOPIC} in {seen.time:.1f} s{announced}",
        "; nobody else may command the motors",
        "end the other program, also on the robot's own computer",
        seen.commands,
    )


def check_motors(records: list[Record]) -> CheckResult:
    """Judge modes and lost messages of the motors."""
    motors = records[-1]["motor_state"][:MOTORS]
    off = np.flatnonzero(motors["mode"] != SERVO)
    rise = motors["lost"].astype(np.int64) - records[0]["motor_state"]["lost"][:MOTORS].astype(np.int64)
    error = None
    if off.size:
        names = choices([MOTOR_NAMES[motor] for motor in off])
        error = f"{names}: mode {int(motors['mode'][off[0]])}; it must be {SERVO}"
    elif rise.max() >= MAX_LOST:
        error = f"{MOTOR_NAMES[int(rise.argmax())]} has lost {int(rise.max())} messages in {OBSERVED:g} s"
    lost, hottest = motors["lost"], int(motors["temperature"].max())
    return fail_if(
        "drives",
        error,
        f"{MOTORS} on, lost messages {int(lost.min())} to {int(lost.max())} and steady, at most {hottest} degC",
        "switch the robot off and on; a motor that stays off needs its cable or drive checked",
    )


def check_cells(record: Record, low: float) -> CheckResult:
    """Judge the battery's cells: none may have less than its share of the voltage `low` [V] of a battery to charge."""
    cells = 1e-3 * record["bms_state"]["cell_vol"]
    cells = cells[cells > 0]
    if not len(cells):
        message = f"the state names no cells; {float(record['power_v']):.1f} V"
        return CheckResult("cells", None, message, "look at the battery's own display")
    least, soc, limit = float(cells.min()), int(record["bms_state"]["soc"]), low / len(cells)
    return judge(
        "cells",
        least >= limit,
        f"{len(cells)} cells, {least:.2f} to {float(cells.max()):.2f} V, {soc} %",
        f"; the least must have {limit:.2f} V",
        "charge the battery",
        least,
    )


def check_gains(kp: ArrayLike, kd: ArrayLike) -> CheckResult:
    """Judge the gains that every command carries."""
    highest, damping = float(np.max(kp)), float(np.max(kd))
    return judge(
        "drive gains",
        float(np.min(kp)) > 0 and highest <= MAX_KP and float(np.min(kd)) >= 0 and damping <= MAX_KD,
        f"kp {float(np.min(kp)):g} to {highest:g}, kd {float(np.min(kd)):g} to {damping:g}",
        f"; kp must be over 0 and at most {MAX_KP:g} N m/rad, kd at most {MAX_KD:g} N m s/rad",
        "train with gains that the drives take",
        highest,
    )


def check_pose(angles: Array, robot: RobotDescription) -> CheckResult:
    """Judge whether the present angles (12,) [rad] are possible: joints in another order or mirrored mostly are not."""
    limits = [robot.urdf.joints[name].limits or (-np.inf, np.inf) for name in robot.motor_names]
    low, high = np.array(limits).T
    beyond = np.maximum(low - angles, angles - high)
    worst = int(np.argmax(beyond))
    name, span = robot.motor_names[worst], f"{low[worst]:.2f} to {high[worst]:.2f}"
    return fail_if(
        "pose",
        None if beyond[worst] <= LIMIT_MARGIN else f"{name} is at {angles[worst]:.2f} rad; it turns from {span}",
        "all joints are within their limits",
        "check that this robot is a Go2 as described, with its joints calibrated",
        float(beyond[worst]),
    )


def check_gravity(records: list[Record]) -> CheckResult:
    """Judge whether accelerometer and orientation agree about where down is, of a robot that does not move."""
    imu = [record["imu_state"] for record in records]
    force = np.mean([one["accelerometer"] for one in imu], axis=0, dtype=float)
    quaternion = imu[-1]["quaternion"].astype(float)
    up = quat_matrix(quaternion / max(float(np.linalg.norm(quaternion)), 1e-9)).T[:, 2]
    size = float(np.linalg.norm(force))
    angle = float(np.arccos(np.clip(up @ force / max(size, 1e-9), -1, 1)))
    passed = angle <= MAX_GRAVITY_ANGLE and abs(size / GRAVITY - 1) <= GRAVITY_TOLERANCE
    return judge(
        "gravity",
        bool(passed),
        f"the accelerometer says {size:.2f} m/s2, {angle:.3f} rad from where the orientation has it",
        f"; it must be {GRAVITY:g} to {GRAVITY_TOLERANCE:.0%}, at most {MAX_GRAVITY_ANGLE:g} rad away",
        "let the robot lie still; if it does, restart it",
        angle,
    )
