"""Self-collision: pairs of links that may collide, which are links of different legs, and feet and the base.

Both engines check only pairs that can meet, whose shapes can reach a common position in the base frame within their
joint limits. Pairs that already touch while the robot rests or sits are excluded, because their shapes are coarser than
the real robot. Of each leg, only the foot can collide with the base: the upper link is next to it, and checking the
lower link against the base's box takes MuJoCo 7 % of the step time of a robot with 12 motors, as much as all remaining
pairs.
"""

from __future__ import annotations

import math
from itertools import combinations, product

import numpy as np

from surefoot.arrays import Array
from surefoot.robot.description import RobotDescription
from surefoot.robot.urdf import Shape

_SAMPLES = {1: 61, 2: 25, 3: 9}
"""Number of sampled angles per joint, by the number of joints between root and shape; 5 for longer chains."""
_MARGIN = 0.02
"""Margin for shapes that come nearer between the sampled angles, in leg lengths."""


def collision_pairs(robot: RobotDescription) -> list[tuple[str, str]]:
    """Return the pairs of links that may collide with each other; empty if the data sheet disables self-collision."""
    if not robot.contact.self_collision:
        return []
    urdf, feet = robot.urdf, {leg.foot for leg in robot.legs}
    limbs = dict.fromkeys(urdf.fixed_to(robot.base), "base")
    for leg in robot.legs:
        limbs |= dict.fromkeys(urdf.links_below(leg.motors[0]) | urdf.links_below(leg.motors[-1]), f"leg {leg.name}")
    shapes = [shape for link in urdf.links.values() for shape in link.collisions if shape.link in limbs]
    frames = [urdf.frames(robot.joint_angles(robot.pose_angles(*pose))) for pose in (robot.rest, robot.poses.sit)]
    pairs: dict[tuple[str, str], bool] = {}
    for (one, (low, high)), (other, (other_low, other_high)) in combinations(
        [(shape, _bounds(robot, shape)) for shape in shapes], 2
    ):
        pair, both = (one.link, other.link), {limbs[one.link], limbs[other.link]}
        beside_base = "base" in both and not feet & set(pair)
        if len(both) == 1 or beside_base or (low > other_high).any() or (other_low > high).any():
            continue
        pairs[pair] = pairs.get(pair, True) and all(_distance(one, other, at) > 0 for at in frames)
    return [pair for pair, apart in pairs.items() if apart]


def _core(shape: Shape) -> tuple[Array, float]:
    """Approximate a shape by points (p, 3) [m] in the link's frame and the distance [m] of its surface from them.

    The points are on the surface of a box, on the axis of a cylinder, or at the centre of a sphere.
    """
    points, radius = np.zeros((1, 3)), shape.size[0]
    if shape.kind == "box":
        points, radius = np.array(list(product((-1.0, 0.0, 1.0), repeat=3))) * shape.size, 0.0
    elif shape.kind == "cylinder":
        points = np.outer(np.linspace(-1.0, 1.0, 9), [0.0, 0.0, shape.size[1]])
    return points @ shape.rotation.T + shape.position, radius


def _bounds(robot: RobotDescription, shape: Shape) -> tuple[Array, Array]:
    """Return the lower and upper bounds (3,) [m] of a shape in the root frame over all angles of its joints."""
    urdf = robot.urdf
    hinges = [joint for joint in urdf.tree if joint.kind != "fixed" and shape.link in urdf.links_below(joint.name)]
    spans = np.clip([joint.limits or (-math.pi, math.pi) for joint in hinges], -math.pi, math.pi).tolist()
    grid = [np.linspace(low, high, _SAMPLES.get(len(hinges), 5)) for low, high in spans]
    angles = np.array(list(product(*grid)), float).T
    frames = urdf.frames(dict(zip([joint.name for joint in hinges], angles, strict=True)))
    points, radius = _core(shape)
    positions = _transform(points, frames[shape.link]).reshape(-1, 3)
    margin = radius + _MARGIN * robot.leg_geometry.length
    return positions.min(axis=0) - margin, positions.max(axis=0) + margin


def _transform(points: Array, frames: Array) -> Array:
    """Transform points (p, 3) of a link with frames (..., 4, 4) to the root frame (..., p, 3)."""
    placed: Array = np.einsum("...ij,pj->...pi", frames[..., :3, :3], points) + frames[..., None, :3, 3]
    return placed


def _distance(one: Shape, other: Shape, frames: dict[str, Array]) -> float:
    """Return the distance [m] between two shapes on links with these frames; 0 or negative if they touch."""
    if one.kind == "box":
        one, other = other, one
    (points, radius), (other_points, other_radius) = _core(one), _core(other)
    points = _transform(points, frames[one.link])
    if other.kind != "box":
        apart = points[:, None] - _transform(other_points, frames[other.link])
        return float(np.linalg.norm(apart, axis=-1).min()) - radius - other_radius
    frame = frames[other.link] @ other.frame
    outside = np.maximum(np.abs((points - frame[:3, 3]) @ frame[:3, :3]) - other.size, 0.0)
    return float(np.linalg.norm(outside, axis=1).min()) - radius
