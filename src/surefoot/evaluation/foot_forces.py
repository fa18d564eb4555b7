"""Ground reaction forces on the feet, estimated from motor torques."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.robot import RobotDescription

_SINGULAR = 0.02
"""Relative cutoff of singular values of a leg's Jacobian: directions with less leverage, such as along a straight leg,
are left out."""


def foot_forces(robot: RobotDescription, motor_angle: ArrayLike, motor_torque: ArrayLike) -> Array:
    """Estimate the ground reaction forces on the feet, (..., L, 3) [N] in the base frame.

    The legs are assumed to be massless: the torques (..., M) [N m] of a leg's motors at angles (..., M) [rad] balance
    the force on its foot, J' F = -tau. Estimates for feet in the air therefore contain the legs' inertia. A leg with
    two motors does not measure the force normal to its plane, which is set to 0. NaN angles or torques give NaN.
    """
    index = robot.leg_motor_index
    angles, torques = (np.asarray(values, float)[..., index] for values in (motor_angle, motor_torque))
    valid = np.isfinite(angles).all(-1) & np.isfinite(torques).all(-1) & robot.leg_geometry.is_feasible(angles)
    rest = robot.resting_angles[index]
    lever = np.swapaxes(robot.leg_geometry.jacobian(np.where(valid[..., None], angles, rest)), -1, -2)
    force = -np.einsum(
        "...ij,...j->...i", np.linalg.pinv(lever, rcond=_SINGULAR), np.where(valid[..., None], torques, 0)
    )
    return np.where(valid[..., None], force, np.nan)
