"""Rigid bodies: mass, centre of mass and inertia, their fusion and plausibility."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array

_MAX_GYRATION = 1.5
"""Maximum plausible radius of gyration relative to the distance of the link's farthest point from its centre of mass:
the physical limit is 1, but shapes may not cover the whole link."""
_MIN_GYRATION = 0.2
"""Minimum plausible radius of gyration relative to a solid box around the link."""
_INERTIA_UNITS = {"kg cm2": 1e4, "kg mm2": 1e6, "g cm2": 1e7, "g mm2": 1e9}
"""Units of inertia that CAD programs write, as their number per kg m2."""
_MAX_UNIT_RATIO = 2.5
"""Maximum ratio between the inertias of a link and its bounding box for which a unit is considered to match."""
_MIN_PART_SIZE = 0.05
"""Minimum size of a link that is assumed relative to the robot, because shapes may not cover small links."""


def are_valid_moments(moments: NDArray[np.floating[Any]]) -> bool:
    """Return whether principal moments (3,) are physically possible: positive, none over the sum of the others."""
    return bool(moments.min() > 0 and 2 * moments.max() <= 1.001 * moments.sum())


def box_moments(mass: float, sides: Array) -> Array:
    """Return the principal moments of inertia (3,) [kg m2] of a solid box with side lengths (3,) [m]."""
    squares = np.square(sides)
    moments: Array = mass / 12 * (squares.sum() - squares)
    return moments


def describe_gyration(
    name: str, mass: float, moments: Array, points: Array | None, robot_size: float
) -> tuple[bool, str] | None:
    """Compare a link's inertia with its size.

    Args:
        name: name of the link.
        mass: its mass [kg].
        moments: its principal moments (3,) [kg m2].
        points: points (p, 3) [m] on its shapes and joints, relative to its centre of mass and along its principal axes;
            None if its size is unknown, so that only the size of the robot limits its inertia.
        robot_size: diagonal [m] of the robot's bounding box.

    Returns:
        None if the inertia is plausible; else whether it is too large (or else too small), and a message.
    """
    radius = float(np.sqrt(moments.max() / mass))
    text = f"link '{name}': {mass:.3g} kg with a radius of gyration of {radius:.3g} m"
    if points is None:
        too_large = f"{text}, but the whole robot is only {robot_size:.2g} m long; correct its <inertial>"
        return (True, too_large) if radius > robot_size else None
    sides = np.ptp(points, axis=0)
    box = box_moments(mass, sides)
    large = radius > _MAX_GYRATION * max(float(np.linalg.norm(points, axis=1).max()), _MIN_PART_SIZE * robot_size)
    if not large and radius >= _MIN_GYRATION * float(np.sqrt(box.max() / mass)):
        return None
    ratio = float(moments.max() / box.max()) if box.max() > 0 else 0.0
    units = [unit for unit, size in _INERTIA_UNITS.items() if size / _MAX_UNIT_RATIO <= ratio <= size * _MAX_UNIT_RATIO]
    hint = f"; it fits if the file has {units[0]}" if units else ""
    span, inertia = (" x ".join(f"{side:.2g}" for side in sides), ", ".join(f"{value:.2g}" for value in box))
    return large, f"{text}, and its shapes and joints span {span} m; a box of this size has ({inertia}) kg m2{hint}"


def first_with_count(words: list[str]) -> str:
    """Return the first of several messages about links, and the number of the others."""
    return words[0] + (f"; {len(words) - 1} more links are like this" if words[1:] else "")


@dataclass(frozen=True)
class RigidBody:
    """Mass [kg], centre of mass (3,) [m], and inertia about it (3, 3) [kg m2] of a link, in the link's frame."""

    mass: float
    centre: Array
    inertia: Array

    def principal(self) -> tuple[Array, Array]:
        """Return the principal moments (3,) [kg m2] and the principal axes as columns of a rotation (3, 3).

        Order and signs of the axes are as close as possible to the link's frame; a link whose inertia is diagonal
        keeps its frame.
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
        """Transform a point (3,) [m] from the link's frame to the principal frame at the centre of mass."""
        transformed: Array = self.principal()[1].T @ (point - self.centre)
        return transformed


def fuse(parts: list[tuple[RigidBody, Array]]) -> RigidBody:
    """Fuse rigid bodies into one; each comes with its frame (4, 4) in the frame of the result."""
    mass = sum(body.mass for body, _ in parts)
    centres = [frame[:3, :3] @ body.centre + frame[:3, 3] for body, frame in parts]
    centre = np.sum([body.mass * at for (body, _), at in zip(parts, centres, strict=True)], axis=0) / mass
    inertia = np.zeros((3, 3))
    for (body, frame), at in zip(parts, centres, strict=True):
        turn, away = frame[:3, :3], at - centre
        inertia += turn @ body.inertia @ turn.T + body.mass * (away @ away * np.eye(3) - np.outer(away, away))
    return RigidBody(mass, centre, inertia)
