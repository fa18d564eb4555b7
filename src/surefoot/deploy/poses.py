"""Poses between gaits, and the way from one to the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.robot import RobotDescription

SIT_EXTENSION = 0.9
"""Extension [rad] of all legs when the robot sits: low enough to fall from unharmed when its motors are let go."""

SPREAD_SWING = 1.2
"""Swing [rad] of legs that lie beside the body: about as far as they slide when motors are let go."""
_ASIDE = 0.3


def pose(robot: RobotDescription, swing: ArrayLike, extension: ArrayLike) -> Array:
    """Motor angles (M,) [rad] of legs with swing and extension [rad], of each (L,) or of all alike."""
    legs = len(robot.legs)
    return robot.leg_to_motor_angles(np.full(legs, swing), np.full(legs, extension))


def sitting(robot: RobotDescription) -> Array:
    """Motor angles (M,) [rad] of the robot when it sits; its extension is kept within what its legs allow."""
    low, high = robot.extension_range
    return pose(robot, 0.0, float(np.clip(SIT_EXTENSION, low, high)))


def lying(robot: RobotDescription, angles: ArrayLike) -> Array:
    """Motor angles (M,) [rad] with which legs lie beside a body on its belly, from how they came to lie.

    Legs that slid out to one side stay on it: unfolded flat they move freely, and can then be drawn in from there. Legs
    under the body are put as in `sitting`.
    """
    swing, _ = robot.motor_to_leg_pose(angles)
    low, high = robot.extension_range
    flat = np.where(np.abs(swing) > _ASIDE, SPREAD_SWING * np.sign(swing), 0.0)
    return robot.leg_to_motor_angles(flat, np.full(len(robot.legs), np.clip(SIT_EXTENSION, low, high)))


def between(start: ArrayLike, end: ArrayLike, share: float) -> Array:
    """A pose on the way from `start` to `end`, at a share of the time from 0 to 1.

    The fifth-order polynomial of least jerk: speed and acceleration are 0 at both ends (Flash and Hogan 1985).
    """
    s = min(max(share, 0.0), 1.0)
    first, last = np.asarray(start, float), np.asarray(end, float)
    blend: Array = first + (last - first) * (s**3 * (10.0 - 15.0 * s + 6.0 * s * s))
    return blend
