"""The ground: where its height and normal come from, for contact, resets, falls, rewards, cameras and pages.

A ground is the plane z = 0, or heights on a grid with two triangles in each cell. Engines build their collision shape
from these heights; feet whose contact is compiled here use `sphere_contact`; everything else calls the methods.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surefoot.arrays import Array

FLOOR_CELL = 0.1
"""Distance [m] of the points at which an uneven floor has its heights."""
FLOOR_CELLS = (280, 120)
"""Points of an uneven floor along x and y: 28 m by 12 m, level beyond."""
FLOOR_BEHIND = 4.0
"""Length [m] of an uneven floor behind the place where robots start."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A ground in the world frame, z up; without heights it is the plane z = 0. Lengths in m."""

    heights: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Heights at the points of a grid along x and y, (X, Y)."""
    cell: float = 1.0
    """Distance of the points."""
    center: tuple[float, float] = (0.0, 0.0)
    """Middle of the grid."""
    rough: bool = False
    """Heights are the roughness of a level floor at z = 0, not its course."""

    def height(self, points: Array) -> Array:
        """Return the heights (...) at points (..., 2); 0 beyond the grid."""
        return self.plane_at(points)[..., 0]

    def normal(self, points: Array) -> Array:
        """Return the unit normals (..., 3) at points (..., 2)."""
        slope = self.plane_at(points)[..., 1:]
        normal = np.concatenate([-slope, np.ones_like(slope[..., :1])], axis=-1)
        unit: Array = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        return unit

    def level(self, points: Array) -> Array:
        """Return the heights (...) of the smooth ground at points (..., 2): robots' heights are measured from it."""
        return np.zeros(points.shape[:-1]) if self.rough else self.height(points)

    def plane_at(self, points: Array) -> Array:
        """Return height and slope along x and y (..., 3) of the triangles at points (..., 2)."""
        planes = np.zeros((*points.shape[:-1], 3))
        if not self.heights.size:
            return planes
        last = np.array(self.heights.shape) - 1
        place = (points - self.center) / self.cell + last / 2
        inside = ((place >= 0) & (place <= last)).all(axis=-1)
        corner = np.clip(np.floor(place), 0, last - 1).astype(np.int64)[inside]
        (i, j), (u, v) = corner.T, (place[inside] - corner).T
        h00, h10, h01, h11 = (self.heights[i + a, j + b] for a, b in ((0, 0), (1, 0), (0, 1), (1, 1)))
        # The diagonal of a cell goes from its corner at low x and high y to the one at high x and low y.
        near = u + v <= 1
        along_x, along_y = np.where(near, h10 - h00, h11 - h01), np.where(near, h01 - h00, h11 - h10)
        height = np.where(near, h00 + u * along_x + v * along_y, h11 - (1 - u) * along_x - (1 - v) * along_y)
        planes[inside] = np.stack([height, along_x / self.cell, along_y / self.cell], axis=-1)
        return planes


FLAT = Ground()


def uneven_floor(unevenness: float) -> Ground:
    """Return a floor whose heights have a standard deviation [m]; 0 gives the plane.

    The same unevenness gives the same floor. Its heights are independent; it is level where robots start.
    """
    if unevenness == 0.0:
        return FLAT
    seed, columns = int(np.float64(unevenness).view(np.uint64)), FLOOR_CELLS[1]
    draws = np.clip(np.random.default_rng(seed).standard_normal(FLOOR_CELLS), -3.0, 3.0)
    start = round(FLOOR_BEHIND / FLOOR_CELL)
    draws[start - 5 : start + 5, columns // 2 - 5 : columns // 2 + 5] = 0.0
    center = (0.5 * FLOOR_CELL * FLOOR_CELLS[0] - FLOOR_BEHIND, 0.0)
    return Ground(unevenness * draws, FLOOR_CELL, center, rough=True)


def sphere_contact(heights: Any, x: float, y: float, z: float, radius: float) -> tuple[float, float, float, float]:
    """Return how deep a sphere is in the ground [m], negative above it, and the unit normal where it is deepest.

    Kernels compile this function. It answers for the whole sphere: a foot beside an edge must not meet the plane of the
    cell under its centre beyond that cell. Only the plane z = 0 is implemented.

    Args:
        heights: those of the `Ground`, (0, 0).
        x: centre of the sphere in the world [m].
        y: as x.
        z: as x.
        radius: [m].
    """
    return radius - z, 0.0, 0.0, 1.0
