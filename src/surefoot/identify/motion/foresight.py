"""What logs will tell, before any fit: the deviations that a fit would leave, from the Jacobian at the prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from surefoot.arrays import Array
from surefoot.identify.fitting import Fit, forward_jacobian
from surefoot.identify.motion.priors import default_names, drop_known
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.robot_estimates import robot_estimates
from surefoot.identify.motion.robot_model import robot_model
from surefoot.identify.motion.robot_unknowns import considered_unknowns, robot_unknowns
from surefoot.identify.motion.words import describe_ambiguities
from surefoot.identify.plan import Plan
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.identify.result import ParameterEstimate
from surefoot.robot import PhysicalParams, RobotDescription

EXPECTED_NOISE = 0.02
"""Standard deviation of angles [rad] that counts for a fit: what a model that is a little wrong leaves, and for how
many rows it keeps its sign. A real Go2's log had 0.025, a simulated one 0.004."""
PERIOD = 0.005
"""Time between two rows of a planned motion [s]."""


@dataclass(frozen=True)
class ExpectedAccuracy:
    """What a fit to logs would know."""

    estimates: tuple[ParameterEstimate, ...]
    """Prior values with the deviations that the fit would leave."""
    sentences: tuple[str, ...]
    """What would stay unknown, in words."""


def predict_accuracy(
    robot: RobotDescription, motions: Sequence[RecordedMotion], prior: PhysicalParams, known: Sequence[str] = ()
) -> ExpectedAccuracy:
    """Return what logs of a hanging robot would tell, if it were as before (one row).

    Args:
        robot: its description.
        motions: logs, of which commands and times count; readings are simulated where they are missing.
        prior: parameters before.
        known: parameters that are known exactly, such as gains that are stated.
    """
    names = drop_known(default_names(robot, True), known)
    unknowns = robot_unknowns(robot, prior, names, True)
    logs = [_simulated(robot, motion, prior) for motion in motions]
    considered = considered_unknowns(robot, prior, logs)
    everything = (*unknowns, *considered)
    model = robot_model(robot, logs, everything, prior, None, [EXPECTED_NOISE] * len(logs))
    values = np.array([unknown.start for unknown in everything])
    residuals = model.residuals(values[None])[0]
    jacobian = forward_jacobian(model, values, residuals)
    deviation = np.array([unknown.prior_deviation for unknown in everything])
    covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian + np.diag(deviation**-2.0)), np.float64)
    held = np.zeros(len(values), np.bool_)
    held[len(unknowns) :] = True
    fit = Fit(everything, values, covariance, residuals, jacobian, held, True)
    held[: len(unknowns)] = ~fit.identifiable[: len(unknowns)]
    fit = replace(fit, held=held)
    return ExpectedAccuracy(tuple(robot_estimates(robot, prior, prior, fit)), describe_ambiguities(robot, fit, prior))


def planned_motion(plan: Plan) -> RecordedMotion:
    """Return the commands of a plan's phases that are fitted, in their order with what lies between, as a log."""
    used = [k for k, phase in enumerate(plan.phases) if phase.use == "fit"]
    rows: list[Array] = []
    last = 0.5 * (plan.angle_low + plan.angle_high)
    for phase in plan.phases[used[0] : used[-1] + 1]:
        start = last
        for k in range(round(phase.duration / PERIOD)):
            last = phase.signal(k * PERIOD, start)
            rows.append(last)
    command = np.array(rows)
    # A little unevenness: a clock that is measured.
    time = PERIOD * np.arange(len(command)) + 1e-4 * (np.arange(len(command)) % 2)
    return RecordedMotion(f"{plan.experiment} plan", time, command, time, rack=True)


def _simulated(robot: RobotDescription, motion: RecordedMotion, prior: PhysicalParams) -> RecordedMotion:
    """Return a log with the readings of a robot as before, where it has none."""
    if np.isfinite(motion.motor_angle).any():
        return motion
    readings = Replayer(robot, 1, motion.rack, torques=False).run(segment_from_motion(motion, robot), prior)
    return replace(motion, motor_angle=readings.motor_angle[0])
