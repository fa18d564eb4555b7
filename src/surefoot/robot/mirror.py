"""By how much the two sides of a robot differ."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from surefoot.robot.description import RobotDescription
from surefoot.robot.serial_leg import SerialLegs

MAX_SIDE_DIFFERENCE = 0.005
"""Difference of the sides, over the length of the straight leg, up to which a robot learns from mirrored samples."""


class SideDifference(NamedTuple):
    """The greatest difference of lengths between a leg and its mirror image."""

    length: float
    """In m."""
    text: str
    """What differs, by how many mm, and between which legs."""


def side_difference(robot: RobotDescription) -> SideDifference:
    """Return by how much places of hips and lengths of links differ left to right."""
    legs, mounts, worst = robot.leg_geometry, robot.leg_mounts, SideDifference(0.0, "left and right are mirror images")
    for leg, mirror in enumerate(mounts * [1.0, -1.0, 1.0]):
        distances = np.linalg.norm(mounts - mirror, axis=1)
        distances[leg] = np.inf if len(mounts) > 1 else 0.0
        other = int(np.argmin(distances))
        parts = {"hip's place": (float(distances[other]), 0.0)}
        if isinstance(legs, SerialLegs):
            across = legs.hip[leg, 0] + legs.hip[other, 0], legs.hip[leg, 1] - legs.hip[other, 1]
            parts |= {
                "hip offset": (float(np.hypot(*across)), 0.0),
                "upper link": (float(legs.upper[leg]), float(legs.upper[other])),
                "lower link": (float(legs.lower[leg]), float(legs.lower[other])),
            }
        for part, (here, there) in parts.items():
            if (apart := here - there) > worst.length + 1e-9:
                one, two = robot.leg_names[leg], robot.leg_names[other]
                how = "longer than" if part.endswith("link") else "from the mirror image of"
                worst = SideDifference(apart, f"{one}'s {part} is {1e3 * apart:.2g} mm {how} {two}'s")
    return worst


def is_symmetric(robot: RobotDescription) -> bool:
    """Return whether the sides are alike enough to learn from mirrored samples."""
    return side_difference(robot).length <= MAX_SIDE_DIFFERENCE * robot.leg_geometry.length
