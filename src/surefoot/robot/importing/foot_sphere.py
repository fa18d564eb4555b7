"""Sphere that approximates a foot, fitted to points on the last link of a leg."""

from __future__ import annotations

import numpy as np
from mujoco import mjtGeom

from surefoot.arrays import Array

_TILTS = np.radians(np.linspace(-60.0, 60.0, 61))
"""Tilts of the shank during stance [rad], over which the foot should roll like the sphere."""
_MAX_RESIDUAL = 0.1
"""Maximum deviation of the foot from the sphere relative to the radius."""
_CIRCLE_POINTS = 128
"""Number of points around a shape."""
_SOLE_DEPTH = 0.01
"""Maximum height of sole points above the lowest point, relative to the shank length."""
_MAX_SOLE_RADIUS = 1.5
"""Maximum radius of the sphere for a flat sole, relative to half the sole length."""
_RADII = (0.02, 0.3)
"""Minimum and maximum radius of feet relative to the distance from knee to foot."""


def surface_points(kind: int, size: Array) -> Array:
    """Return points (p, 3) on the surface of a MuJoCo primitive, in its frame.

    The convex hull of the points, which include rims, edges and caps, is the shape to a thousandth of its size.

    Args:
        kind: an `mjtGeom`: sphere, capsule, ellipsoid, cylinder or box.
        size: MuJoCo's `geom_size`: radius, half lengths or semi-axes [m].
    """
    turn = np.linspace(0.0, 2 * np.pi, _CIRCLE_POINTS, endpoint=False)
    if kind == mjtGeom.mjGEOM_BOX.value:
        return np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3) * size
    if kind == mjtGeom.mjGEOM_CYLINDER.value:
        rim = size[0] * np.column_stack([np.cos(turn), np.sin(turn)])
        return np.concatenate([np.column_stack([rim, np.full(len(rim), end)]) for end in (-size[1], size[1])])
    lift = np.linspace(-np.pi / 2, np.pi / 2, _CIRCLE_POINTS // 2 + 1)[:, None]
    ball = np.stack([np.cos(lift) * np.cos(turn), np.cos(lift) * np.sin(turn), np.sin(lift) + 0 * turn], axis=-1)
    ball = ball.reshape(-1, 3)
    if kind == mjtGeom.mjGEOM_ELLIPSOID.value:
        return ball * size
    ends = (0.0,) if kind == mjtGeom.mjGEOM_SPHERE.value else (-size[1], size[1])
    return np.concatenate([size[0] * ball + [0.0, 0.0, end] for end in ends])


def sole_sphere(points: Array, knee: Array, end: Array) -> tuple[Array, float]:
    """Return centre (3,) and radius [m] of the sphere that approximates a foot that does not roll, such as a box.

    Along the upright shank, the sphere reaches as far as the link. Its radius is the least-squares fit to the link's
    extent as the shank tilts.
    """
    down, depths, length = _depths(points, knee, end)
    depth, straight = depths.max(axis=0), len(_TILTS) // 2
    # depth = c . down + r, where c . down + r is exact for the shank upright: c = x across + (depth_0 - r) along
    along = down[straight]
    across = np.array([-along[1], along[0]])
    # The middle of the sole, across the shank.
    lowest = depths[:, straight] > depth[straight] - _SOLE_DEPTH * length
    sole = points[:, [0, 2]][lowest] @ across
    middle = float(sole.min() + sole.max()) / 2
    rest = depth - middle * (down @ across) - depth[straight] * (down @ along)
    slope = 1.0 - down @ along
    widest = min(_RADII[1] * length, max(_MAX_SOLE_RADIUS * float(np.ptp(sole)) / 2, _RADII[0] * length))
    radius = float(np.clip(slope @ rest / (slope @ slope), _RADII[0] * length, widest))
    x, z = middle * across + (depth[straight] - radius) * along
    sides = points[lowest, 1]
    return np.array([x, (sides.min() + sides.max()) / 2, z]), radius


def _depths(points: Array, knee: Array, end: Array) -> tuple[Array, Array, float]:
    """Return directions to the ground (t, 2) as the shank tilts, the points' extent (p, t) and the shank length [m]."""
    shank = end - knee
    tilts = np.arctan2(shank[0], -shank[2]) + _TILTS
    down = np.column_stack([np.sin(tilts), -np.cos(tilts)])
    return down, points[:, [0, 2]] @ down.T, float(np.hypot(shank[0], shank[2]))


def fit_sphere(points: Array, knee: Array, end: Array) -> tuple[Array, float] | None:
    """Fit the sphere on which a leg's last link rolls: centre (3,) and radius [m]; None if it does not roll.

    For a sphere, disc or boot of radius r around c, the extent of the body from the origin in the direction d of the
    ground is c d + r, which is linear in c and r.

    Args:
        points: points (p, 3) on the link, x forward and z up.
        knee: position (3,) of the knee.
        end: approximate position (3,) of the foot.
    """
    down, depths, length = _depths(points, knee, end)
    depth = depths.max(axis=0)
    system = np.column_stack([down, np.ones(len(down))])
    (x, z, radius), *_ = np.linalg.lstsq(system, depth, rcond=None)
    low, high = np.multiply(_RADII, length)
    if not low < radius < high or np.abs(system @ (x, z, radius) - depth).max() > _MAX_RESIDUAL * radius:
        return None
    sides = points[(depths > depth - 0.02 * radius).any(axis=1), 1]
    return np.array([x, (sides.min() + sides.max()) / 2, z]), float(radius)
