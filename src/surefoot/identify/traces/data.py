"""Segments of recorded runs that can be fitted: usable rows, times of their torques, motion between readings.

A trace's row of the time t holds, with control latency L_c, servo latency L_s and an age a of its torque:

    motor_angle, motor_velocity     of t - L_c
    motor_torque                    of t - a, when a servo step began: back-EMF with the speed of then,
                                    the servo with angles and speeds of t - a - L_s
    target                          held until t; the row before has the one of t - a, if a is over the control step
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

Rows = NDArray[np.int64]

MIN_LENGTH = 2.0
"""Least length of all traces together [s]."""
MAX_LENGTH = 40.0
"""Length [s] beyond which rows are subsampled."""
HELD_OUT = 0.25
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


def torque_timings(robot: RobotDescription, trace: EpisodeTrace) -> tuple[TorqueTiming, ...]:
    """Return the possible timings of a trace.

    A simulation, and a robot in lockstep, report at the control step's end the torque of the servo step that ended
    then. A robot in real time reports the torque of the servo step that ended last, one to two servo steps after it
    began, and `lead` before the control step's end.
    """
    step = robot.timing.servo_step
    at_end = TorqueTiming(step, 0.0)
    lead = float(trace.meta.get("lead", 0.0))
    if not lead:
        return (at_end,)
    return at_end, TorqueTiming(lead + 1.5 * step, REAL_TIME_SPREAD)


class MotorMotion:
    """Motion of a trace's motors between its readings.

    Between two readings the angle is the polynomial of degree 7 that has the angles and speeds of four, two before and
    two after, as Hermite's of degree 3 has those of two. A speed is the last servo step's difference of angles over its
    length dt, in simulations and from encoders alike, and so the polynomial's slope dt / 2 before.
    """

    def __init__(self, robot: RobotDescription, trace: EpisodeTrace) -> None:
        self.time, self.step = trace.time, float(trace.meta["control_step"])
        self.half_servo_step = 0.5 * robot.timing.servo_step / self.step
        """In control steps."""
        readings = np.arange(max(len(self.time) - _READINGS + 1, 0))[:, None] + np.arange(_READINGS)
        self.first = _READINGS // 2 - 1
        """Reading before the first interval that has a polynomial."""
        at = (self.time[readings] - self.time[readings[:, [self.first]]]) / self.step
        powers = np.arange(2 * _READINGS)
        angles = at[:, :, None] ** powers
        slopes = powers * (at[:, :, None] - self.half_servo_step) ** np.maximum(powers - 1, 0)
        conditions = np.concatenate([trace.motor_angle[readings], trace.motor_velocity[readings] * self.step], axis=1)
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
class TraceSegment:
    """Rows of one trace."""

    trace: EpisodeTrace
    motors: MotorMotion
    rows: Rows
    """Which of them are compared (n,)."""
    number: int
    """Of the trace."""
    timing: TorqueTiming

    @property
    def target(self) -> Array:
        """Motor angles that were commanded when the torques acted (n, M) [rad]."""
        late = int(np.floor(self.timing.age / self.trace.meta["control_step"] + 1e-6))
        return self.trace.target[self.rows - late]

    @property
    def torque(self) -> Array:
        """Reported torques (n, M) [N m]."""
        return self.trace.motor_torque[self.rows]

    def motion(self, age: float, control_latency: float) -> tuple[Array, Array]:
        """Return angles [rad] and speeds [rad/s] (n, M) `age` [s] before the torques acted."""
        return self.motors.at(self.trace.time[self.rows] + control_latency - self.timing.age - age)


def time_jumps(trace: EpisodeTrace) -> NDArray[np.bool_]:
    """Return the rows (T - 1,) after which time does not advance by a control step."""
    step = float(trace.meta["control_step"])
    return np.abs(np.diff(trace.time) - step) > 0.25 * step


def usable_rows(trace: EpisodeTrace, earliest: float, latest: float) -> Rows:
    """Return the rows of a trace without gaps in the readings around them.

    A row is compared with readings from `earliest` [s] before it to `latest` [s] after it.
    """
    count = trace.num_steps
    broken = np.zeros(count, np.bool_)
    broken[1:] |= time_jumps(trace)
    # Rows of missed steps, and the one before them, hold the state of the step that came after them.
    missed = np.array([k for k in trace.meta.get("missed_steps", []) if 0 < k < count], np.int64)
    broken[missed] = broken[missed - 1] = True
    readings = np.concatenate([trace.motor_angle, trace.motor_velocity, trace.motor_torque], axis=1)
    broken[1:] |= (np.diff(readings, axis=0) == 0).all(axis=1)
    # A polynomial needs two readings on either side.
    step = float(trace.meta["control_step"])
    before, after = (int(np.ceil(reach / step)) + _READINGS // 2 for reach in (earliest, latest))
    bad = np.concatenate([[0], np.cumsum(broken)])
    rows = np.arange(before, count - after)
    return rows[bad[rows + after + 1] == bad[rows - before]] if len(rows) else rows


def check_traces(robot: RobotDescription, traces: Sequence[EpisodeTrace]) -> None:
    """Refuse an empty sequence, and traces of another robot, a dry run, or motors of another kind."""
    if not traces:
        raise SurefootError("there are no traces; give one or more")
    for number, trace in enumerate(traces):
        meta, where = trace.meta, f"trace {number + 1} of {len(traces)}"
        if meta["robot"] != robot.name or tuple(meta["motor_names"]) != robot.motor_names:
            raise SurefootError(f"{where}: is of robot '{meta['robot']}', not of '{robot.name}' with its motors")
        if meta.get("dry_run"):
            raise SurefootError(f"{where}: is of a dry run: its targets were never sent; give runs of an armed robot")
        if meta.get("actuator", "dc") != "dc":
            raise SurefootError(
                f"{where}: has motors of kind '{meta['actuator']}'; only DC motors ('dc') can be fitted"
            )


def make_segments(
    robot: RobotDescription, traces: Sequence[EpisodeTrace], bounds: dict[str, tuple[float, float]], timing: int
) -> list[TraceSegment]:
    """Return the usable rows of all traces, the same ones for every latency within the bounds.

    Bounds are the least and greatest `servo_latency` and `control_latency` [s]; `timing` is an index of the traces'
    `torque_timings`, the last one of a trace that has fewer.

    Raises:
        SurefootError: less than `MIN_LENGTH` in all.
    """
    segments = []
    for number, trace in enumerate(traces):
        when = torque_timings(robot, trace)[: timing + 1][-1]
        earliest = when.age + bounds["servo_latency"][1] - bounds["control_latency"][0]
        rows = usable_rows(trace, max(earliest, when.age), bounds["control_latency"][1])
        segments.append(TraceSegment(trace, MotorMotion(robot, trace), rows, number, when))
    usable = _length(segments)
    if usable < MIN_LENGTH:
        whole = sum(trace.duration for trace in traces)
        raise SurefootError(
            f"traces have {usable:.2f} s without gaps, of {whole:.2f} s; {MIN_LENGTH:g} s or more are needed"
        )
    return segments


def split_segments(segments: Sequence[TraceSegment]) -> tuple[list[TraceSegment], list[TraceSegment]]:
    """Return the fitted segments, subsampled if they are long, and the held-out ones."""
    segments = [segment for segment in segments if len(segment.rows)]
    if len(segments) == 1:
        (whole,) = segments
        cut = round((1 - HELD_OUT) * len(whole.rows))
        fitted, held = [replace(whole, rows=whole.rows[:cut])], [replace(whole, rows=whole.rows[cut:])]
    else:
        last = max(round(HELD_OUT * len(segments)), 1)
        fitted, held = segments[:-last], segments[-last:]
    return subsample(fitted, max(int(np.ceil(_length(fitted) / MAX_LENGTH)), 1)), held


def subsample(segments: Sequence[TraceSegment], every: int) -> list[TraceSegment]:
    """Return segments with every `every`-th row only."""
    return [replace(segment, rows=segment.rows[::every]) for segment in segments]


def _length(segments: Sequence[TraceSegment]) -> float:
    """Length of all rows [s]."""
    return sum(len(segment.rows) * segment.trace.meta["control_step"] for segment in segments)
