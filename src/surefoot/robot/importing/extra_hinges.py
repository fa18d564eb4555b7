"""Joints of legs that are no motors of a walk: play of gears, wheels, and springs of feet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco import mjtJoint

from surefoot.arrays import Array
from surefoot.errors import choices

_MAX_PLAY = 0.1
"""Widest range [rad] of a hinge that is play."""
_PARALLEL_TOLERANCE = 1e-3
"""Sine of the angle between axes, and their distance [m], up to which two hinges turn alike."""
_TURNS = 4 * math.pi
"""Range [rad] from which on a hinge turns round and round."""
_MAX_WHEEL_OFFSET = 0.25
"""How far the middle of a wheel may be from its axis, over its radius."""


def find_play(model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, int]:
    """Return the hinges that are play of gears, each with the motor's hinge that it is in series with.

    Such a hinge has a tiny range and the axis of another one on the same body, or on the one above or below.
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
    """Return a note about hinges that are play."""
    name, motor = (str(model.joint(joint).name) for joint in next(iter(play.items())))
    low, high = model.jnt_range[next(iter(play))]
    more = f" (and {len(play) - 1} more)" if len(play) > 1 else ""
    return f"'{name}' is play of '{motor}' ({low:g} to {high:g} rad){more}: play of gears is left out"


def is_wheel(model: mujoco.MjModel, data: mujoco.MjData, above: int, hinge: int, points: Array) -> bool:
    """Return whether the last hinge of a leg turns a wheel: without limits, about the axis of the one before it.

    Args:
        model: the robot.
        data: its places.
        above: the hinge before it.
        hinge: the hinge.
        points: points (p, 3) on what it turns.
    """
    turns = not model.jnt_limited[hinge] or float(np.ptp(model.jnt_range[hinge])) >= _TURNS
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
    lock = 'type="fixed" in place of type="continuous"' if is_urdf else "deleting these <joint>s and their actuators"
    what = "turn wheels" if len(names) > 1 else "turns a wheel"
    return (
        f"{choices(names)} {what} at the end of its legs, and robots with wheels are not trained; {lock} locks them: a "
        "wheel that does not turn is a round foot"
    )


def describe_springs(names: Sequence[str], is_urdf: bool) -> str:
    """Return the error for a robot whose legs end in parts that slide."""
    lock = 'type="fixed" in place of type="prismatic"' if is_urdf else "deleting these <joint>s"
    what = "slide" if len(names) > 1 else "slides"
    ends = f"{choices(names)} {what} at the end of its legs, as springs of feet do"
    return f"{ends}, which is not simulated; {lock} locks them"
