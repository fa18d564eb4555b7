"""Does a map of heights fit the robot: its grid, and the ground where the legs have it?

Another program may send heights of another frame, sign or unit. Such a map is refused before the robot is armed, where
no robot could lie or stand on that ground, or when it stands, where its feet are not on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.errors import SurefootError
from surefoot.policy.contract import HeightMap
from surefoot.robot import RobotDescription
from surefoot.rotations import rpy_matrix

TOLERANCE, RELATIVE_TOLERANCE = 0.05, 0.1
"""Greatest difference [m] of the ground in the map and under the feet, and what is added to it over a leg's length."""
LYING = 0.002
"""Least height [m] of the base's origin over the ground, where a robot lies."""
_POSITION_TOLERANCE = 0.1
"""Greatest difference of a stated place from the policy's, relative to the distance of the points."""


def check_grid(values: dict[str, Any], grid: HeightMap) -> None:
    """Refuse a datagram that states other places for its heights than the policy's.

    Raises:
        SurefootError: the first difference.
    """
    for name, where, own in (("ahead", "ahead", grid.ahead), ("left", "to the left", grid.left)):
        stated = values.get(name)
        if stated is None:
            continue
        if not isinstance(stated, list) or not all(map(is_number, stated)):
            raise SurefootError(f"the map's {name} are no numbers")
        if len(stated) != len(own):
            raise SurefootError(f"the map has {len(stated)} places {where}, the policy {len(own)}")
        spacing = own[1] - own[0]
        if np.abs(np.subtract(stated, own)).max() <= _POSITION_TOLERANCE * spacing:
            continue
        apart = (stated[-1] - stated[0]) / (len(stated) - 1)
        if abs(apart - spacing) > _POSITION_TOLERANCE * spacing / len(own):
            raise SurefootError(f"the map's points are {apart:.4g} m apart {where}, the policy's {spacing:.4g}")
        raise SurefootError(f"the map's points begin {stated[0]:.4g} m {where}, the policy's {own[0]:.4g}")


def check_at_rest(heights: Array, grid: HeightMap, robot: RobotDescription) -> None:
    """Refuse a map on whose ground the robot can neither lie nor stand.

    Args:
        heights: of the map (K,) [m], as they were sent.
        grid: of the map.
        robot: that is to be armed.

    Raises:
        SurefootError: what is likely to be wrong.
    """
    feet = robot.foot_positions(robot.resting_angles)
    ground, stands = _neutral_feet(heights, grid, feet), -float(np.median(feet[:, 2]))
    if not -(stands + tolerance(robot)) <= ground <= -LYING:
        raise SurefootError(_difference(ground, stands, robot))


def check_standing(
    heights: Array, grid: HeightMap, robot: RobotDescription, angles: Array, roll_pitch_yaw: Sequence[float] | Array
) -> None:
    """Refuse a map whose ground is not where the feet of a standing robot are.

    Args:
        heights: of the map (K,) [m], as they were sent.
        grid: of the map.
        robot: that stands.
        angles: of its motors (M,) [rad].
        roll_pitch_yaw: of its base (3,) [rad].

    Raises:
        SurefootError: what is likely to be wrong.
    """
    roll, pitch, _ = map(float, roll_pitch_yaw)
    feet = robot.foot_positions(angles) @ rpy_matrix(roll, pitch, 0.0).T
    differences = [float(_at(heights, grid, foot) - foot[2]) for foot in feet]
    if abs(float(np.median(differences))) > tolerance(robot):
        raise SurefootError(_difference(_neutral_feet(heights, grid, feet), -float(np.median(feet[:, 2])), robot))


def tolerance(robot: RobotDescription) -> float:
    """Return how far the ground of a map may be from the feet [m]."""
    return TOLERANCE + RELATIVE_TOLERANCE * robot.leg_geometry.length


def _at(heights: Array, grid: HeightMap, point: Array) -> float:
    """Return the height [m] of the map's point that is nearest to a place in the upright base frame."""
    row = int(np.argmin(np.abs(np.subtract(grid.ahead, point[0]))))
    column = int(np.argmin(np.abs(np.subtract(grid.left, point[1]))))
    return float(heights[row * len(grid.left) + column])


def _neutral_feet(heights: Array, grid: HeightMap, feet: Array) -> float:
    """Return the median height [m] of the map where the feet are and in their middle."""
    points = [*feet[:, :2], feet[:, :2].mean(axis=0)]
    return float(np.median([_at(heights, grid, point) for point in points]))


def _difference(ground: float, stands: float, robot: RobotDescription) -> str:
    """Return what a map has in place of the ground, and what is likely to be wrong with it."""
    near, size = tolerance(robot), abs(ground) / max(stands, 1e-3)
    if abs(ground) <= near:
        likely = ": are they heights in the world?"
    elif abs(ground - stands) <= near:
        likely = ": do they count downward?"
    elif 700 <= size <= 1400:
        likely = ": are they in millimetres?"
    elif 70 <= size <= 140:
        likely = ": are they in centimetres?"
    else:
        likely = "."
    return (
        f"the map has the ground under the base at {ground:.2f} m; the robot stands {stands:.2f} m above it{likely} "
        "Heights must count from the base's origin, upward, in metres"
    )
