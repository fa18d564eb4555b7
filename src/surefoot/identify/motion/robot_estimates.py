"""Estimates of physical parameters from a fit to logs, with standard deviations by the delta method.

Many parameters are products of a value that motors share and a ratio of each motor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from surefoot.arrays import Array
from surefoot.identify.fitting import Fit
from surefoot.identify.motion.priors import DAMPING_RATIO, RATIOS, gains_are_commanded
from surefoot.identify.motion.robot_unknowns import robot_params
from surefoot.identify.result import ParameterEstimate
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS

MODEL_ACCURACY = {
    "motor_friction": 0.25,
    "motor_viscous_friction": 0.25,
    "rotor_inertia": 0.12,
    "servo_kp": 0.02,
    "servo_kd": 0.1,
    "leg_mass_ratio": 0.01,
}
"""Standard deviation of model errors in estimates from logs, relative to the larger of the data sheet's and the
estimated value. Friction models that build up over another speed divide friction differently between Coulomb and
viscous; MuJoCo's own model has up to half less Coulomb friction in calves. The values were chosen on the synthetic logs
1 to 5 of `benchmarks/identification_logs.py`."""

FRICTION_EXCHANGE = 0.5
"""Model error of Coulomb friction [N m] per viscous friction [N m s/rad]: if friction builds up over speeds like the
joint's own, as MuJoCo's model does in calves, a fit mistakes Coulomb for viscous friction."""
LATENCY_ACCURACY = 0.75
"""Model error of the latency in servo steps: simulators disagree on when in a step a command acts."""


def robot_estimates(
    robot: RobotDescription, prior: PhysicalParams, params: PhysicalParams, fit: Fit
) -> list[ParameterEstimate]:
    """Return the estimates of all physical parameters that depend on the fitted unknowns.

    Args:
        robot: robot description.
        prior: parameters before the fit, one row.
        params: parameters after the fit, one row.
        fit: result of `fitting.hold_unidentifiable`.
    """
    commanded = gains_are_commanded(robot)
    estimates = []
    for name in _affected_parameters(fit):
        value = getattr(params, name)[0]
        slopes = parameter_slopes(prior, fit, name)
        determined = np.any(np.abs(slopes[fit.free]) > 0, axis=0)
        variances = np.einsum("in,ij,jn->n", slopes, fit.covariance, slopes)
        values = np.atleast_1d(value)
        same = np.ptp(values) == 0 and np.ptp(slopes, axis=1).max() == 0
        indices: Sequence[int | None] = [None] if len(values) == 1 or same else range(_count(name, values))
        for index in indices:
            number, deviation = float(values[index or 0]), float(np.sqrt(variances[index or 0]))
            if fit.considered:
                size = max(abs(number), abs(float(np.atleast_1d(getattr(prior, name)[0])[index or 0])))
                size = abs(number) if name in GAINS else size
                floor = MODEL_ACCURACY.get(name, 0.0) * size
                if name == "control_latency":
                    floor = LATENCY_ACCURACY * robot.timing.servo_step
                if name == "motor_friction":
                    viscous = float(params.motor_viscous_friction[0, index or 0])
                    floor = float(np.hypot(floor, FRICTION_EXCHANGE * viscous))
                deviation = float(np.hypot(deviation, floor))
            item = ParameterEstimate.within_bounds(robot, name, number, deviation, index, bool(determined[index or 0]))
            estimates.append(replace(item, of_robot=not (commanded and name in GAINS)))
    return estimates


def _count(name: str, values: Array) -> int:
    return 2 if name == "base_offset" else len(values)


def _affected_parameters(fit: Fit) -> list[str]:
    """Return the names of the physical parameters that depend on the unknowns, in the order of `PhysicalParams`."""
    names = {RATIOS.get(unknown.name, unknown.name) for unknown in fit.candidates}
    if DAMPING_RATIO in names:
        names |= {"servo_kd"}
    return [name for name in PhysicalParams.names() if name in names]


def parameter_slopes(prior: PhysicalParams, fit: Fit, name: str) -> Array:
    """Return the derivatives of a parameter with respect to the n unknowns (n, size)."""
    steps = np.array([unknown.step for unknown in fit.unknowns])
    value = getattr(robot_params(prior, fit.unknowns, fit.values[None]), name)[0]
    perturbed = getattr(robot_params(prior, fit.unknowns, fit.values + np.diag(steps)), name)
    return np.asarray((perturbed - value).reshape(len(steps), -1) / steps[:, None])
