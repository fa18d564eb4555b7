"""Model of a URDF: links with inertias and shapes, joints, and forward kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.robot.rigid_body import RigidBody, fuse
from surefoot.rotations import quat_matrix

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""
GREY: Color = (120, 130, 140)
_NO_ANGLES: Mapping[str, ArrayLike] = MappingProxyType({})
_NO_SHIFTS: Mapping[str, Array] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Shape:
    """A box, cylinder or sphere on a link."""

    link: str
    kind: str
    """box, cylinder or sphere."""
    size: tuple[float, ...]
    """Box: half side lengths; cylinder: radius and half length along z; sphere: radius [m]."""
    frame: Array
    """Frame (4, 4) of the shape in the link's frame."""
    color: Color = GREY

    @property
    def position(self) -> Array:
        """Centre (3,) in the link's frame [m]."""
        return self.frame[:3, 3]

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3) from the shape's to the link's frame."""
        return self.frame[:3, :3]

    @property
    def corners(self) -> Array:
        """Corners (8, 3) of the bounding box along the shape's axes, in the link's frame [m]."""
        half = self.size if self.kind == "box" else (self.size[0], self.size[0], self.size[-1])
        signs = np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3)
        corners: Array = signs * half @ self.rotation.T + self.position
        return corners


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid link; all quantities are in its frame. Only boxes, cylinders and spheres are kept of its shapes."""

    body: RigidBody
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return self.body.mass


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two links."""

    name: str
    kind: str
    """fixed, revolute or continuous."""
    parent: str
    child: str
    axis: tuple[float, float, float]
    """Unit vector of the axis in the child's frame."""
    frame: Array
    """Frame (4, 4) of the child in the parent's frame at angle 0."""
    limits: tuple[float, float] | None = None
    """Range of the angle [rad]; None: unlimited."""

    def child_frame(self, angle: ArrayLike) -> Array:
        """Return the frames (..., 4, 4) of the child in the parent's frame at angles (...) [rad]."""
        half = np.asarray(angle, float)[..., None] / 2
        turn = np.zeros((*half.shape[:-1], 4, 4))
        turn[..., 3, 3] = 1.0
        turn[..., :3, :3] = quat_matrix(np.concatenate([np.cos(half), np.sin(half) * self.axis], axis=-1))
        return self.frame @ turn


@dataclass(frozen=True, eq=False)
class Urdf:
    """Links and joints of a URDF, by name, in the order of the file."""

    path: Path
    links: dict[str, Link]
    joints: dict[str, Joint]

    @cached_property
    def root(self) -> str:
        """Name of the link that has no parent joint."""
        (root,) = self.links.keys() - {joint.child for joint in self.joints.values()}
        return root

    @cached_property
    def tree(self) -> tuple[Joint, ...]:
        """All joints, ordered from root to leaves: each follows the joint that moves its parent link."""
        tree: list[Joint] = []
        waiting = [self.root]
        while waiting:
            parent = waiting.pop()
            children = [joint for joint in self.joints.values() if joint.parent == parent]
            tree += children
            waiting += [joint.child for joint in children]
        return tuple(tree)

    @property
    def total_mass(self) -> float:
        """Mass of all links [kg]."""
        return sum(link.mass for link in self.links.values())

    def frames(self, angles: Mapping[str, ArrayLike] = _NO_ANGLES) -> dict[str, Array]:
        """Return the frames (..., 4, 4) of all links in the root frame; `angles` (...) [rad] by joint default to 0."""
        frames = {self.root: np.eye(4)}
        for joint in self.tree:
            step = joint.child_frame(angles[joint.name]) if joint.name in angles else joint.frame
            frames[joint.child] = frames[joint.parent] @ step
        return frames

    @cached_property
    def fused_frames(self) -> dict[str, tuple[str, Array]]:
        """For each link: the topmost link that is rigidly fixed to it, and the link's frame (4, 4) in that link."""
        frames = {self.root: (self.root, np.eye(4))}
        for joint in self.tree:
            top, frame = frames[joint.parent]
            frames[joint.child] = (top, frame @ joint.frame) if joint.kind == "fixed" else (joint.child, np.eye(4))
        return frames

    def fixed_to(self, link: str) -> set[str]:
        """Return the names of the links that are rigidly fixed to `link`, including itself."""
        return {name for name, (top, _) in self.fused_frames.items() if top == self.fused_frames[link][0]}

    def links_below(self, joint: str) -> set[str]:
        """Return the names of the links that a joint moves."""
        links = {self.joints[joint].child}
        for other in self.tree:
            if other.parent in links:
                links.add(other.child)
        return links

    def fuse_fixed_links(self, shifts: Mapping[str, Array] = _NO_SHIFTS) -> Urdf:
        """Return the URDF with rigidly fixed links fused into one, which has the topmost link's name and frame.

        Visuals are dropped. `shifts` (3,) [m] by name move the centres of mass of fused links.
        """
        links: dict[str, Link] = {}
        for top in dict.fromkeys(top for top, _ in self.fused_frames.values()):
            parts = [(self.links[name], frame) for name, (other, frame) in self.fused_frames.items() if other == top]
            body = fuse([(link.body, frame) for link, frame in parts])
            shapes = [
                replace(shape, link=top, frame=frame @ shape.frame)
                for link, frame in parts
                for shape in link.collisions
            ]
            links[top] = Link(replace(body, centre=body.centre + shifts.get(top, 0.0)), (), tuple(shapes))
        joints: dict[str, Joint] = {}
        for name, joint in self.joints.items():
            top, frame = self.fused_frames[joint.parent]
            if joint.kind != "fixed":
                joints[name] = replace(joint, parent=top, frame=frame @ joint.frame)
        return Urdf(self.path, links, joints)
