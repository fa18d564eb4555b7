"""Radius of a foot from the points of a leg's last link."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array

_TILTS = np.radians(np.linspace(-60.0, 60.0, 61))
"""Angles of the shank to the ground in stance [rad], over which the foot is to roll like a sphere."""
_RESIDUAL = 0.1
"""How far the foot may be from a sphere, over its radius."""
_RADII = (0.02, 0.3)
"""Radii of feet, over the distance from knee to foot."""


def fit_sphere(points: Array, knee: Array, end: Array) -> tuple[Array, float] | None:
    """Return centre (3,) and radius [m] of the sphere on which a leg's last link rolls; None if it does not.

    The distance of a body's lowest point from its origin, in the direction d of the ground as the shank tilts, is
    c d + r for a sphere, a disc or a boot of radius r around c: linear in c and r.

    Args:
        points: points (p, 3) on the link, x forward and z up.
        knee: place (3,) of the knee.
        end: about where the foot is (3,).
    """
    shank = end - knee
    tilts = np.arctan2(shank[0], -shank[2]) + _TILTS
    down = np.column_stack([np.sin(tilts), -np.cos(tilts)])
    depths = points[:, [0, 2]] @ down.T
    depth = depths.max(axis=0)
    system = np.column_stack([down, np.ones(len(down))])
    (x, z, radius), *_ = np.linalg.lstsq(system, depth, rcond=None)
    low, high = np.multiply(_RADII, np.hypot(shank[0], shank[2]))
    if not low < radius < high or np.abs(system @ (x, z, radius) - depth).max() > _RESIDUAL * radius:
        return None
    sides = points[(depths > depth - 0.02 * radius).any(axis=1), 1]
    return np.array([x, (sides.min() + sides.max()) / 2, z]), float(radius)
