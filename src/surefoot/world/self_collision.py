"""Which links of a robot may collide with each other: those of different legs, and feet and the base.

Both engines look only at pairs that can meet: whose shapes, over all angles that their joints have, share some place in
the base's frame. Pairs that touch already while the robot rests or sits are left out: such shapes are coarser than the
robot's own. Of a leg only the foot meets the base: the upper link is beside it, and the lower one against the base's
box costs MuJoCo 7 % of a step of a robot of 12 motors, as much as all that are left.
"""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.robot import RobotDescription
from surefoot.robot.urdf import Joint, attribute, frame_of
from surefoot.rotations import quat_matrix

_SAMPLES = {1: 61, 2: 25, 3: 9}
"""Angles of each joint at which shapes are placed, by the number of joints from the base; 5 of more."""
_ROOM = 0.02
"""How much nearer shapes may come between these angles, in leg lengths."""
_ALONG = np.linspace(-1.0, 1.0, 9)


@dataclass(frozen=True)
class _Shape:
    """A box, or a cylinder or sphere as the points of its axis and a radius; places in its link's frame [m]."""

    link: str
    box: tuple[Array, Array] | None
    """Frame (4, 4) and half of the sides (3,) of a box."""
    points: Array
    radius: float


def _shapes(robot: RobotDescription) -> list[_Shape]:
    """Return the boxes, cylinders and spheres of the URDF's collision shapes."""
    found = []
    for link in ElementTree.parse(robot.urdf.path).getroot().findall("link"):
        for shape in link.findall("collision"):
            frame, radius, box = frame_of(shape.find("origin")), 0.0, None
            solids = {kind: shape.find(f"geometry/{kind}") for kind in ("box", "cylinder", "sphere")}
            if solids["box"] is not None:
                half = np.array([float(word) for word in attribute(solids["box"], "size").split()]) / 2
                box, places = (frame, half), np.array(list(itertools.product(_ALONG[::4], repeat=3))) * half
            elif solids["cylinder"] is not None:
                radius = float(attribute(solids["cylinder"], "radius"))
                length = float(attribute(solids["cylinder"], "length"))
                places = np.outer(_ALONG, [0.0, 0.0, length / 2])
            elif solids["sphere"] is not None:
                radius, places = float(attribute(solids["sphere"], "radius")), np.zeros((1, 3))
            else:
                continue
            found.append(_Shape(link.get("name", ""), box, places @ frame[:3, :3].T + frame[:3, 3], radius))
    return found


def _path(robot: RobotDescription, link: str) -> list[Joint]:
    """Return the joints from the base to a link."""
    above = {joint.child: joint for joint in robot.urdf.joints.values()}
    path: list[Joint] = []
    while link != robot.base and link in above:
        path.insert(0, above[link])
        link = above[link].parent
    return path


def _frames(path: list[Joint], angles: Array) -> Array:
    """Return the frames (n, 4, 4) at the end of a path of joints, at angles (n, moving joints) [rad]."""
    frames, at = np.tile(np.eye(4), (len(angles), 1, 1)), 0
    for joint in path:
        frames = frames @ joint.frame
        if joint.kind != "fixed":
            turn, half = np.tile(np.eye(4), (len(angles), 1, 1)), angles[:, at, None] / 2
            axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
            turn[:, :3, :3] = quat_matrix(np.concatenate([np.cos(half), np.sin(half) * axis], axis=1))
            frames, at = frames @ turn, at + 1
    return frames


def _placed(shape: _Shape, frames: Array) -> Array:
    """Return the points (n, p, 3) of a shape whose link has these frames (n, 4, 4)."""
    placed: Array = np.einsum("nij,pj->npi", frames[:, :3, :3], shape.points) + frames[:, None, :3, 3]
    return placed


def _gap(one: _Shape, other: _Shape, frames: tuple[Array, Array]) -> float:
    """Return the distance [m] of two shapes whose links have frames (4, 4) in the base's; below 0 they touch."""
    if one.box is not None:
        one, other, frames = other, one, frames[::-1]
    points = _placed(one, frames[0][None])[0]
    if other.box is None:
        between = points[:, None] - _placed(other, frames[1][None])[0]
        return float(np.linalg.norm(between, axis=-1).min()) - one.radius - other.radius
    frame, half = frames[1] @ other.box[0], other.box[1]
    outside = np.maximum(np.abs((points - frame[:3, 3]) @ frame[:3, :3]) - half, 0.0)
    return float(np.linalg.norm(outside, axis=1).min()) - one.radius


def collision_pairs(robot: RobotDescription) -> list[tuple[str, str]]:
    """Return the pairs of links that may collide with each other, none if the sheet has `self_collision` off."""
    if not robot.contact.self_collision:
        return []
    still = robot.urdf.fixed_to(robot.base)
    groups = [still, *(robot.urdf.below(leg.motors[0]) | robot.urdf.below(leg.motors[-1]) for leg in robot.legs)]
    poses = [robot.joint_angles(robot.pose_angles(*pose)) for pose in (robot.rest, robot.poses.sit)]
    swept: list[tuple[int, _Shape, Array, list[Array]]] = []
    for shape in _shapes(robot):
        group = next((k for k, links in enumerate(groups) if shape.link in links), None)
        if group is None:
            continue
        path = _path(robot, shape.link)
        moving = [joint for joint in path if joint.kind != "fixed"]
        spans = np.clip([joint.limits or (-math.pi, math.pi) for joint in moving], -math.pi, math.pi).tolist()
        grid = [np.linspace(low, high, _SAMPLES.get(len(moving), 5)) for low, high in spans]
        angles = list(itertools.product(*grid))
        every = np.array(angles, float).reshape(len(angles), len(moving))
        places = _placed(shape, _frames(path, every)).reshape(-1, 3)
        room = shape.radius + _ROOM * robot.leg_geometry.length
        extent = np.array([places.min(axis=0) - room, places.max(axis=0) + room])
        at = [_frames(path, np.array([[float(pose[joint.name]) for joint in moving]]))[0] for pose in poses]
        swept.append((group, shape, extent, at))
    feet = {leg.foot for leg in robot.legs}
    found: dict[tuple[str, str], bool] = {}
    for (g, one, mine, here), (h, other, theirs, there) in itertools.combinations(swept, 2):
        beside_base = 0 in (g, h) and not {one.link, other.link} & feet
        if g == h or beside_base or (mine[0] > theirs[1]).any() or (theirs[0] > mine[1]).any():
            continue
        pair = one.link, other.link
        apart = all(_gap(one, other, frames) > 0 for frames in zip(here, there, strict=True))
        found[pair] = found.get(pair, True) and apart
    return [pair for pair, apart in found.items() if apart]
