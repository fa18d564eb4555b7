"""Poses between gaits, and the way from one to the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.robot import RobotDescription

_ASIDE = 0.3
"""Swing [rad] beyond which a leg lies beside the body."""


def sitting_pose(robot: RobotDescription) -> Array:
    """Return the motor angles (M,) [rad] of the robot when it sits."""
    return robot.pose_angles(*robot.poses.sit)


def lying_pose(robot: RobotDescription, angles: ArrayLike) -> Array:
    """Return the motor angles (M,) [rad] with which legs lie beside a body on its belly, from how they came to lie.

    Legs that slid out to one side stay on it: unfolded flat they move freely, and can then be drawn in from there. Legs
    under the body are put as in `sitting_pose`; so are all legs of a robot whose sheet has no `poses.spread`.
    """
    swing = robot.to_pose(angles)[-2]
    *first, rest, extension = robot.poses.sit
    aside = (np.abs(swing) > _ASIDE) & (robot.poses.spread is not None)
    return robot.pose_angles(*first, np.where(aside, (robot.poses.spread or 0.0) * np.sign(swing), rest), extension)


def minimum_jerk(start: ArrayLike, end: ArrayLike, share: float) -> Array:
    """A pose on the way from `start` to `end`, at a share of the time from 0 to 1.

    The fifth-order polynomial of least jerk: speed and acceleration are 0 at both ends (Flash and Hogan 1985).
    """
    s = min(max(share, 0.0), 1.0)
    first, last = np.asarray(start, float), np.asarray(end, float)
    blend: Array = first + (last - first) * (s**3 * (10.0 - 15.0 * s + 6.0 * s * s))
    return blend
