"""Left-right symmetry of a robot's geometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from surefoot.robot.description import RobotDescription
from surefoot.robot.serial_leg import SerialLegs

MAX_SIDE_DIFFERENCE = 0.005
"""Maximum difference between left and right, relative to the straight leg's length, for learning from mirrored
samples."""


class SideDifference(NamedTuple):
    """The largest difference between a leg and the mirror image of the leg on the other side."""

    length: float
    """Difference [m]."""
    text: str
    """Message that names the quantity, the difference in mm and both legs."""


def side_difference(robot: RobotDescription) -> SideDifference:
    """Compare hip positions and link lengths of the left and right legs."""
    legs, worst = robot.leg_geometry, SideDifference(0.0, "left and right are mirror images")
    for leg, (other, distance) in enumerate(mirror_legs(robot)):
        parts = {"hip position": (distance, 0.0)}
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


def mirror_legs(robot: RobotDescription) -> list[tuple[int, float]]:
    """Return the leg on the other side for each leg, and the distance [m] of its hip from the leg's mirror image."""
    mounts, pairs = robot.leg_mounts, []
    for leg, mirror in enumerate(mounts * [1.0, -1.0, 1.0]):
        distances = np.linalg.norm(mounts - mirror, axis=1)
        distances[leg] = np.inf if len(mounts) > 1 else 0.0
        other = int(np.argmin(distances))
        pairs.append((other, float(distances[other])))
    return pairs


def asymmetry(robot: RobotDescription) -> str | None:
    """Return why a robot can't learn from mirrored samples, or None if left and right are similar enough."""
    difference, limit = side_difference(robot), MAX_SIDE_DIFFERENCE * robot.leg_geometry.length
    if difference.length > limit:
        return f"{difference.text} (limit {1e3 * limit:.2g} mm)"
    if not isinstance(legs := robot.leg_geometry, SerialLegs):
        return None
    for leg, (other, _) in enumerate(mirror_legs(robot)):
        one, two = robot.leg_names[leg], robot.leg_names[other]
        if legs.knee[leg] != legs.knee[other]:
            return f"the knees of {one} and {two} point in different directions"
        # Mirror images of motor angles are equal up to the sign, so both sides need the same pose at zero.
        for part, angle in {"upper": legs.upper_angle, "lower": legs.lower_angle}.items():
            turn = float((angle[leg] - angle[other] + np.pi) % (2 * np.pi) - np.pi)
            if abs(turn) > MAX_SIDE_DIFFERENCE:
                return f"at zero angles the {part} links of {one} and {two} are {abs(turn):.2g} rad apart"
    return None


def is_symmetric(robot: RobotDescription) -> bool:
    """Return whether left and right are similar enough to learn from mirrored samples."""
    return asymmetry(robot) is None
