"""Motion of the base in recorded runs, estimated from the robot's own readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.errors import SurefootError, quote
from surefoot.estimation.interface import MotionReadings, VelocityEstimator
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.robot import RobotDescription
from surefoot.rotations import from_base_frame, from_heading_frame, rpy_quat
from surefoot.task.trace import EpisodeTrace

LASTING_ERROR = 0.12
"""Standard deviation of the part of the velocity's error that lasts for a whole run, relative to the standard deviation
of its errors that the filter states: measured on simulated robots, see results/estimation."""
ERROR_TIME = 0.03
"""Time for which the rest of the error lasts [s]."""
SCALE_ERROR = 0.01
"""Relative standard deviation of the distance: lengths of legs and radius of feet."""
HEADING_ERROR = 0.02
"""Standard deviation of the mean yaw over a run [rad]."""
NORMAL_95 = 1.96
"""Standard deviations on either side of the mean within which 95 percent of a normal distribution are."""
NOTE = (
    "speed, distance and return are estimated from IMU and legs, as nothing measured the motion of the base; "
    "see docs/estimation.md"
)
"""What to know of numbers that come from estimated motion."""
TORQUE_DELAYS = (0.0, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.035, 0.04)
"""Times that are tried by which readings of a robot are older than its torques [s]."""
PATH_WINDOW = 0.5
"""Time between the places that a path connects [s]: about a stride."""
EstimatorFactory = Callable[[RobotDescription, int], VelocityEstimator]
"""Makes an estimator for a robot and a number of robots."""


@dataclass(frozen=True)
class EstimatedMotion:
    """Estimated motion of the base in a run of T control steps, at the times of its readings."""

    time: Array
    """Time since the start at which the readings were taken (T,) [s]."""
    velocity: Array
    """Mean velocity since the readings before in the heading frame, (T, 3) [m/s]: forward, left, up."""
    variance: Array
    """Variance of the error of each component (T, 3) [m^2/s^2], in the base frame."""
    height: Array
    """Height of the base's origin above the feet in contact (T,) [m]."""
    contact: Array
    """Probability that each foot stands without slipping (T, L)."""


def estimate_motion(
    traces: Sequence[EpisodeTrace], robot: RobotDescription, make: EstimatorFactory = LeggedOdometry
) -> list[EstimatedMotion]:
    """Estimate the motion in runs of one robot, all runs together.

    Only the robot's own readings are used. Simulations and robots record torques of the present and all other readings
    as old as the control latency; torques are delayed like them, see `torque_delay`.
    """
    return _estimate(traces, [torque_delay(trace, robot) for trace in traces], robot, make)


def torque_delay(trace: EpisodeTrace, robot: RobotDescription) -> float:
    """Return the time by which the other readings of a run are older than its torques [s].

    Simulations know it. For a robot it is the one of `TORQUE_DELAYS` with which feet stand most: with torques of
    another time, the feet that carry weight contradict each other.
    """
    stated = trace.meta["params"].get("control_latency")
    if stated is not None:
        if not is_number(stated) or stated < 0:
            raise SurefootError(f"a trace has the control_latency {quote(stated)}; it must be a number of 0 or more")
        return float(stated)
    motions = _estimate([trace] * len(TORQUE_DELAYS), TORQUE_DELAYS, robot, LeggedOdometry)
    return TORQUE_DELAYS[int(np.argmax([motion.contact.mean() for motion in motions]))]


def _estimate(
    traces: Sequence[EpisodeTrace], delays: Sequence[float], robot: RobotDescription, make: EstimatorFactory
) -> list[EstimatedMotion]:
    kept = [_kept_rows(trace) for trace in traces]
    columns = [run_readings(trace, rows, delay) for trace, rows, delay in zip(traces, kept, delays, strict=True)]
    steps = max(map(len, kept))
    padded = {name: np.stack([_padded(one[name], steps) for one in columns], axis=1) for name in columns[0]}
    estimator, results = make(robot, len(traces)), []
    for step in range(steps):
        results.append(estimator.update(MotionReadings(**{name: values[step] for name, values in padded.items()})))
    stacked = {
        name: np.stack([getattr(one, name) for one in results], axis=1)
        for name in ("velocity_base", "covariance", "height", "contact")
    }
    motions = []
    for k, (trace, rows) in enumerate(zip(traces, kept, strict=True)):
        of_row = np.searchsorted(rows, np.arange(trace.num_steps))
        own = {name: values[k, of_row] for name, values in stacked.items()}
        level = from_base_frame(own["velocity_base"], trace.roll_pitch_yaw)
        variance = np.diagonal(own["covariance"], axis1=1, axis2=2)
        motions.append(EstimatedMotion(trace.time, level, variance, own["height"], own["contact"]))
    return motions


def _padded(values: Array, steps: int) -> Array:
    """Return values (T, ...) with the last row repeated up to a number of rows."""
    return np.concatenate([values, np.repeat(values[-1:], steps - len(values), axis=0)])


def _kept_rows(trace: EpisodeTrace) -> NDArray[np.int64]:
    """Return the rows with readings of their own: of a missed step and the row before, the last one."""
    rows = np.arange(trace.num_steps)
    return rows[~np.isin(rows + 1, trace.meta.get("missed_steps", ()))]


def run_readings(trace: EpisodeTrace, rows: NDArray[np.int64], delay: float) -> dict[str, Array]:
    """Return the fields of `MotionReadings` of the chosen rows of a run, one row each.

    Args:
        trace: the run.
        rows: indices of control steps (K,).
        delay: see `torque_delay` [s].
    """
    torque = np.stack([np.interp(trace.time - delay, trace.time, one) for one in trace.motor_torque.T], axis=-1)
    return {
        "duration": np.diff(trace.time[rows], prepend=0.0),
        "roll_pitch_yaw": trace.roll_pitch_yaw[rows],
        "angular_velocity_base": trace.angular_velocity_base[rows],
        "motor_angle": trace.motor_angle[rows],
        "motor_velocity": trace.motor_velocity[rows],
        "motor_torque": torque[rows],
    }


def path_length(trace: EpisodeTrace) -> float:
    """Return the length of the path of the base over the ground [m]; steps of a stride do not count."""
    count = max(round(PATH_WINDOW / trace.meta["control_step"]), 1)
    places = trace.base_position_world[[*range(0, trace.num_steps, count), trace.num_steps], :2]
    return float(np.hypot(*np.diff(places, axis=0).T).sum())


def is_estimated(trace: EpisodeTrace) -> bool:
    """Return whether the motion of the base in a run was estimated."""
    return "base_position_world" in trace.meta.get("estimated", ())


def with_estimated_motion(trace: EpisodeTrace, robot: RobotDescription) -> EpisodeTrace:
    """Return a robot's run with the estimated motion of its base, if its motion was not measured.

    The base starts at x = y = 0 with yaw 0, as with motion capture; meta says which columns are estimated. A run whose
    motion is known, an imported log and a dry run are returned as they are.
    """
    is_measured = np.isfinite(trace.base_position_world).any()
    if is_measured or trace.is_imported or trace.meta.get("dry_run"):
        return trace
    (motion,) = estimate_motion([trace], robot)
    return with_motion(trace, motion)


def with_motion(trace: EpisodeTrace, motion: EstimatedMotion) -> EpisodeTrace:
    """Return a run with its estimated motion and the error of its distance, see `with_estimated_motion`."""
    yaw = np.unwrap(trace.roll_pitch_yaw[:, 2])
    yaw = yaw - yaw[0]
    middle = (yaw + np.concatenate([yaw[:1], yaw[:-1]])) / 2
    step = np.diff(trace.time, prepend=0.0)[:, None]
    moved = from_heading_frame(motion.velocity[:, None, :2], middle)[:, 0] * step
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    height = np.concatenate([motion.height[:1], motion.height])
    attitude = np.column_stack([trace.roll_pitch_yaw[:, :2], yaw])
    quat = np.array([rpy_quat(*row) for row in attitude[[0, *range(trace.num_steps)]].tolist()])
    # Errors of the velocity turn with the robot.
    spread = np.sqrt(motion.variance[:, :1]) * step
    lasting = LASTING_ERROR * (spread * np.column_stack([np.cos(middle), np.sin(middle)])).sum(axis=0)
    passing = np.sqrt(2.0 * ERROR_TIME * (motion.variance[:, :1] * step).sum())
    ahead, left = place[-1]
    error = np.linalg.norm([*lasting, passing, SCALE_ERROR * ahead, HEADING_ERROR * left])
    return replace(
        trace,
        base_position_world=np.column_stack([place, height]),
        base_quat_world=quat,
        meta={
            **trace.meta,
            "estimated": ["base_position_world", "base_quat_world"],
            "distance_error": float(error),
        },
    )


def estimate_intervals(traces: Sequence[EpisodeTrace], metrics: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the 95 % intervals of mean distance, speed, return and gap of runs, from errors of estimated motion alone.

    All runs of a robot have a similar error, so that their mean has it too. Measured runs have none.

    Args:
        traces: the runs.
        metrics: their means; `distance_mean`, `speed_mean`, `return_mean` and `gap` get an interval of the same name if
            they are known.
    """
    errors = np.array([trace.meta.get("distance_error", np.nan) if is_estimated(trace) else 0.0 for trace in traces])
    width, speed_width = (NORMAL_95 * np.mean(values) for values in (errors, errors / [one.duration for one in traces]))
    widths = {"distance_mean": width, "speed_mean": speed_width, "return_mean": width, "gap": width}
    means = {name: metrics.get(name) for name in widths}
    return {
        name: [float(mean - widths[name]), float(mean + widths[name])]
        for name, mean in means.items()
        if mean is not None and np.isfinite(mean)
    }


def interval_text(intervals: Mapping[str, Sequence[float]]) -> str:
    """Return intervals of `estimate_intervals` as text."""
    parts = [f"{name.removesuffix('_mean')} {low:.2f} to {high:.2f}" for name, (low, high) in intervals.items()]
    return f"95 % intervals of the estimates: {', '.join(parts)}"
