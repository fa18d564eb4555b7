"""Poses between gaits, and a smooth motion from one to another."""

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
    """Return the motor angles (M,) [rad] of legs that lie flat beside the body, on the side of `angles` (M,).

    From there they move freely and can be drawn in. Legs under the body get the pose of `sitting_pose`; so do all legs
    of a robot whose sheet has no `poses.spread`.
    """
    swing = robot.to_pose(angles)[-2]
    *first, rest, extension = robot.poses.sit
    aside = (np.abs(swing) > _ASIDE) & (robot.poses.spread is not None)
    return robot.pose_angles(*first, np.where(aside, (robot.poses.spread or 0.0) * np.sign(swing), rest), extension)


def minimum_jerk(start: ArrayLike, end: ArrayLike, share: float) -> Array:
    """Interpolate from `start` to `end` at a share of the time, clipped to 0 to 1 (Flash and Hogan 1985).

    start + (end - start) (10 s^3 - 15 s^4 + 6 s^5): speed and acceleration are 0 at both ends.
    """
    s = min(max(share, 0.0), 1.0)
    first, last = np.asarray(start, float), np.asarray(end, float)
    blend: Array = first + (last - first) * (s**3 * (10.0 - 15.0 * s + 6.0 * s * s))
    return blend
