"""Ground reaction forces on the feet, estimated from motor torques."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.robot import RobotDescription


def foot_forces(robot: RobotDescription, motor_angle: ArrayLike, motor_torque: ArrayLike) -> Array:
    """Estimate the ground reaction forces on the feet, (..., L, 3) [N] in the base frame.

    The legs are assumed to be massless: the torques (..., M) [N m] of a leg's motors at angles (..., M) [rad] balance
    the force on its foot, J' F = -tau. Estimates for feet in the air therefore contain the legs' inertia. A leg with
    two motors does not measure the force normal to its plane, which is set to 0. NaN angles or torques give NaN.
    """
    legs, index = robot.leg_geometry, robot.leg_motor_index
    angles, torques = (np.asarray(values, float)[..., index] for values in (motor_angle, motor_torque))
    valid = (np.isfinite(angles).all(-1) & np.isfinite(torques).all(-1) & legs.is_feasible(angles))[..., None]
    kinematics = legs.foot_kinematics(np.where(valid, angles, robot.resting_angles[index]))
    return np.where(valid, kinematics.force(np.where(valid, torques, 0.0)), np.nan)
