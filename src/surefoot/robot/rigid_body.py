"""Rigid bodies: mass, centre of mass and inertia, and several of them as one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array

_MAX_GYRATION = 1.5
"""Radius of gyration, over the distance of a link's farthest point from its centre of mass, from which it is too large:
1 is the limit, and shapes may not show all of a link."""
_MIN_GYRATION = 0.2
"""Radius of gyration, over that of a solid box around the link, below which it is too small."""
_INERTIA_UNITS = {"kg cm2": 1e4, "kg mm2": 1e6, "g cm2": 1e7, "g mm2": 1e9}
"""Units that CAD programs write, as many of them are a kg m2."""
_NEAR = 2.5
"""Ratio of a link's inertia to a box's up to which it is the same."""
_MIN_PART_SIZE = 0.05
"""Size of a part, over the robot's, under which shapes do not show all of it."""


def are_valid_moments(moments: NDArray[np.floating[Any]]) -> bool:
    """Return whether a rigid body can have these principal moments (3,): over 0, none over the sum of the others."""
    return bool(moments.min() > 0 and 2 * moments.max() <= 1.001 * moments.sum())


def box_moments(mass: float, sides: Array) -> Array:
    """Return the moments of inertia (3,) [kg m2] of a solid box with sides (3,) [m] along its axes."""
    squares = np.square(sides)
    moments: Array = mass / 12 * (squares.sum() - squares)
    return moments


def describe_gyration(
    name: str, mass: float, moments: Array, points: Array | None, robot_size: float
) -> tuple[bool, str] | None:
    """Return whether a link's inertia is too large (else too small) for its size, and that in words.

    None if it fits.

    Args:
        name: the link.
        mass: its mass [kg].
        moments: its principal moments (3,) [kg m2].
        points: points (p, 3) [m] on its shapes and joints, from its centre of mass along its axes; None if its size is
            not known: then it is compared with the robot's.
        robot_size: length [m] of a straight line through the robot.
    """
    radius = float(np.sqrt(moments.max() / mass))
    text = f"link '{name}': {mass:.3g} kg with a radius of gyration of {radius:.3g} m"
    if points is None:
        too_large = f"{text}, and the whole robot is {robot_size:.2g} m long; correct its <inertial>"
        return (True, too_large) if radius > robot_size else None
    sides = np.ptp(points, axis=0)
    box = box_moments(mass, sides)
    large = radius > _MAX_GYRATION * max(float(np.linalg.norm(points, axis=1).max()), _MIN_PART_SIZE * robot_size)
    if not large and radius >= _MIN_GYRATION * float(np.sqrt(box.max() / mass)):
        return None
    ratio = float(moments.max() / box.max()) if box.max() > 0 else 0.0
    units = [unit for unit, size in _INERTIA_UNITS.items() if size / _NEAR <= ratio <= size * _NEAR]
    hint = f"; it fits if the file has {units[0]}" if units else ""
    span, inertia = (" x ".join(f"{side:.2g}" for side in sides), ", ".join(f"{value:.2g}" for value in box))
    return large, f"{text}, and its shapes and joints span {span} m; a box of this size has ({inertia}) kg m2{hint}"


def first_with_count(words: list[str]) -> str:
    """Return the first of links' descriptions, and how many more there are."""
    return words[0] + (f"; {len(words) - 1} more links are like this" if words[1:] else "")


@dataclass(frozen=True)
class RigidBody:
    """One fused link: mass [kg], and centre of mass [m] (3,) and inertia about it [kg m2] (3, 3) in its frame."""

    mass: float
    centre: Array
    inertia: Array

    def principal(self) -> tuple[Array, Array]:
        """Return the principal moments [kg m2] (3,) and axes (3, 3), a rotation whose columns are in the link's frame.

        Of the axes that fit, those nearest to the link's own: a link along its frame keeps its frame.
        """
        diagonal = np.diag(np.diag(self.inertia))
        if np.abs(self.inertia - diagonal).max() <= 1e-9 * np.trace(self.inertia):
            return np.diag(self.inertia).copy(), np.eye(3)
        moments, axes = np.linalg.eigh(self.inertia)
        order = np.argsort(np.argmax(np.abs(axes), axis=0))
        moments, axes = moments[order], axes[:, order]
        axes = axes * np.where(np.diag(axes) < 0, -1.0, 1.0)
        if np.linalg.det(axes) < 0:
            axes[:, 2] *= -1
        return moments, axes

    def in_principal(self, point: Array) -> Array:
        """Return a point (3,) [m] of the link's frame in the frame at the centre of mass along the principal axes."""
        place: Array = self.principal()[1].T @ (point - self.centre)
        return place


def fuse(parts: list[tuple[RigidBody, Array]]) -> RigidBody:
    """Return one body of several, each with its frame (4, 4) in the frame of the whole."""
    mass = sum(body.mass for body, _ in parts)
    centres = [frame[:3, :3] @ body.centre + frame[:3, 3] for body, frame in parts]
    centre = np.sum([body.mass * at for (body, _), at in zip(parts, centres, strict=True)], axis=0) / mass
    inertia = np.zeros((3, 3))
    for (body, frame), at in zip(parts, centres, strict=True):
        turn, away = frame[:3, :3], at - centre
        inertia += turn @ body.inertia @ turn.T + body.mass * (away @ away * np.eye(3) - np.outer(away, away))
    return RigidBody(mass, centre, inertia)
