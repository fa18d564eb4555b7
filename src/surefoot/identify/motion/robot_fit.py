"""Physical parameters of a robot with joint actuators from its logs: commands and angles, without torques or speeds.

The fit is least squares over whole simulated robots (`identify.motion.robot_model`); a search by CMA-ES may precede it,
where the start is far off. Held-out logs show how well the identified robot moves in ways that were not fitted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.fitting import Fit, fit_least_squares
from surefoot.identify.model import ReplayModel
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import imu_channels, replay_motion
from surefoot.identify.motion.robot_model import (
    DAMPING_RATIO,
    FRICTION_RATIO,
    PRIORS,
    SECONDS,
    robot_model,
    robot_params,
    robot_unknowns,
)
from surefoot.identify.recording import digest_of
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.identify.result import Check, FitProgress, Identification, ParameterEstimate, Series, ignore_progress
from surefoot.robot import PhysicalParams, RobotDescription

MOUNTS = (0.0, np.pi / 2, np.pi, -np.pi / 2)
"""Yaw of an IMU in the base [rad] that is tried."""
_MOUNT_DEVIATION = 0.05
_POPULATION = 16
_SHOWN = 3.0


def fit_robot(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    held_out: Sequence[RecordedMotion],
    names: Sequence[str] | None,
    prior: PhysicalParams,
    seconds: float = SECONDS,
    search: int = 0,
    seed: int = 1,
    report: FitProgress = ignore_progress,
) -> Identification:
    """Identify physical parameters from logs of a robot.

    Args:
        robot: its description.
        motions: logs to fit.
        held_out: logs that are replayed with the estimates, and not fitted.
        names: which of `PRIORS` to identify; all of them, if not given.
        prior: parameters before, one row.
        seconds: how much of each log is fitted, from its start.
        search: generations of CMA-ES before the fit, over numbers that all motors share.
        seed: of the search.
        report: callback with the fit's progress.

    Raises:
        SurefootError: unknown names, no logs, or another kind of robot.
    """
    if robot.actuator.kind != "joint":
        raise SurefootError(
            f"the motors of {robot.name} are of kind {robot.actuator.kind}; logs are fitted for joint actuators"
        )
    if not motions:
        raise SurefootError("there are no logs to fit; give one or more that are not held out")
    prior = prior.rows(np.zeros(1, np.int64))
    yaw = find_imu_yaw(robot, motions, prior)
    if yaw is not None:
        prior.imu_mount[0, 2] = yaw
    model = robot_model(
        robot, motions, robot_unknowns(robot, prior, tuple(PRIORS) if names is None else names), prior, seconds
    )
    start = search_start(model, search, seed, report) if search else None
    fit = fit_least_squares(model, start, lambda step, cost: report(f"step {step}", cost))
    params = robot_params(prior, fit.unknowns, fit.values[None])
    estimates = _estimates(robot, prior, params, fit)
    if yaw is not None:
        estimates.append(ParameterEstimate.within_bounds(robot, "imu_mount", yaw, _MOUNT_DEVIATION, 2))
    checks, series = _checks(robot, [*motions, *held_out], len(motions), prior, params)
    columns = ("time", "command", "motor_angle")
    arrays = {f"{k:03d} {n}": getattr(one, n) for k, one in enumerate([*motions, *held_out]) for n in columns}
    return Identification(
        "logs",
        robot.name,
        tuple(estimates),
        checks,
        tuple(fit.strongest_correlations(10)),
        _notes(fit),
        series,
        digest=digest_of(arrays),
    )


def find_imu_yaw(robot: RobotDescription, motions: Sequence[RecordedMotion], prior: PhysicalParams) -> float | None:
    """Return the yaw of `MOUNTS` that fits the IMU's roll and pitch best; None if no log on the ground has them."""
    low, high = robot.allowed["imu_mount"]
    yaws = [yaw for yaw in MOUNTS if low <= yaw <= high]
    standing = [one.until(SECONDS) for one in motions if not one.rack and np.isfinite(one.imu[:, :2]).all()]
    if not standing or len(yaws) < 2:
        return None
    candidates = prior.rows(np.zeros(len(yaws), np.int64))
    candidates.imu_mount[:, 2] = yaws
    replayer, cost = Replayer(robot, len(yaws), rack=False, torques=False), np.zeros(len(yaws))
    for motion in standing:
        readings = imu_channels(replayer.run(segment_from_motion(motion, robot), candidates))
        cost += np.nan_to_num(np.sum((readings - motion.imu)[:, :, :2] ** 2, axis=(1, 2)), nan=np.inf)
    return yaws[int(np.argmin(cost))]


def search_start(model: ReplayModel, generations: int, seed: int, report: FitProgress) -> Array:
    """Return values (n,) by CMA-ES over the unknowns that all motors share, in units of their prior deviations.

    Raises:
        SurefootError: all unknowns are of one motor or axis each.
    """
    import cma

    unknowns = model.unknowns
    shared = [i for i, unknown in enumerate(unknowns) if unknown.index is None]
    if not shared:
        raise SurefootError("a search is over numbers that all motors share; none of them is to be identified")
    starts, low, high = (np.array([getattr(unknown, end) for unknown in unknowns]) for end in ("start", "low", "high"))
    spread = np.array([unknown.prior or 1.0 for unknown in unknowns])
    options = {"seed": seed or 1, "popsize": _POPULATION, "maxiter": generations, "verbose": -9}
    evolution = cma.CMAEvolutionStrategy(np.zeros(len(shared)), 0.5, options)
    best, least = starts, np.inf
    while not evolution.stop():
        steps = np.array(evolution.ask())
        candidates = np.tile(starts, (len(steps), 1))
        candidates[:, shared] += steps * spread[shared]
        candidates = np.clip(candidates, low, high)
        costs = np.sum(model.residuals(candidates) ** 2, axis=1) + np.sum(steps**2, axis=1)
        evolution.tell(list(steps), costs.tolist())
        if costs.min() < least:
            best, least = candidates[int(np.argmin(costs))], float(costs.min())
        report(f"search, generation {evolution.countiter}", least / len(model.blocks))
    return best


def _estimates(
    robot: RobotDescription, prior: PhysicalParams, params: PhysicalParams, fit: Fit
) -> list[ParameterEstimate]:
    """Return estimates of the physical parameters that depend on the unknowns; deviations by the delta method."""
    unknowns, count = fit.unknowns, len(fit.unknowns)
    steps = np.array([unknown.step for unknown in unknowns])
    moved = robot_params(prior, unknowns, fit.values + np.diag(steps))
    names = {unknown.name for unknown in unknowns}
    changed = [name for name in PhysicalParams.names() if name in names]
    changed += ["servo_kd"] if names & {DAMPING_RATIO, "servo_kp"} else []
    changed += ["motor_friction"] if FRICTION_RATIO in names and "motor_friction" not in names else []
    estimates = []
    for name in changed:
        value = getattr(params, name)[0]
        slopes = (getattr(moved, name) - value).reshape(count, -1) / steps[:, None]
        variances = np.einsum("in,ij,jn->n", slopes, fit.covariance, slopes)
        values = np.atleast_1d(value)
        shared = len(values) == 1 or (np.ptp(values) == 0 and np.ptp(slopes, axis=1).max() == 0)
        indices: Sequence[int | None] = [None] if shared else range(2 if name == "base_offset" else len(values))
        for index in indices:
            number, deviation = float(values[index or 0]), float(np.sqrt(variances[index or 0]))
            estimates.append(ParameterEstimate.within_bounds(robot, name, number, deviation, index))
    return estimates


def _checks(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    fitted: int,
    prior: PhysicalParams,
    params: PhysicalParams,
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """Return errors of whole logs with the prior parameters and with the estimates, and a joint of each over time."""
    replayers = {rack: Replayer(robot, 1, rack, torques=False) for rack in {one.rack for one in motions}}
    checks, series = [], []
    for number, motion in enumerate(motions):
        before, after = (
            replay_motion(motion, robot, one.rows(np.zeros(1, np.int64)), replayers[motion.rack])
            for one in (prior, params)
        )
        what = f"{motion.name}, {'fitted' if number < fitted else 'held out'}"
        checks.append(Check(what, before.rms, after.rms, "rad"))
        motor = int(np.argmax(np.where(motion.moving, after.by_motor, -1.0)))
        shown = motion.until(_SHOWN)
        rows, angles = slice(0, len(shown.time)), shown.motor_angle[:, motor]
        was, now = (angles + one.motor_angle[rows, motor] for one in (before, after))
        labels = f"{robot.motor_names[motor]}, {what}", "time [s]", "angle [rad]"
        series.append(Series(*labels, shown.read_time, angles, was, now))
    return tuple(checks), tuple(series)


def _notes(fit: Fit) -> tuple[str, ...]:
    open_, at_bound = [], []
    for unknown, value, identifiable in zip(fit.unknowns, fit.values, fit.identifiable, strict=True):
        if not identifiable:
            open_.append(unknown.label)
        if min(value - unknown.low, unknown.high - value) < 1e-6 * (unknown.high - unknown.low):
            at_bound.append(unknown.label)
    notes = [f"hardly identifiable from these logs: {', '.join(open_)}; intervals are those of the priors"] * bool(
        open_
    )
    return tuple(notes + [f"at a bound: {', '.join(at_bound)}"] * bool(at_bound))
