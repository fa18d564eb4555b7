"""Least-squares model of logs of a robot with joint actuators: observations, unknowns and parameters.

Commands and angles are enough. Robots are simulated on the ground, or on a rack, for the first seconds of each log.

A parameter of each motor is a common value, times or plus a term of its own. Priors of these terms are narrow, so that
logs of some legs apply to the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, suggest
from surefoot.identify.model import Nuisance, Observations, ReplayModel, Unknown, candidate_params
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import imu_channels
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.robot import PhysicalParams, RobotDescription

MOVING_NOISE = 0.006
"""Standard deviation with which angles of joints that move are compared [rad]: readings of unknown age, at up to 3.8
rad/s, are off by as much."""
STILL_NOISE = 0.04
"""The same for joints that stand still: friction holds them where they came to rest before the log."""
TILT_NOISE = 0.03
"""The same for roll and pitch [rad]."""
START_NOISE = 2.0
"""Factor of all noise in the first `SKIPPED` seconds."""
SPACING = 0.011
"""Least time between rows that are compared [s]."""
SECONDS = 2.3
"""Length of each log that is fitted [s], from its start."""
BATCH = 20
"""Candidates that are simulated at once."""
MAX_RESIDUAL = 100.0
"""Residual of a candidate that diverges, in standard deviations."""
DAMPING_RATIO = "damping_ratio"
"""servo_kd over servo_kp [s], which determines how far a joint lags behind its command."""
FRICTION_RATIO = "friction_ratio"
"""Coulomb friction of one motor over that of all."""


@dataclass(frozen=True)
class Prior:
    """Prior distribution of a number, and the step of its finite differences."""

    deviation: float
    """Standard deviation; relative to the start, if `relative`."""
    relative: bool = True
    each: bool = False
    """Whether each motor or axis has its own value."""
    step: float = 0.02
    """Of finite differences, in the unit of `deviation`."""
    start: float | None = None
    """Mean; the parameter before the fit, if not given."""


PRIORS = {
    "servo_kp": Prior(0.1),
    DAMPING_RATIO: Prior(0.05),
    "motor_friction": Prior(0.7),
    FRICTION_RATIO: Prior(0.1, each=True, step=0.05),
    "load_friction": Prior(0.3),
    "motor_viscous_friction": Prior(1.0, step=0.1),
    "speed_filter": Prior(0.5),
    "rotor_inertia": Prior(0.4),
    "torque_limit": Prior(0.2, step=0.05),
    "control_latency": Prior(0.5),
    "motor_offset": Prior(0.008, relative=False, each=True, step=0.004),
    "base_mass_ratio": Prior(0.01),
    "base_offset": Prior(0.005, relative=False, each=True, step=0.002),
    "leg_mass_ratio": Prior(0.05),
    "contact_friction": Prior(0.3),
    "contact_stiffness": Prior(0.5, step=0.05),
    "contact_shear_ratio": Prior(0.7, step=0.05, start=0.2),
}
"""Numbers that logs can identify. Masses are known to some percent, actuators as their sheet or a first fit has them,
encoders to half a degree: with a wider prior of encoders, parameters from two logs of some legs were wrong for other
legs, and errors of held-out logs grew. Legs bend sideways: feet start softer along the ground."""
_MIN_START = {"motor_viscous_friction": 0.005, "load_friction": 0.1, "speed_filter": 0.005}
"""Start of parameters that a data sheet has as 0."""
_MAX_FACTOR = 8.0
"""Bound of numbers with a relative prior, as a factor of their start."""


def robot_unknowns(robot: RobotDescription, prior: PhysicalParams, names: Sequence[str]) -> list[Unknown]:
    """Return the unknowns of `names` of `PRIORS`, around the parameters before (one row).

    Raises:
        SurefootError: another name.
    """
    if bad := [name for name in names if name not in PRIORS]:
        raise SurefootError(f"logs can't identify '{bad[0]}'; {suggest(bad[0], PRIORS)}")
    unknowns = []
    for name in dict.fromkeys(names):
        rule, values = PRIORS[name], _prior_values(prior, name)
        low, high = robot.allowed.get(name, (0.0, np.inf))
        for index in range(len(values)) if rule.each else [None]:
            start = float(np.mean(values) if index is None else values[index]) if rule.start is None else rule.start
            if rule.relative:
                start = max(start, _MIN_START.get(name, 1e-6))
                least, most, size = start / _MAX_FACTOR, start * _MAX_FACTOR, start
                low = max(low, 0.0)
            else:
                least, most, size = start - 6 * rule.deviation, start + 6 * rule.deviation, 1.0
            bounds = max(low, least), min(high, most)
            unknowns.append(Unknown(name, start, *bounds, rule.step * size, index, rule.deviation * size))
    return unknowns


def _prior_values(prior: PhysicalParams, name: str) -> Array:
    if name == DAMPING_RATIO:
        return np.atleast_1d(np.mean(prior.servo_kd[0]) / np.mean(prior.servo_kp[0]))
    if name == FRICTION_RATIO:
        friction = prior.motor_friction[0]
        return friction / np.mean(friction) if np.mean(friction) > 0 else np.ones_like(friction)
    if name == "base_offset":
        return prior.base_offset[0, :2]  # its height does not affect such small motions
    return np.atleast_1d(getattr(prior, name)[0])


def robot_params(base: PhysicalParams, unknowns: Sequence[Unknown], values: Array) -> PhysicalParams:
    """Return one row of `base` for each of K candidates (K, n), with ratios applied."""
    params = candidate_params(base, unknowns, values)
    columns = {(unknown.name, unknown.index): values[:, i] for i, unknown in enumerate(unknowns)}
    if (DAMPING_RATIO, None) in columns:
        params.servo_kd[:] = params.servo_kp * columns[DAMPING_RATIO, None][:, None]
    elif ("servo_kp", None) in columns:
        params.servo_kd[:] = params.servo_kp * (base.servo_kd[0] / base.servo_kp[0])
    for (name, index), column in columns.items():
        if name == FRICTION_RATIO:
            params.motor_friction[:, index] *= column
    return params


def robot_model(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    unknowns: Sequence[Unknown],
    prior: PhysicalParams,
    seconds: float = SECONDS,
) -> ReplayModel:
    """Return the model of the first seconds of logs; all other parameters are as in the prior (one row)."""
    replayers = {rack: Replayer(robot, BATCH, rack, torques=False) for rack in {motion.rack for motion in motions}}
    observations = [_observations(robot, motion.until(seconds), replayers[motion.rack]) for motion in motions]
    return ReplayModel(unknowns, prior, observations, BATCH, MAX_RESIDUAL, robot_params)


def _observations(robot: RobotDescription, motion: RecordedMotion, replayer: Replayer) -> Observations:
    """Return a log's angles of motors, roll and pitch (n, M + 2) as observations."""
    rows, segment = _spaced_rows(motion), segment_from_motion(motion, robot)
    recorded = np.concatenate([motion.motor_angle, motion.imu[:, :2]], axis=1)[rows]

    def errors(params: PhysicalParams, nuisance: Nuisance) -> Array:
        readings = replayer.run(segment, params)
        errors = np.concatenate([readings.motor_angle, imu_channels(readings)[:, :, :2]], axis=2)[:, rows] - recorded
        # Attitudes of such IMUs drift from log to log: only their change is compared.
        errors[:, :, -2:] -= errors[:, :, -2:].mean(axis=1, keepdims=True)
        return errors

    # Readings of joints that hang still do not depend on the parameters.
    still, tilt = (np.inf, np.inf) if motion.rack else (STILL_NOISE, TILT_NOISE)
    noise = np.concatenate([np.where(motion.moving, MOVING_NOISE, still), [tilt, tilt]])
    early = ~motion.counted[rows]
    noise = np.where(early[:, None], START_NOISE, 1.0) * noise
    return Observations(errors, np.where(np.isfinite(recorded), noise, np.inf), motion.time[rows][:, None])


def _spaced_rows(motion: RecordedMotion) -> NDArray[np.int64]:
    """Return rows of new readings that are `SPACING` or more apart."""
    kept, last = [], -np.inf
    for row in np.flatnonzero(motion.fresh).tolist():
        if motion.read_time[row] - last >= SPACING:
            kept.append(row)
            last = motion.read_time[row]
    return np.array(kept, np.int64)
