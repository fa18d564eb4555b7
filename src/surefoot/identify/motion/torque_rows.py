"""Selection and timing of the rows of recorded torques that a fit uses, and the motion between readings.

With the control latency L_c, the servo latency L_s and the age a of the reported torque, a row of a deployment whose
readings were taken at time t holds:

    motor_angle, motor_velocity     at t - L_c
    motor_torque                    of the servo step that began at t - a, with the back-EMF at the speed of that time
                                    and the servo acting on angles and speeds at t - a - L_s
    command                         held until t; if a exceeds the control step, the command at t - a is in the row
                                    before
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
from surefoot.task.trace import IMPORTED_LOG

Rows = NDArray[np.int64]

MIN_LENGTH = 2.0
"""Minimum total length of all traces [s]."""
MAX_LENGTH = 40.0
"""Length [s] above which rows are subsampled."""
HELD_OUT_FRACTION = 0.25
"""Fraction of the traces, or of the time of a single trace, that is held out."""
REAL_TIME_SPREAD = 5e-4
"""Standard deviation of the timing in real time [s]: half a servo step in each direction, and jitter of commands. In
real-time runs of an emulator, estimated latencies had errors of up to 1.1 ms."""
_READINGS = 4
"""Number of readings that one interpolation polynomial uses."""


@dataclass(frozen=True)
class TorqueTiming:
    """Delay between a torque and the row of the trace that reports it."""

    age: float
    """Time of the row minus the time at which the torque acted [s]."""
    spread: float
    """Standard deviation of the age, which adds to the standard deviation of latencies [s]."""


def torque_timings(robot: RobotDescription, motion: RecordedMotion) -> tuple[TorqueTiming, ...]:
    """Return the possible timings of a trace.

    A simulation or a robot in lockstep reports, at the end of a control step, the torque of the servo step that has
    just ended. A robot in real time sends its state `lead` before the end of the control step, with the torque of the
    last complete servo step, which began one to two servo steps earlier.
    """
    step = robot.timing.servo_step
    at_end = TorqueTiming(step, 0.0)
    lead = float(motion.meta.get("lead", 0.0))
    if not lead:
        return (at_end,)
    return at_end, TorqueTiming(lead + 1.5 * step, REAL_TIME_SPREAD)


class MotorMotion:
    """Motion of a trace's motors between its readings, by Hermite interpolation.

    Between two readings, the angle is the polynomial of degree 7 through the angles and speeds of four readings, two
    before and two after. A reported speed is the difference of angles over the last servo step, divided by its length
    dt, both in simulation and from encoders. It therefore equals the slope of the polynomial at a time dt / 2 earlier.
    """

    def __init__(self, robot: RobotDescription, motion: RecordedMotion) -> None:
        self.time, self.step = motion.read_time, motion.control_step
        self.half_servo_step = 0.5 * robot.timing.servo_step / self.step
        """Half a servo step, in control steps."""
        readings = np.arange(max(len(self.time) - _READINGS + 1, 0))[:, None] + np.arange(_READINGS)
        self.first = _READINGS // 2 - 1
        """Index of the reading before the first interval with a polynomial."""
        at = (self.time[readings] - self.time[readings[:, [self.first]]]) / self.step
        powers = np.arange(2 * _READINGS)
        angles = at[:, :, None] ** powers
        slopes = powers * (at[:, :, None] - self.half_servo_step) ** np.maximum(powers - 1, 0)
        conditions = np.concatenate([motion.motor_angle[readings], motion.motor_velocity[readings] * self.step], axis=1)
        self.coefficients = np.linalg.solve(np.concatenate([angles, slopes], axis=1), conditions)
        """Coefficients (T - 3, 8, M) of rising powers of the time since the start of an interval [control steps]."""

    def at(self, time: Array) -> tuple[Array, Array]:
        """Return interpolated angles [rad] and speeds [rad/s] (n, M) at times (n,) [s]."""
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
    """Selected rows of a trace, whose torques are compared with the motor model."""

    motion: RecordedMotion
    motors: MotorMotion
    rows: Rows
    """Indices of the compared rows (n,)."""
    number: int
    """Index of the trace."""
    timing: TorqueTiming

    @property
    def target(self) -> Array:
        """Commanded motor angles at the time when the torques acted (n, M) [rad]."""
        delay = int(np.floor(self.timing.age / self.motion.control_step + 1e-6))
        return self.motion.command[self.rows - delay]

    @property
    def torque(self) -> Array:
        """Reported torques (n, M) [N m]."""
        return self.motion.motor_torque[self.rows]

    def state(self, age: float, control_latency: float) -> tuple[Array, Array]:
        """Return angles [rad] and speeds [rad/s] (n, M) at a time `age` [s] before the torques acted."""
        return self.motors.at(self.motion.read_time[self.rows] + control_latency - self.timing.age - age)


def time_jumps(motion: RecordedMotion) -> NDArray[np.bool_]:
    """Return a mask (T - 1,) of the rows after which time does not advance by one control step."""
    step = motion.control_step
    return np.abs(np.diff(motion.read_time) - step) > 0.25 * step


def usable_rows(motion: RecordedMotion, earliest: float, latest: float) -> Rows:
    """Return the indices of rows that have no gaps in the readings around them.

    The model of a row uses readings from `earliest` [s] before it to `latest` [s] after it.
    """
    count, step = len(motion.read_time), motion.control_step
    unusable = np.zeros(count, np.bool_)
    unusable[1:] |= time_jumps(motion)
    # Rows of missed steps, and the row before them, hold the state of the step after them.
    missed = np.array([k for k in motion.meta.get("missed_steps", []) if 0 < k < count], np.int64)
    unusable[missed] = unusable[missed - 1] = True
    readings = np.concatenate([motion.motor_angle, motion.motor_velocity, motion.motor_torque], axis=1)
    unusable[1:] |= (np.diff(readings, axis=0) == 0).all(axis=1)
    # A polynomial needs two readings on each side.
    before, after = (int(np.ceil(reach / step)) + _READINGS // 2 for reach in (earliest, latest))
    num_unusable = np.concatenate([[0], np.cumsum(unusable)])
    rows = np.arange(before, count - after)
    return rows[num_unusable[rows + after + 1] == num_unusable[rows - before]] if len(rows) else rows


def check_traces(robot: RobotDescription, motions: Sequence[RecordedMotion]) -> None:
    """Reject traces that can't be fitted.

    Raises:
        SurefootError: there are no traces, or a trace is imported, of another robot, a dry run, or other actuators.
    """
    if not motions:
        raise SurefootError("there are no traces; give one or more")
    for number, motion in enumerate(motions):
        meta, where = motion.meta, f"trace {number + 1} of {len(motions)}"
        if meta["robot"] != robot.name or tuple(meta["motor_names"]) != robot.motor_names:
            raise SurefootError(f"{where}: is of robot '{meta['robot']}', not of '{robot.name}' with its motors")
        if meta.get("world") == IMPORTED_LOG:
            raise SurefootError(
                f"{where}: is an imported log; only runs that surefoot recorded can be fitted for DC motors"
            )
        if meta.get("dry_run"):
            raise SurefootError(f"{where}: is a dry run, whose targets were never sent; give runs of an armed robot")
        if meta.get("actuator", "dc") != "dc":
            raise SurefootError(
                f"{where}: has motors of kind '{meta['actuator']}'; only DC motors ('dc') can be fitted"
            )


def make_segments(
    robot: RobotDescription, motions: Sequence[RecordedMotion], bounds: dict[str, tuple[float, float]], timing: int
) -> list[TorqueRows]:
    """Return the usable rows of each trace, which are the same for all latencies within the bounds.

    Args:
        robot: robot description.
        motions: the traces.
        bounds: minimum and maximum `servo_latency` and `control_latency` [s].
        timing: index into `torque_timings`; a trace with fewer timings uses its last one.

    Raises:
        SurefootError: the usable rows are shorter than `MIN_LENGTH` in total.
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
            f"traces have {usable:.2f} s without gaps, out of {whole:.2f} s; at least {MIN_LENGTH:g} s are needed"
        )
    return segments


def split_segments(segments: Sequence[TorqueRows]) -> tuple[list[TorqueRows], list[TorqueRows]]:
    """Return the fitted segments, subsampled if they are long, and the held-out segments."""
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
    """Return segments with only every `every`-th row."""
    return [replace(segment, rows=segment.rows[::every]) for segment in segments]


def _length(segments: Sequence[TorqueRows]) -> float:
    """Return the total length of all rows [s]."""
    return sum(len(segment.rows) * segment.motion.control_step for segment in segments)
