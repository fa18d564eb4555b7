"""Forces of the ground on the feet, estimated from the motors' torques."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.robot import RobotDescription

_SINGULAR = 0.02
"""Directions in which a leg's leverage is below this share of its best are left out, as that along a straight leg."""


def foot_forces(robot: RobotDescription, motor_angle: ArrayLike, motor_torque: ArrayLike) -> Array:
    """Estimate the forces of the ground on the feet, (..., L, 3) [N] in the base frame.

    The legs are taken as massless: the torques (..., M) [N m] of a leg's motors at angles (..., M) [rad] then balance
    the force on its foot, J' F = -tau. So feet in the air show the legs' own inertia. Legs of two motors do not
    measure the force across their plane, which is 0. NaN where angles or torques are.
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
