"""Which links of a robot may collide with each other: those of different legs, and feet and the base.

Both engines look only at pairs that can meet: whose shapes, over all angles that their joints have, share some place in
the base's frame. Pairs that touch already while the robot rests or sits are left out: such shapes are coarser than the
robot's own. Of a leg only the foot meets the base: the upper link is beside it, and the lower one against the base's
box costs MuJoCo 7 % of a step of a robot of 12 motors, as much as all that are left.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.robot.description import RobotDescription
from surefoot.robot.urdf import Shape

_SAMPLES = {1: 61, 2: 25, 3: 9}
"""Angles of each joint at which shapes are placed, by the number of joints from the root; 5 of more."""
_MARGIN = 0.02
"""How much nearer shapes may come between these angles, in leg lengths."""
_ALONG = np.linspace(-1.0, 1.0, 9)


@dataclass(frozen=True)
class _Swept:
    """A shape over all angles of its joints."""

    group: int
    """0 for what is fixed to the base, else the number of the leg, from 1."""
    shape: Shape
    points: Array
    """Points (p, 3) in the link's frame [m]: of a box's surface, of a cylinder's axis, or a sphere's centre."""
    radius: float
    """Distance of the shape's surface from these points [m]; 0 for a box."""
    low: Array
    """Least coordinates (3,) that the shape reaches, in the root's frame [m]."""
    high: Array
    """Greatest ones."""
    frames: list[Array]
    """The link's frames (4, 4) while the robot rests and while it sits."""


def collision_pairs(robot: RobotDescription) -> list[tuple[str, str]]:
    """Return the pairs of links that may collide with each other, none if the sheet has `self_collision` off."""
    if not robot.contact.self_collision:
        return []
    urdf, feet = robot.urdf, {leg.foot for leg in robot.legs}
    legs = [urdf.below(leg.motors[0]) | urdf.below(leg.motors[-1]) for leg in robot.legs]
    groups = [urdf.fixed_to(robot.base), *legs]
    poses = [robot.joint_angles(robot.pose_angles(*pose)) for pose in (robot.rest, robot.poses.sit)]
    frames = [urdf.frames(pose) for pose in poses]
    swept = [
        _sweep(robot, group, shape, [at[shape.link] for at in frames])
        for link in urdf.links.values()
        for shape in link.collisions
        for group in [k for k, links in enumerate(groups) if shape.link in links][:1]
    ]
    pairs: dict[tuple[str, str], bool] = {}
    for one, other in itertools.combinations(swept, 2):
        pair = one.shape.link, other.shape.link
        beside_base = 0 in (one.group, other.group) and not feet & set(pair)
        if one.group == other.group or beside_base or (one.low > other.high).any() or (other.low > one.high).any():
            continue
        pairs[pair] = pairs.get(pair, True) and all(_gap(one, other, pose) > 0 for pose in range(len(poses)))
    return [pair for pair, apart in pairs.items() if apart]


def _sweep(robot: RobotDescription, group: int, shape: Shape, frames: list[Array]) -> _Swept:
    points, radius = np.zeros((1, 3)), shape.size[0]
    if shape.kind == "box":
        points, radius = np.array(list(itertools.product(_ALONG[::4], repeat=3))) * shape.size, 0.0
    elif shape.kind == "cylinder":
        points = np.outer(_ALONG, [0.0, 0.0, shape.size[1]])
    points = points @ shape.rotation.T + shape.position
    chain = robot.urdf.chain(shape.link)
    moving = [joint for joint in chain if joint.kind != "fixed"]
    spans = np.clip([joint.limits or (-math.pi, math.pi) for joint in moving], -math.pi, math.pi).tolist()
    grid = [np.linspace(low, high, _SAMPLES.get(len(moving), 5)) for low, high in spans]
    angles = np.array(list(itertools.product(*grid)), float).T
    reached = robot.urdf.frames(dict(zip([joint.name for joint in moving], angles, strict=True)), chain)[shape.link]
    places = _place(points, reached).reshape(-1, 3)
    room = radius + _MARGIN * robot.leg_geometry.length
    return _Swept(group, shape, points, radius, places.min(axis=0) - room, places.max(axis=0) + room, frames)


def _place(points: Array, frames: Array) -> Array:
    """Return points (p, 3) of a link with frames (..., 4, 4), in the frames' root (..., p, 3)."""
    placed: Array = np.einsum("...ij,pj->...pi", frames[..., :3, :3], points) + frames[..., None, :3, 3]
    return placed


def _gap(one: _Swept, other: _Swept, pose: int) -> float:
    """Return the distance [m] of two shapes in the resting pose (0) or sitting (1); 0 or below, they touch."""
    if one.shape.kind == "box":
        one, other = other, one
    points = _place(one.points, one.frames[pose])
    if other.shape.kind != "box":
        between = points[:, None] - _place(other.points, other.frames[pose])
        return float(np.linalg.norm(between, axis=-1).min()) - one.radius - other.radius
    frame = other.frames[pose] @ other.shape.frame
    outside = np.maximum(np.abs((points - frame[:3, 3]) @ frame[:3, :3]) - other.shape.size, 0.0)
    return float(np.linalg.norm(outside, axis=1).min()) - one.radius
