"""Plausibility checks of a height map: its grid, and the ground height compared with the robot's legs.

Another program may send heights in another frame, sign or unit. Such a map is detected before the robot is armed, if
the robot could neither lie nor stand on that ground, or once it stands, if its feet are not on the map's ground.
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
"""Maximum difference between the map and the feet: a constant [m] plus a fraction of the leg length."""
MIN_BASE_HEIGHT = 0.002
"""Minimum height of the base's origin above the ground, for a lying robot [m]."""
_POSITION_TOLERANCE = 0.1
"""Maximum difference of grid positions from the policy's, relative to the spacing of the points."""


def check_grid(values: dict[str, Any], grid: HeightMap) -> None:
    """Check that the grid stated in a datagram, if any, is the policy's.

    Raises:
        SurefootError: the grid differs; the message has the first difference.
    """
    for name, where, own in (("ahead", "ahead", grid.ahead), ("left", "to the left", grid.left)):
        stated = values.get(name)
        if stated is None:
            continue
        if not isinstance(stated, list) or not all(map(is_number, stated)):
            raise SurefootError(f"the map's {name} must be numbers")
        if len(stated) != len(own):
            raise SurefootError(f"the map has {len(stated)} points {where}, the policy {len(own)}")
        spacing = own[1] - own[0]
        if np.abs(np.subtract(stated, own)).max() <= _POSITION_TOLERANCE * spacing:
            continue
        other = (stated[-1] - stated[0]) / (len(stated) - 1)
        if abs(other - spacing) > _POSITION_TOLERANCE * spacing / len(own):
            raise SurefootError(f"the map's points are {other:.4g} m apart {where}, the policy's {spacing:.4g}")
        raise SurefootError(f"the map's points begin {stated[0]:.4g} m {where}, the policy's {own[0]:.4g}")


def check_at_rest(heights: Array, grid: HeightMap, robot: RobotDescription) -> None:
    """Check that the robot can lie or stand on the ground of a map, before it is armed.

    Args:
        heights: heights of the map (K,) [m], as they were sent.
        grid: grid of the map.
        robot: description of the robot.

    Raises:
        SurefootError: the robot can do neither; the message has the likely error of the map.
    """
    feet = robot.foot_positions(robot.resting_angles)
    ground, standing_height = _ground_height(heights, grid, feet), -float(np.median(feet[:, 2]))
    if not -(standing_height + tolerance(robot)) <= ground <= -MIN_BASE_HEIGHT:
        raise SurefootError(_describe_difference(ground, standing_height, robot))


def check_standing(
    heights: Array, grid: HeightMap, robot: RobotDescription, angles: Array, roll_pitch_yaw: Sequence[float] | Array
) -> None:
    """Check that the ground of a map is under the feet of a standing robot.

    Args:
        heights: heights of the map (K,) [m], as they were sent.
        grid: grid of the map.
        robot: description of the robot.
        angles: motor angles (M,) [rad].
        roll_pitch_yaw: orientation of the base (3,) [rad].

    Raises:
        SurefootError: it is not; the message has the likely error of the map.
    """
    roll, pitch, _ = map(float, roll_pitch_yaw)
    feet = robot.foot_positions(angles) @ rpy_matrix(roll, pitch, 0.0).T
    differences = [float(_nearest_height(heights, grid, foot) - foot[2]) for foot in feet]
    if abs(float(np.median(differences))) > tolerance(robot):
        ground = _ground_height(heights, grid, feet)
        raise SurefootError(_describe_difference(ground, -float(np.median(feet[:, 2])), robot))


def tolerance(robot: RobotDescription) -> float:
    """Return the maximum difference between the ground of a map and the feet [m]."""
    return TOLERANCE + RELATIVE_TOLERANCE * robot.leg_geometry.length


def _nearest_height(heights: Array, grid: HeightMap, point: Array) -> float:
    """Return the height of the map's point nearest to a point in the heading frame of the base [m]."""
    row = int(np.argmin(np.abs(np.subtract(grid.ahead, point[0]))))
    column = int(np.argmin(np.abs(np.subtract(grid.left, point[1]))))
    return float(heights[row * len(grid.left) + column])


def _ground_height(heights: Array, grid: HeightMap, feet: Array) -> float:
    """Return the median height of the map at the feet and at their centre [m]."""
    points = [*feet[:, :2], feet[:, :2].mean(axis=0)]
    return float(np.median([_nearest_height(heights, grid, point) for point in points]))


def _describe_difference(ground: float, standing_height: float, robot: RobotDescription) -> str:
    """Return a message with the ground height of a map, and the likely error of the map."""
    margin, ratio = tolerance(robot), abs(ground) / max(standing_height, 1e-3)
    if abs(ground) <= margin:
        likely = ": are the heights in the world frame?"
    elif abs(ground - standing_height) <= margin:
        likely = ": are the heights positive downward?"
    elif 700 <= ratio <= 1400:
        likely = ": are the heights in millimetres?"
    elif 70 <= ratio <= 140:
        likely = ": are the heights in centimetres?"
    else:
        likely = "."
    return (
        f"the ground under the base is at {ground:.2f} m in the map, but the robot stands {standing_height:.2f} m "
        f"above it{likely} Heights must be relative to the base's origin, positive upward, in metres"
    )
