"""Physical parameters of a robot with joint actuators from its logs: commands and angles, without torques or speeds.

The fit is least squares over whole simulated robots (`identify.log_model`); a search by CMA-ES may come before it,
where the start is far off. Logs that are held out tell how well the found robot moves in ways that were not fitted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.fitting import Fit, Unknown, fit_least_squares
from surefoot.identify.logs.errors import imu_of, replay_log
from surefoot.identify.logs.model import (
    FRICTION_RATIO,
    RATIO,
    RULES,
    SECONDS,
    LogModel,
    LogRun,
    check_robot,
    params_of_logs,
    unknowns_of,
)
from surefoot.identify.recording import digest_of
from surefoot.identify.result import FitProgress, ignore_progress
from surefoot.identify.replay import Replayer, segment_from_log
from surefoot.identify.result import Check, Identification, ParameterEstimate, Series
from surefoot.robot import PhysicalParams, RobotDescription

EXPERIMENT = "logs"
MOUNTS = (0.0, np.pi / 2, np.pi, -np.pi / 2)
"""Yaw of an IMU in the base [rad] that is tried."""
_MOUNT_DEVIATION = 0.05
_POPULATION = 16
_SHOWN = 3.0


def fit_logs(
    robot: RobotDescription,
    runs: Sequence[LogRun],
    held_out: Sequence[LogRun],
    names: Sequence[str] | None,
    known: PhysicalParams,
    seconds: float = SECONDS,
    search: int = 0,
    seed: int = 1,
    report: FitProgress = ignore_progress,
) -> Identification:
    """Find physical parameters from logs of a robot.

    Args:
        robot: its description.
        runs: logs to fit.
        held_out: logs that are replayed with what was found, and not fitted.
        names: which of `RULES` to find; all of them, if not given.
        known: what was known before, one row.
        seconds: how much of each log is fitted, from its start.
        search: generations of CMA-ES before the fit, over what all motors have in common.
        seed: of the search.
        tell: is told how it goes.

    Raises:
        SurefootError: unknown names, no logs, or another kind of robot.
    """
    check_robot(robot)
    if not runs:
        raise SurefootError("there are no logs to fit; give one or more that are not held out")
    known = known.rows(np.zeros(1, np.int64))
    yaw = _mounted(robot, runs, known)
    if yaw is not None:
        known.imu_mount[0, 2] = yaw
    unknowns = unknowns_of(robot, known, tuple(RULES) if names is None else names)
    model = LogModel(robot, runs, unknowns, known, seconds)
    start = _searched(model, search, seed, report) if search else None
    fit = fit_least_squares(model, start, lambda step, cost: report(f"step {step}", cost))
    found = params_of_logs(known, fit.unknowns, fit.values[None])
    estimates = _estimates(robot, known, found, fit)
    if yaw is not None:
        estimates.append(ParameterEstimate.within_bounds(robot, "imu_mount", yaw, _MOUNT_DEVIATION, 2))
    checks, series = _checks(robot, [*runs, *held_out], len(runs), known, found)
    logs = [run.log for run in (*runs, *held_out)]
    arrays = {f"{k:03d} {n}": getattr(log, n) for k, log in enumerate(logs) for n in ("time", "command", "motor_angle")}
    return Identification(
        EXPERIMENT,
        robot.name,
        tuple(estimates),
        tuple(checks),
        tuple(fit.strongest_correlations(10)),
        _notes(fit),
        tuple(series),
        digest=digest_of(arrays),
    )


def _mounted(robot: RobotDescription, runs: Sequence[LogRun], known: PhysicalParams) -> float | None:
    """Return the yaw of `MOUNTS` that explains the IMU's roll and pitch best; None if no log on the ground has them."""
    low, high = robot.allowed["imu_mount"]
    yaws = [yaw for yaw in MOUNTS if low <= yaw <= high]
    standing = [run.log for run in runs if not run.rack and np.isfinite(run.log.imu[:, :2]).all()]
    if not standing or len(yaws) < 2:
        return None
    tried = known.rows(np.zeros(len(yaws), np.int64))
    tried.imu_mount[:, 2] = yaws
    replayer, cost = Replayer(robot, len(yaws), rack=False, torques=False), np.zeros(len(yaws))
    for log in standing:
        part = log.until(SECONDS)
        told = imu_of(replayer.run(segment_from_log(part, robot), tried.rows(np.arange(len(yaws)))))
        cost += np.nan_to_num(np.sum((told - part.imu)[:, :, :2] ** 2, axis=(1, 2)), nan=np.inf)
    return yaws[int(np.argmin(cost))]


def _searched(model: LogModel, generations: int, seed: int, report: FitProgress) -> Array:
    """Return values (n,) by CMA-ES over the unknowns that all motors share, in units of what is known beforehand.

    Raises:
        SurefootError: all unknowns are of one motor or axis each.
    """
    import cma

    unknowns: Sequence[Unknown] = model.unknowns
    shared = [i for i, unknown in enumerate(unknowns) if unknown.index is None]
    if not shared:
        raise SurefootError("a search looks for what all motors share, and nothing of that is to be found")
    starts = np.array([unknown.start for unknown in unknowns])
    spread = np.array([unknown.prior or 1.0 for unknown in unknowns])
    low, high = (np.array([getattr(unknown, end) for unknown in unknowns]) for end in ("low", "high"))
    options = {"seed": seed or 1, "popsize": _POPULATION, "maxiter": generations, "verbose": -9}
    evolution = cma.CMAEvolutionStrategy(np.zeros(len(shared)), 0.5, options)
    best, least = starts, np.inf
    while not evolution.stop():
        steps = np.array(evolution.ask())
        tried = np.tile(starts, (len(steps), 1))
        tried[:, shared] += steps * spread[shared]
        tried = np.clip(tried, low, high)
        costs = np.sum(model.residuals(tried) ** 2, axis=1) + np.sum(steps**2, axis=1)
        evolution.tell(list(steps), costs.tolist())
        if costs.min() < least:
            best, least = tried[int(np.argmin(costs))], float(costs.min())
        report(f"search, generation {evolution.countiter}", least / len(model.blocks))
    return best


def _estimates(
    robot: RobotDescription, known: PhysicalParams, found: PhysicalParams, fit: Fit
) -> list[ParameterEstimate]:
    """Return an estimate of each physical parameter that the unknowns change, with deviations carried over to it."""
    unknowns, count = fit.unknowns, len(fit.unknowns)
    steps = np.array([unknown.step for unknown in unknowns])
    moved = params_of_logs(known, unknowns, fit.values + np.diag(steps))
    names = {unknown.name for unknown in unknowns}
    changed = [name for name in PhysicalParams.names() if name in names]
    changed += ["servo_kd"] if names & {RATIO, "servo_kp"} else []
    changed += ["motor_friction"] if FRICTION_RATIO in names and "motor_friction" not in names else []
    estimates = []
    for name in dict.fromkeys(changed):
        value, others = getattr(found, name)[0], getattr(moved, name)
        slopes = (others - value).reshape(count, -1) / steps[:, None]
        variances = np.einsum("in,ij,jn->n", slopes, fit.covariance, slopes)
        values = np.atleast_1d(value)
        # What is one number for all motors stays one.
        alike = len(values) == 1 or (np.ptp(values) == 0 and np.ptp(slopes, axis=1).max() == 0)
        for index in [None] if alike else range(len(values)):
            place = index or 0
            if name == "base_offset" and place == 2:
                continue
            estimates.append(
                ParameterEstimate.within_bounds(
                    robot, name, float(values[place]), float(np.sqrt(variances[place])), index
                )
            )
    return estimates


def _checks(
    robot: RobotDescription, runs: Sequence[LogRun], fitted: int, known: PhysicalParams, found: PhysicalParams
) -> tuple[list[Check], list[Series]]:
    """Return errors of whole logs with what was known and what was found, and a joint of each over time."""
    replayers = {rack: Replayer(robot, 1, rack, torques=False) for rack in {run.rack for run in runs}}
    checks, series = [], []
    for number, run in enumerate(runs):
        before, after = (
            replay_log(run.log, robot, params.rows(np.zeros(1, np.int64)), replayers[run.rack])
            for params in (known, found)
        )
        what = f"{run.log.name}, {'fitted' if number < fitted else 'held out'}"
        checks.append(Check(what, before.rms, after.rms, "rad"))
        motor = int(np.argmax(np.where(run.log.moving, after.by_motor, -1.0)))
        shown = run.log.until(_SHOWN)
        rows, angles = slice(0, len(shown.time)), shown.motor_angle[:, motor]
        was, now = (angles + one.motor_angle[rows, motor] for one in (before, after))
        title = f"{robot.motor_names[motor]}, {what}"
        series.append(Series(title, "time [s]", "angle [rad]", shown.read_time, angles, was, now))
    return checks, series


def _notes(fit: Fit) -> tuple[str, ...]:
    open_ = [unknown.label for unknown, told in zip(fit.unknowns, fit.identifiable, strict=True) if not told]
    notes = []
    if open_:
        notes.append(f"the logs hardly tell {', '.join(open_)}: their intervals are what was known beforehand")
    at = [
        unknown.label
        for unknown, value in zip(fit.unknowns, fit.values, strict=True)
        if min(value - unknown.low, unknown.high - value) < 1e-6 * (unknown.high - unknown.low)
    ]
    if at:
        notes.append(f"at the end of what is tried: {', '.join(at)}")
    return tuple(notes)
