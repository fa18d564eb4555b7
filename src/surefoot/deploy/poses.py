"""Sitting and lying poses, and smooth interpolation between poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.robot import RobotDescription

_MIN_SIDE_SWING = 0.3
"""Minimum swing of a leg that lies next to the body [rad]."""


def sitting_pose(robot: RobotDescription) -> Array:
    """Return the motor angles of the sitting pose (M,) [rad]."""
    return robot.pose_angles(*robot.poses.sit)


def lying_pose(robot: RobotDescription, angles: ArrayLike) -> Array:
    """Return motor angles (M,) [rad] at which legs lie flat next to the body, on the side of `angles` (M,).

    From there they move freely and can be drawn in. Legs under the body get the sitting pose, and so do all legs of a
    robot whose data sheet has no `poses.spread`.
    """
    swing = robot.to_pose(angles)[-2]
    *first, rest, extension = robot.poses.sit
    beside_body = (np.abs(swing) > _MIN_SIDE_SWING) & (robot.poses.spread is not None)
    return robot.pose_angles(
        *first, np.where(beside_body, (robot.poses.spread or 0.0) * np.sign(swing), rest), extension
    )


def minimum_jerk(start: ArrayLike, end: ArrayLike, phase: float) -> Array:
    """Interpolate from `start` to `end` along a minimum-jerk trajectory (Flash and Hogan 1985).

    start + (end - start) (10 s^3 - 15 s^4 + 6 s^5), with the phase s clipped to 0 to 1. Speed and acceleration are 0 at
    both ends.
    """
    s = min(max(phase, 0.0), 1.0)
    first, last = np.asarray(start, float), np.asarray(end, float)
    blend: Array = first + (last - first) * (s**3 * (10.0 - 15.0 * s + 6.0 * s * s))
    return blend
