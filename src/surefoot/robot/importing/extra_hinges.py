"""Leg joints that are not actuated for walking: gear play, wheels, and springs of feet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco import mjtJoint

from surefoot.arrays import Array
from surefoot.errors import choices

_MAX_PLAY = 0.1
"""Maximum range [rad] of a hinge that models play."""
_PARALLEL_TOLERANCE = 1e-3
"""Sine of the angle between two axes, and their distance [m], up to which they count as the same axis."""
_MIN_WHEEL_RANGE = 4 * math.pi
"""Minimum range [rad] of a hinge that counts as unlimited."""
_MAX_WHEEL_OFFSET = 0.25
"""Maximum distance of a wheel's centre from its axis relative to its radius."""


def find_play(model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, int]:
    """Return the hinges that model gear play, each with the motor hinge in series with it.

    Such a hinge has a tiny range, and the same axis as another hinge on its body or on the body above or below.
    """
    hinges = np.flatnonzero(model.jnt_type == mjtJoint.mjJNT_HINGE.value)
    width = np.where(model.jnt_limited == 1, np.ptp(model.jnt_range, axis=1), math.inf)
    play = {}
    for joint in hinges[width[hinges] <= _MAX_PLAY]:
        body = int(model.jnt_bodyid[joint])
        near = [body, int(model.body_parentid[body]), *np.flatnonzero(model.body_parentid == body)]
        for other in hinges[np.isin(model.jnt_bodyid[hinges], near) & (width[hinges] > _MAX_PLAY)]:
            axis, apart = data.xaxis[joint], data.xanchor[other] - data.xanchor[joint]
            turn, distance = np.cross(axis, data.xaxis[other]), np.cross(axis, apart)
            if max(float(np.linalg.norm(turn)), float(np.linalg.norm(distance))) <= _PARALLEL_TOLERANCE:
                play[int(joint)] = int(other)
    return play


def describe_play(model: mujoco.MjModel, play: dict[int, int]) -> str:
    """Return a note about hinges that model gear play."""
    name, motor = (str(model.joint(joint).name) for joint in next(iter(play.items())))
    low, high = model.jnt_range[next(iter(play))]
    more = f" (and {len(play) - 1} more)" if len(play) > 1 else ""
    return f"'{name}' is play of '{motor}' ({low:g} to {high:g} rad){more}: gear play is left out"


def is_wheel(model: mujoco.MjModel, data: mujoco.MjData, above: int, hinge: int, points: Array) -> bool:
    """Return whether the last hinge of a leg turns a wheel: it is unlimited and parallel to the hinge before it.

    Args:
        model: the robot.
        data: its kinematic state.
        above: the hinge before the last one.
        hinge: the last hinge.
        points: points (p, 3) on the shapes that the last hinge turns.
    """
    turns = not model.jnt_limited[hinge] or float(np.ptp(model.jnt_range[hinge])) >= _MIN_WHEEL_RANGE
    axis = data.xaxis[hinge]
    if not turns or float(np.linalg.norm(np.cross(axis, data.xaxis[above]))) > math.sin(0.1):
        return False
    if not len(points):
        return "wheel" in f"{model.joint(hinge).name} {model.body(int(model.jnt_bodyid[hinge])).name}".lower()
    away = points - data.xanchor[hinge]
    away = away - np.outer(away @ axis, axis)
    middle = (away.min(axis=0) + away.max(axis=0)) / 2
    return float(np.linalg.norm(middle)) < _MAX_WHEEL_OFFSET * float(np.linalg.norm(away, axis=1).max())


def describe_wheels(names: Sequence[str], is_urdf: bool) -> str:
    """Return the error for a robot whose legs end in wheels."""
    lock = 'type="fixed" instead of type="continuous"' if is_urdf else "deleting these <joint>s and their actuators"
    what = "turn wheels" if len(names) > 1 else "turns a wheel"
    return (
        f"{choices(names)} {what} at the end of its legs, and robots with wheels are not supported; {lock} locks them: "
        "a wheel that does not turn is a round foot"
    )


def describe_springs(names: Sequence[str], is_urdf: bool) -> str:
    """Return the error for a robot whose legs end in prismatic joints."""
    lock = 'type="fixed" instead of type="prismatic"' if is_urdf else "deleting these <joint>s"
    what = "slide" if len(names) > 1 else "slides"
    ends = f"{choices(names)} {what} at the end of its legs, as springs of feet do"
    return f"{ends}, which is not simulated; {lock} locks them"
