"""Identification of a robot with joint actuators from logs of commands and angles, without torques or speeds.

The fit is a least-squares fit of whole-robot simulations (`identify.motion.robot_model`). A CMA-ES search may precede
it if the initial parameters are far off. Held-out logs show how well the fitted parameters predict other motions.

Parameters that a log does not determine are held at their prior values and the others are fitted again, so that the
written values are consistent. Parameters that are never fitted, but not known exactly (the latency of the servos,
friction at motion reversals, the clock), widen the intervals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.errors import SurefootError
from surefoot.identify.fitting import Fit, fit_least_squares, hold_unidentifiable
from surefoot.identify.model import ReplayModel
from surefoot.identify.motion.ambiguities import describe_ambiguities
from surefoot.identify.motion.fit_diagnosis import diagnose_fit
from surefoot.identify.motion.motion_digest import all_digest, motion_digest
from surefoot.identify.motion.priors import default_names, drop_known, gains_are_commanded
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import imu_channels, replay_motion
from surefoot.identify.motion.robot_estimates import robot_estimates
from surefoot.identify.motion.robot_model import GROUND_SECONDS, correlated_noise, fitted_part, robot_model
from surefoot.identify.motion.robot_unknowns import considered_unknowns, robot_params, robot_unknowns
from surefoot.identify.motion.start_search import find_gains, search_start
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.identify.result import Check, FitProgress, Identification, ParameterEstimate, Series, ignore_progress
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS

IMU_YAW_CANDIDATES = (0.0, np.pi / 2, np.pi, -np.pi / 2)
"""Candidates for the yaw of the IMU in the base frame [rad]."""
FIRST_NOISE = 0.005
"""Noise of angles in the first round of a fit to logs on a rack [rad]; later rounds use the noise of the residuals. It
starts small, because with large noise the priors dominate the fit, and its residuals would confirm the large noise."""
MAX_ROUNDS = 3
NOISE_TOLERANCE = 1.25
"""Maximum ratio between residual and assumed noise, in either direction, at which the rounds end."""
_MOUNT_DEVIATION = 0.05
_PLOT_TIME = 3.0
"""Length of the motion in the report's figure [s]."""


def fit_robot(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    held_out: Sequence[RecordedMotion],
    names: Sequence[str] | None,
    prior: PhysicalParams,
    seconds: float | None = None,
    search: int = 0,
    seed: int = 1,
    report: FitProgress = ignore_progress,
    known: Sequence[str] = (),
) -> Identification:
    """Identify physical parameters from logs of a robot.

    Args:
        robot: robot description.
        motions: logs to fit.
        held_out: logs that are not fitted but replayed with the estimates.
        names: parameters to identify, keys of `priors.PRIORS`. Defaults to the parameters that such logs can show.
        prior: parameters before the fit, one row.
        seconds: length of the fitted part of each log, from its start. Defaults as in `robot_model.fitted_part`.
        search: generations of CMA-ES before the fit, over parameters that all motors share.
        seed: seed of the search.
        report: callback with the progress of the fit.
        known: parameters whose prior values are exact, such as stated gains.

    Raises:
        SurefootError: a name is unknown, there are no logs, or the robot has other actuators.
    """
    if robot.actuator.kind != "joint":
        raise SurefootError(
            f"the motors of {robot.name} are of kind {robot.actuator.kind}; logs can be fitted for joint actuators only"
        )
    if not motions:
        raise SurefootError("there are no logs to fit; give one or more that are not held out")
    prior, rack = prior.rows(np.zeros(1, np.int64)), all(motion.rack for motion in motions)
    yaw = find_imu_yaw(robot, motions, prior)
    if yaw is not None:
        prior.imu_mount[0, 2] = yaw
    wanted = drop_known(default_names(robot, rack) if names is None else names, known)
    fit = _fit(robot, motions, wanted, prior, rack, seconds, (search, seed), report)
    params = robot_params(prior, fit.unknowns, fit.values[None])
    estimates = robot_estimates(robot, prior, params, fit)
    if yaw is not None:
        estimates.append(ParameterEstimate.within_bounds(robot, "imu_mount", yaw, _MOUNT_DEVIATION, 2))
    checks, series = _checks(robot, [*motions, *held_out], len(motions), prior, params, seconds)
    log_digests = {one.name: motion_digest(one) for one in [*motions, *held_out]}
    return Identification(
        "logs",
        robot.name,
        tuple(estimates),
        checks,
        notes=(*describe_ambiguities(fit, prior, params), *_notes(fit)),
        series=series,
        digest=all_digest([*motions, *held_out]),
        log_digests=log_digests,
        gains=_gains(params, [*wanted, *known]) if gains_are_commanded(robot) else {},
        stated_gains=tuple(name for name in GAINS if name in known),
        failure=diagnose_fit(robot, [fitted_part(one, seconds) for one in motions], params),
    )


def _gains(params: PhysicalParams, names: Sequence[str]) -> dict[str, list[float]]:
    return {name: getattr(params, name)[0].tolist() for name in GAINS if name in names}


def _fit(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    names: Sequence[str],
    prior: PhysicalParams,
    rack: bool,
    seconds: float | None,
    search: tuple[int, int],
    report: FitProgress,
) -> Fit:
    """Fit the unknowns; hold those that the logs do not determine, with their prior uncertainty in the covariance."""
    unknowns = robot_unknowns(robot, prior, names, rack)
    if not rack:
        model, start = robot_model(robot, motions, unknowns, prior, seconds), None
        if search[0]:
            start = search_start(model, *search, report)
        fit = fit_least_squares(model, start, lambda step, cost: report(f"step {step}", cost))
        # Narrow priors in the data sheet constrain what such logs do not determine; holding these parameters as well
        # made held-out errors larger.
        return fit if robot.priors else hold_unidentifiable(model, fit)
    considered = considered_unknowns(robot, prior, motions, unknowns)
    noise = [FIRST_NOISE] * len(motions)
    start = find_gains(robot, motions, unknowns, prior, report)
    for number in range(MAX_ROUNDS):
        model = robot_model(robot, motions, [*unknowns, *considered], prior, seconds, noise)
        fitted_model = _hold_last(model, len(considered))
        if search[0] and number == 0:
            start = search_start(fitted_model, *search, report)
        fit = fit_least_squares(fitted_model, start, lambda step, cost: report(f"step {step}", cost))
        start, residual_noise = fit.values, correlated_noise(model, fit.residuals, noise)
        ratios = [max(one / two, two / one) for one, two in zip(residual_noise, noise, strict=True)]
        if max(ratios) < NOISE_TOLERANCE:
            break
        noise = residual_noise
    return hold_unidentifiable(model, fit, considered, lambda step, cost: report(f"held, step {step}", cost))


def _hold_last(model: ReplayModel, last: int) -> ReplayModel:
    """Return the model with its last unknowns held at their start values."""
    free = np.ones(len(model.unknowns), np.bool_)
    free[len(free) - last :] = False
    return model.restrict(free, np.array([unknown.start for unknown in model.unknowns]))


def find_imu_yaw(robot: RobotDescription, motions: Sequence[RecordedMotion], prior: PhysicalParams) -> float | None:
    """Return the yaw of the IMU that fits its roll and pitch best, or None if no log on the ground has them."""
    low, high = robot.allowed["imu_mount"]
    yaws = [yaw for yaw in IMU_YAW_CANDIDATES if low <= yaw <= high]
    standing = [
        one.first_seconds(GROUND_SECONDS)
        for one in motions
        if not one.rack and np.isfinite(one.imu[:, :2]).all(axis=1).any()
    ]
    measured = [(one, rows) for one in standing if (rows := np.isfinite(one.imu[:, :2]).all(axis=1)).any()]
    if not measured or len(yaws) < 2:
        return None
    candidates = prior.rows(np.zeros(len(yaws), np.int64))
    candidates.imu_mount[:, 2] = yaws
    replayer, cost = Replayer(robot, len(yaws), rack=False, torques=False), np.zeros(len(yaws))
    for motion, rows in measured:
        readings = imu_channels(replayer.run(segment_from_motion(motion, robot), candidates))
        cost += np.nan_to_num(np.sum((readings - motion.imu)[:, rows, :2] ** 2, axis=(1, 2)), nan=np.inf)
    return yaws[int(np.argmin(cost))]


def _checks(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    fitted: int,
    prior: PhysicalParams,
    params: PhysicalParams,
    seconds: float | None,
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """Return the errors of whole logs with the prior and the estimated parameters, and curves of one joint per log."""
    replayers = {rack: Replayer(robot, 1, rack, torques=False) for rack in {one.rack for one in motions}}
    checks, series = [], []
    for number, motion in enumerate(motions):
        before, after = (
            replay_motion(motion, robot, one.rows(np.zeros(1, np.int64)), replayers[motion.rack])
            for one in (prior, params)
        )
        used = float(np.ptp(fitted_part(motion, seconds).time)) if number < fitted else 0.0
        whole = float(np.ptp(motion.time))
        what = f"{motion.name}, " + (f"fitted: {used:.1f} of {whole:.1f} s" if number < fitted else "held out")
        checks.append(Check(what, before.rms, after.rms, "rad", fitted=number < fitted))
        motor = int(np.argmax(np.where(motion.moving_joints, after.by_motor, -1.0)))
        plotted = motion.rows(motion.time <= motion.time[0] + _PLOT_TIME)
        rows, angles = slice(0, len(plotted.time)), plotted.motor_angle[:, motor]
        prior_curve, fitted_curve = (angles + one.motor_angle[rows, motor] for one in (before, after))
        labels = f"{robot.motor_names[motor]}, {what}", "time [s]", "angle [rad]"
        series.append(Series(*labels, plotted.read_time, angles, prior_curve, fitted_curve))
    return tuple(checks), tuple(series)


def _notes(fit: Fit) -> tuple[str, ...]:
    at_bound = [
        unknown.label
        for unknown, value in zip(np.array(fit.unknowns)[fit.free], fit.values[fit.free], strict=True)
        if min(value - unknown.low, unknown.high - value) < 1e-6 * (unknown.high - unknown.low)
    ]
    return (f"at a bound: {', '.join(at_bound)}",) if at_bound else ()
