"""Heights of the ground around a robot, at points of a grid in its heading frame."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.robot import RobotDescription
from surefoot.world.ground import Ground

AHEAD = tuple(0.25 * k for k in range(-5, 8))
"""Places of the points ahead of the base, in lengths of the straight leg."""
ASIDE = tuple(0.25 * k for k in range(-3, 4))
"""Places of the points to its left, in the same."""
RANGE = 1.0
"""Greatest height or depth [m], from the base's origin, that a scan tells."""


def scan_points(robot: RobotDescription) -> Array:
    """Return the points (K, 2) [m] of a robot's grid: x ahead and y to the left of the base's origin, upright."""
    x, y = np.meshgrid(AHEAD, ASIDE, indexing="ij")
    points: Array = robot.leg_geometry.length * np.stack([x.ravel(), y.ravel()], axis=-1)
    return points


def scan_columns() -> list[str]:
    """Return the names of the heights of a scan; those of the right are mirror images of those of the left."""
    sides = {0.0: "middle"} | {y: f"{'left' if y > 0 else 'right'}{round(4 * abs(y))}" for y in ASIDE if y}
    return [f"ground{round(4 * x)}.{sides[y]}" for x in AHEAD for y in ASIDE]


def scan_heights(ground: Ground, points: Array, position: Array, yaw: Array) -> Array:
    """Return heights of the ground less those of the bases' origins (N, K) [m], within `RANGE`.

    Args:
        ground: what they stand on.
        points: of the grid (K, 2) [m].
        position: of the bases (N, 3) in the world [m].
        yaw: of the bases (N,) [rad].
    """
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = points.T
    places = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + position[:, None, :2]
    heights: Array = np.clip(ground.height(places) - position[:, None, 2], -RANGE, RANGE)
    return heights
