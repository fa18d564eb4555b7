"""The sphere that stands in for a foot, from the points of a leg's last link."""

from __future__ import annotations

import numpy as np
from mujoco import mjtGeom

from surefoot.arrays import Array

_TILTS = np.radians(np.linspace(-60.0, 60.0, 61))
"""Angles of the shank to the ground in stance [rad], over which the foot is to roll like a sphere."""
_RESIDUAL = 0.1
"""How far the foot may be from a sphere, over its radius."""
_POINTS = 128
"""Points around a shape."""
_MIN_SOLE_DISTANCE = 0.01
"""How far points of the sole may be from its lowest one, over the shank's length."""
_WIDEST = 1.5
"""Radius of a sphere that stands in for a foot with a flat sole, over half of the sole, at most."""
_RADII = (0.02, 0.3)
"""Radii of feet, over the distance from knee to foot."""


def surface_points(kind: int, size: Array) -> Array:
    """Return points (p, 3) on the surface of a primitive shape of MuJoCo, in its frame.

    Rims, edges and caps are among them: the hull of the points is the shape, within a thousandth of its size.

    Args:
        kind: an `mjtGeom`: sphere, capsule, ellipsoid, cylinder or box.
        size: as MuJoCo has it: radius, half lengths or semi-axes [m].
    """
    turn = np.linspace(0.0, 2 * np.pi, _POINTS, endpoint=False)
    if kind == mjtGeom.mjGEOM_BOX.value:
        return np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3) * size
    if kind == mjtGeom.mjGEOM_CYLINDER.value:
        rim = size[0] * np.column_stack([np.cos(turn), np.sin(turn)])
        return np.concatenate([np.column_stack([rim, np.full(len(rim), end)]) for end in (-size[1], size[1])])
    lift = np.linspace(-np.pi / 2, np.pi / 2, _POINTS // 2 + 1)[:, None]
    ball = np.stack([np.cos(lift) * np.cos(turn), np.cos(lift) * np.sin(turn), np.sin(lift) + 0 * turn], axis=-1)
    ball = ball.reshape(-1, 3)
    if kind == mjtGeom.mjGEOM_ELLIPSOID.value:
        return ball * size
    ends = (0.0,) if kind == mjtGeom.mjGEOM_SPHERE.value else (-size[1], size[1])
    return np.concatenate([size[0] * ball + [0.0, 0.0, end] for end in ends])


def sole_sphere(points: Array, knee: Array, end: Array) -> tuple[Array, float]:
    """Return centre (3,) and radius [m] of the sphere that stands in for a foot that does not roll, such as a box.

    Its lowest point, along the shank, is that of the link's points. Its radius is the one with which it follows them
    best as the shank tilts.
    """
    down, depths, length = _depths(points, knee, end)
    depth, straight = depths.max(axis=0), len(_TILTS) // 2
    # depth = c . down + r, where c . down + r is exact for the shank upright: c = x across + (depth_0 - r) along
    along = down[straight]
    across = np.array([-along[1], along[0]])
    # The middle of the sole, across the shank.
    lowest = depths[:, straight] > depth[straight] - _MIN_SOLE_DISTANCE * length
    sole = points[:, [0, 2]][lowest] @ across
    middle = float(sole.min() + sole.max()) / 2
    rest = depth - middle * (down @ across) - depth[straight] * (down @ along)
    slope = 1.0 - down @ along
    widest = min(_RADII[1] * length, max(_WIDEST * float(np.ptp(sole)) / 2, _RADII[0] * length))
    radius = float(np.clip(slope @ rest / (slope @ slope), _RADII[0] * length, widest))
    x, z = middle * across + (depth[straight] - radius) * along
    sides = points[lowest, 1]
    return np.array([x, (sides.min() + sides.max()) / 2, z]), radius


def _depths(points: Array, knee: Array, end: Array) -> tuple[Array, Array, float]:
    """Return directions of the ground (t, 2) as the shank tilts, how far points reach (p, t) and the shank's length."""
    shank = end - knee
    tilts = np.arctan2(shank[0], -shank[2]) + _TILTS
    down = np.column_stack([np.sin(tilts), -np.cos(tilts)])
    return down, points[:, [0, 2]] @ down.T, float(np.hypot(shank[0], shank[2]))


def fit_sphere(points: Array, knee: Array, end: Array) -> tuple[Array, float] | None:
    """Return centre (3,) and radius [m] of the sphere on which a leg's last link rolls; None if it does not.

    The distance of a body's lowest point from its origin, in the direction d of the ground as the shank tilts, is
    c d + r for a sphere, a disc or a boot of radius r around c: linear in c and r.

    Args:
        points: points (p, 3) on the link, x forward and z up.
        knee: place (3,) of the knee.
        end: about where the foot is (3,).
    """
    down, depths, length = _depths(points, knee, end)
    depth = depths.max(axis=0)
    system = np.column_stack([down, np.ones(len(down))])
    (x, z, radius), *_ = np.linalg.lstsq(system, depth, rcond=None)
    low, high = np.multiply(_RADII, length)
    if not low < radius < high or np.abs(system @ (x, z, radius) - depth).max() > _RESIDUAL * radius:
        return None
    sides = points[(depths > depth - 0.02 * radius).any(axis=1), 1]
    return np.array([x, (sides.min() + sides.max()) / 2, z]), float(radius)
