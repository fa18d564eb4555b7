"""Rigid bodies: mass, centre of mass and inertia, and several of them as one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array


def are_moments(moments: NDArray[np.floating[Any]]) -> bool:
    """Return whether a rigid body can have these principal moments (3,): over 0, none over the sum of the others."""
    return bool(moments.min() > 0 and 2 * moments.max() <= 1.001 * moments.sum())


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
