"""Rows of recorded torques that can be fitted: usable ones, times of their torques, motion between readings.

A deployment's row whose readings were taken at t holds, with control latency L_c, servo latency L_s and an age a of its
torque:

    motor_angle, motor_velocity     of t - L_c
    motor_torque                    of t - a, when a servo step began: back-EMF with the speed of then,
                                    the servo with angles and speeds of t - a - L_s
    command                         held until t; the row before has the one of t - a, if a is over the control step
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.robot import RobotDescription

Rows = NDArray[np.int64]

MIN_LENGTH = 2.0
"""Least length of all traces together [s]."""
MAX_LENGTH = 40.0
"""Length [s] beyond which rows are subsampled."""
HELD_OUT_FRACTION = 0.25
"""Share of the traces, or of the one trace's time, that is held out."""
REAL_TIME_SPREAD = 5e-4
"""Standard deviation of times in real time [s]: half a servo step either way, and jitter of commands. In runs of an
emulator in real time estimates of latencies were up to 1.1 ms off."""
_READINGS = 4
"""Readings of one polynomial."""


@dataclass(frozen=True)
class TorqueTiming:
    """Time between a torque and the row of the trace that reports it."""

    age: float
    """Row's time minus the time at which the torque acted [s]."""
    spread: float
    """Its standard deviation, and so that of latencies [s]."""


def torque_timings(robot: RobotDescription, motion: RecordedMotion) -> tuple[TorqueTiming, ...]:
    """Return the possible timings of a trace.

    A simulation, and a robot in lockstep, report at the control step's end the torque of the servo step that ended
    then. A robot in real time reports the torque of the servo step that ended last, one to two servo steps after it
    began, and `lead` before the control step's end.
    """
    step = robot.timing.servo_step
    at_end = TorqueTiming(step, 0.0)
    lead = float(motion.meta.get("lead", 0.0))
    if not lead:
        return (at_end,)
    return at_end, TorqueTiming(lead + 1.5 * step, REAL_TIME_SPREAD)


class MotorMotion:
    """Motion of a trace's motors between its readings.

    Between two readings the angle is the polynomial of degree 7 that has the angles and speeds of four, two before and
    two after, as Hermite's of degree 3 has those of two. A speed is the last servo step's difference of angles over its
    length dt, in simulations and from encoders alike, and so the polynomial's slope dt / 2 before.
    """

    def __init__(self, robot: RobotDescription, motion: RecordedMotion) -> None:
        self.time, self.step = motion.read_time, motion.control_step
        self.half_servo_step = 0.5 * robot.timing.servo_step / self.step
        """In control steps."""
        readings = np.arange(max(len(self.time) - _READINGS + 1, 0))[:, None] + np.arange(_READINGS)
        self.first = _READINGS // 2 - 1
        """Reading before the first interval that has a polynomial."""
        at = (self.time[readings] - self.time[readings[:, [self.first]]]) / self.step
        powers = np.arange(2 * _READINGS)
        angles = at[:, :, None] ** powers
        slopes = powers * (at[:, :, None] - self.half_servo_step) ** np.maximum(powers - 1, 0)
        conditions = np.concatenate([motion.motor_angle[readings], motion.motor_velocity[readings] * self.step], axis=1)
        self.coefficients = np.linalg.solve(np.concatenate([angles, slopes], axis=1), conditions)
        """Of rising powers of the time since an interval's start, in control steps (T - 3, 8, M)."""

    def at(self, time: Array) -> tuple[Array, Array]:
        """Return angles [rad] and speeds [rad/s] (n, M) at times (n,) [s]."""
        interval = np.clip(
            np.searchsorted(self.time, time, side="right") - 1, self.first, self.first + len(self.coefficients) - 1
        )
        x = ((time - self.time[interval]) / self.step)[:, None]
        angle, slope = 0.0, 0.0
        for power in range(2 * _READINGS - 1, -1, -1):
            terms = self.coefficients[interval - self.first, power]
            angle = angle * x + terms
            if power:
                slope = slope * (x - self.half_servo_step) + power * terms
        return angle, slope / self.step  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class TorqueRows:
    """Some rows of a trace."""

    motion: RecordedMotion
    motors: MotorMotion
    rows: Rows
    """Which of them are compared (n,)."""
    number: int
    """Of the trace."""
    timing: TorqueTiming

    @property
    def target(self) -> Array:
        """Motor angles that were commanded when the torques acted (n, M) [rad]."""
        late = int(np.floor(self.timing.age / self.motion.control_step + 1e-6))
        return self.motion.command[self.rows - late]

    @property
    def torque(self) -> Array:
        """Reported torques (n, M) [N m]."""
        return self.motion.motor_torque[self.rows]

    def state(self, age: float, control_latency: float) -> tuple[Array, Array]:
        """Return angles [rad] and speeds [rad/s] (n, M) `age` [s] before the torques acted."""
        return self.motors.at(self.motion.read_time[self.rows] + control_latency - self.timing.age - age)


def time_jumps(motion: RecordedMotion) -> NDArray[np.bool_]:
    """Return the rows (T - 1,) after which time does not advance by a control step."""
    step = motion.control_step
    return np.abs(np.diff(motion.read_time) - step) > 0.25 * step


def usable_rows(motion: RecordedMotion, earliest: float, latest: float) -> Rows:
    """Return the rows of a trace without gaps in the readings around them.

    A row is compared with readings from `earliest` [s] before it to `latest` [s] after it.
    """
    count, step = len(motion.read_time), motion.control_step
    broken = np.zeros(count, np.bool_)
    broken[1:] |= time_jumps(motion)
    # Rows of missed steps, and the one before them, hold the state of the step that came after them.
    missed = np.array([k for k in motion.meta.get("missed_steps", []) if 0 < k < count], np.int64)
    broken[missed] = broken[missed - 1] = True
    readings = np.concatenate([motion.motor_angle, motion.motor_velocity, motion.motor_torque], axis=1)
    broken[1:] |= (np.diff(readings, axis=0) == 0).all(axis=1)
    # A polynomial needs two readings on either side.
    before, after = (int(np.ceil(reach / step)) + _READINGS // 2 for reach in (earliest, latest))
    bad = np.concatenate([[0], np.cumsum(broken)])
    rows = np.arange(before, count - after)
    return rows[bad[rows + after + 1] == bad[rows - before]] if len(rows) else rows


def check_traces(robot: RobotDescription, motions: Sequence[RecordedMotion]) -> None:
    """Refuse an empty sequence, and traces of another robot, a dry run, or motors of another kind."""
    if not motions:
        raise SurefootError("there are no traces; give one or more")
    for number, motion in enumerate(motions):
        meta, where = motion.meta, f"trace {number + 1} of {len(motions)}"
        if meta["robot"] != robot.name or tuple(meta["motor_names"]) != robot.motor_names:
            raise SurefootError(f"{where}: is of robot '{meta['robot']}', not of '{robot.name}' with its motors")
        if meta.get("dry_run"):
            raise SurefootError(f"{where}: is of a dry run: its targets were never sent; give runs of an armed robot")
        if meta.get("actuator", "dc") != "dc":
            raise SurefootError(
                f"{where}: has motors of kind '{meta['actuator']}'; only DC motors ('dc') can be fitted"
            )


def make_segments(
    robot: RobotDescription, motions: Sequence[RecordedMotion], bounds: dict[str, tuple[float, float]], timing: int
) -> list[TorqueRows]:
    """Return the usable rows of all traces, the same ones for every latency within the bounds.

    Bounds are the least and greatest `servo_latency` and `control_latency` [s]; `timing` is an index of the traces'
    `torque_timings`, the last one of a trace that has fewer.

    Raises:
        SurefootError: less than `MIN_LENGTH` in all.
    """
    segments = []
    for number, motion in enumerate(motions):
        when = torque_timings(robot, motion)[: timing + 1][-1]
        earliest = when.age + bounds["servo_latency"][1] - bounds["control_latency"][0]
        rows = usable_rows(motion, max(earliest, when.age), bounds["control_latency"][1])
        segments.append(TorqueRows(motion, MotorMotion(robot, motion), rows, number, when))
    usable = _length(segments)
    if usable < MIN_LENGTH:
        whole = sum(float(motion.read_time[-1]) for motion in motions)
        raise SurefootError(
            f"traces have {usable:.2f} s without gaps, of {whole:.2f} s; {MIN_LENGTH:g} s or more are needed"
        )
    return segments


def split_segments(segments: Sequence[TorqueRows]) -> tuple[list[TorqueRows], list[TorqueRows]]:
    """Return the fitted segments, subsampled if they are long, and the held-out ones."""
    segments = [segment for segment in segments if len(segment.rows)]
    if len(segments) == 1:
        (whole,) = segments
        cut = round((1 - HELD_OUT_FRACTION) * len(whole.rows))
        fitted, held = [replace(whole, rows=whole.rows[:cut])], [replace(whole, rows=whole.rows[cut:])]
    else:
        last = max(round(HELD_OUT_FRACTION * len(segments)), 1)
        fitted, held = segments[:-last], segments[-last:]
    return subsample(fitted, max(int(np.ceil(_length(fitted) / MAX_LENGTH)), 1)), held


def subsample(segments: Sequence[TorqueRows], every: int) -> list[TorqueRows]:
    """Return segments with every `every`-th row only."""
    return [replace(segment, rows=segment.rows[::every]) for segment in segments]


def _length(segments: Sequence[TorqueRows]) -> float:
    """Length of all rows [s]."""
    return sum(len(segment.rows) * segment.motion.control_step for segment in segments)
