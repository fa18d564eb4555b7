"""Physical parameters of a robot with joint actuators from its logs: commands and angles, without torques or speeds.

The fit is least squares over whole simulated robots (`identify.motion.robot_model`); a search by CMA-ES may precede it,
where the start is far off. Held-out logs show how well the identified robot moves in ways that were not fitted.

What a log does not determine keeps its value: such unknowns are held and the others fitted again, so that the values
that are written belong together. What is never fitted, but not known exactly either (the servos' latency, the law of
friction at turning points, the clock), widens the intervals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.errors import SurefootError
from surefoot.identify.fitting import Fit, fit_least_squares, hold_unidentifiable
from surefoot.identify.model import ReplayModel
from surefoot.identify.motion.motion_digest import all_digest, motion_digest
from surefoot.identify.motion.priors import GAINS, default_names, gains_are_commanded, drop_known
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import imu_channels, replay_motion
from surefoot.identify.motion.robot_estimates import robot_estimates
from surefoot.identify.motion.robot_model import SECONDS, correlated_noise, fitted_part, robot_model
from surefoot.identify.motion.robot_unknowns import considered_unknowns, robot_params, robot_unknowns
from surefoot.identify.motion.start_search import find_gains, search_start
from surefoot.identify.motion.verdict import diagnose_fit
from surefoot.identify.motion.words import describe_ambiguities
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.identify.result import Check, FitProgress, Identification, ParameterEstimate, Series, ignore_progress
from surefoot.robot import PhysicalParams, RobotDescription

IMU_YAW_CANDIDATES = (0.0, np.pi / 2, np.pi, -np.pi / 2)
"""Yaw of an IMU in the base [rad] that is tried."""
FIRST_NOISE = 0.005
"""Standard deviation of angles in the first round of a fit to logs on a rack [rad]; later that of the residuals. It is
small: a fit that its priors hold would leave residuals that confirm a large one."""
MAX_ROUNDS = 3
NOISE_TOLERANCE = 1.25
"""Factor within which the residuals' noise agrees with the assumed one, so that no further round is needed."""
_MOUNT_DEVIATION = 0.05
_SHOWN = 3.0


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
        robot: its description.
        motions: logs to fit.
        held_out: logs that are replayed with the estimates, and not fitted.
        names: which numbers to identify, of `priors.PRIORS`; if not given, those that such logs can show.
        prior: parameters before, one row.
        seconds: how much of each log is fitted, from its start; if not given, see `robot_model.fitted_part`.
        search: generations of CMA-ES before the fit, over numbers that all motors share.
        seed: of the search.
        report: callback with the fit's progress.
        known: parameters whose prior values are exact, such as gains that were stated.

    Raises:
        SurefootError: unknown names, no logs, or another kind of robot.
    """
    if robot.actuator.kind != "joint":
        raise SurefootError(
            f"the motors of {robot.name} are of kind {robot.actuator.kind}; logs are fitted for joint actuators"
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
    stated = {name: np.unique(getattr(prior, name)[0]).tolist() for name in GAINS if name in known}
    parts = {one.name: motion_digest(one) for one in [*motions, *held_out]}
    return Identification(
        "logs",
        robot.name,
        tuple(estimates),
        checks,
        notes=(*describe_ambiguities(robot, fit, params), *_notes(fit)),
        series=series,
        digest=all_digest([*motions, *held_out]),
        parts=parts,
        gains=_gains(params, [*wanted, *known]) if gains_are_commanded(robot) else {},
        stated_gains=tuple(stated),
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
    """Return the fit, with what logs do not determine held; its covariance includes what is known of that before."""
    unknowns = robot_unknowns(robot, prior, names, rack)
    if not rack:
        model, start = robot_model(robot, motions, unknowns, prior, seconds), None
        if search[0]:
            start = search_start(model, *search, report)
        fit = fit_least_squares(model, start, lambda step, cost: report(f"step {step}", cost))
        # Narrow priors of a sheet stand for what such logs do not tell: holding that made held-out errors larger.
        return fit if robot.priors else hold_unidentifiable(model, fit)
    considered = considered_unknowns(robot, prior, motions)
    noise = [FIRST_NOISE] * len(motions)
    start = find_gains(robot, motions, unknowns, prior, report)
    for number in range(MAX_ROUNDS):
        model = robot_model(robot, motions, [*unknowns, *considered], prior, seconds, noise)
        some = _hold_last(model, len(considered))
        if search[0] and number == 0:
            start = search_start(some, *search, report)
        fit = fit_least_squares(some, start, lambda step, cost: report(f"step {step}", cost))
        start, found = fit.values, correlated_noise(model, fit.residuals, noise)
        same = [max(one / two, two / one) for one, two in zip(found, noise, strict=True)]
        if max(same) < NOISE_TOLERANCE:
            break
        noise = found
    return hold_unidentifiable(model, fit, considered, lambda step, cost: report(f"held, step {step}", cost))


def _hold_last(model: ReplayModel, last: int) -> ReplayModel:
    """Return the model with its last unknowns held."""
    free = np.ones(len(model.unknowns), np.bool_)
    free[len(free) - last :] = False
    return model.holding(free, np.array([unknown.start for unknown in model.unknowns]))


def find_imu_yaw(robot: RobotDescription, motions: Sequence[RecordedMotion], prior: PhysicalParams) -> float | None:
    """Return the yaw of `IMU_YAW_CANDIDATES` that fits the IMU's roll and pitch best; None if no log on the ground has them."""
    low, high = robot.allowed["imu_mount"]
    yaws = [yaw for yaw in IMU_YAW_CANDIDATES if low <= yaw <= high]
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


def _checks(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    fitted: int,
    prior: PhysicalParams,
    params: PhysicalParams,
    seconds: float | None,
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """Return errors of whole logs with the prior parameters and with the estimates, and a joint of each over time."""
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
        motor = int(np.argmax(np.where(motion.moving, after.by_motor, -1.0)))
        shown = motion.until(_SHOWN)
        rows, angles = slice(0, len(shown.time)), shown.motor_angle[:, motor]
        was, now = (angles + one.motor_angle[rows, motor] for one in (before, after))
        labels = f"{robot.motor_names[motor]}, {what}", "time [s]", "angle [rad]"
        series.append(Series(*labels, shown.read_time, angles, was, now))
    return tuple(checks), tuple(series)


def _notes(fit: Fit) -> tuple[str, ...]:
    at_bound = [
        unknown.label
        for unknown, value in zip(np.array(fit.unknowns)[fit.free], fit.values[fit.free], strict=True)
        if min(value - unknown.low, unknown.high - value) < 1e-6 * (unknown.high - unknown.low)
    ]
    return (f"at a bound: {', '.join(at_bound)}",) if at_bound else ()
