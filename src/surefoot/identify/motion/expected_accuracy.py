"""Accuracy that a fit to logs can reach, predicted before the fit from the Jacobian at the prior parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from surefoot.arrays import Array
from surefoot.identify.fitting import Fit, forward_jacobian
from surefoot.identify.motion.ambiguities import describe_ambiguities
from surefoot.identify.motion.priors import default_names, drop_known
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.robot_estimates import robot_estimates
from surefoot.identify.motion.robot_model import robot_model
from surefoot.identify.motion.robot_unknowns import considered_unknowns, robot_unknowns
from surefoot.identify.plan import Plan
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.identify.result import ParameterEstimate
from surefoot.robot import PhysicalParams, RobotDescription

EXPECTED_NOISE = 0.02
"""Expected standard deviation of angle residuals [rad], including the effect of their correlation in time, as in
`robot_model.correlated_noise`. A log of a real Go2 had 0.025, a simulated log 0.004."""
PERIOD = 0.005
"""Time between two rows of a planned motion [s]."""


@dataclass(frozen=True)
class ExpectedAccuracy:
    """Expected accuracy of a fit to logs."""

    estimates: tuple[ParameterEstimate, ...]
    """Prior values with the standard deviations expected after the fit."""
    sentences: tuple[str, ...]
    """Sentences on the parameters that the logs would not determine."""


def predict_accuracy(
    robot: RobotDescription, motions: Sequence[RecordedMotion], prior: PhysicalParams, known: Sequence[str] = ()
) -> ExpectedAccuracy:
    """Predict the accuracy of a fit to logs of a hanging robot, assuming that the prior parameters are true.

    Args:
        robot: robot description.
        motions: logs or planned motions. Only commands and times matter; missing readings are simulated.
        prior: parameters before the fit, one row.
        known: names of parameters that are known exactly, such as stated gains.
    """
    names = drop_known(default_names(robot, True), known)
    unknowns = robot_unknowns(robot, prior, names, True)
    logs = [_simulate_readings(robot, motion, prior) for motion in motions]
    considered = considered_unknowns(robot, prior, logs, unknowns)
    all_unknowns = (*unknowns, *considered)
    model = robot_model(robot, logs, all_unknowns, prior, None, [EXPECTED_NOISE] * len(logs))
    values = np.array([unknown.start for unknown in all_unknowns])
    residuals = model.residuals(values[None])[0]
    jacobian = forward_jacobian(model, values, residuals)
    deviation = np.array([unknown.prior_deviation for unknown in all_unknowns])
    covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian + np.diag(deviation**-2.0)), np.float64)
    held = np.zeros(len(values), np.bool_)
    held[len(unknowns) :] = True
    fit = Fit(all_unknowns, values, covariance, residuals, jacobian, held, len(considered))
    held[: len(unknowns)] = ~fit.identifiable[: len(unknowns)]
    fit = replace(fit, held=held)
    return ExpectedAccuracy(tuple(robot_estimates(robot, prior, prior, fit)), describe_ambiguities(fit, prior, prior))


def planned_motion(plan: Plan) -> RecordedMotion:
    """Return the commands of a plan from its first to its last fitted phase, as a log without readings."""
    used = [k for k, phase in enumerate(plan.phases) if phase.use == "fit"]
    rows: list[Array] = []
    last = 0.5 * (plan.angle_low + plan.angle_high)
    for phase in plan.phases[used[0] : used[-1] + 1]:
        start = last
        for k in range(round(phase.duration / PERIOD)):
            last = phase.signal(k * PERIOD, start)
            rows.append(last)
    command = np.array(rows)
    # Slightly uneven times, so that the clock counts as measured and not as computed.
    time = PERIOD * np.arange(len(command)) + 1e-4 * (np.arange(len(command)) % 2)
    return RecordedMotion(f"{plan.experiment} plan", time, command, time, rack=True)


def _simulate_readings(robot: RobotDescription, motion: RecordedMotion, prior: PhysicalParams) -> RecordedMotion:
    """Return a log with motor angles, simulated with the prior parameters if it has none."""
    if np.isfinite(motion.motor_angle).any():
        return motion
    readings = Replayer(robot, 1, motion.rack, torques=False).run(segment_from_motion(motion, robot), prior)
    return replace(motion, motor_angle=readings.motor_angle[0])
