"""Ground geometry: heights and normals for contacts, resets, falls, rewards, cameras and pages.

A ground is the plane z = 0 or a field of square cells. Each cell has its own heights at its four corners, so that the
ground can slope within a cell and have vertical walls between cells. Engines build collision shapes of bodies from the
same cells, contacts of feet are in `surefoot.world.ground_contact`, and everything else uses the methods of `Ground`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surefoot.arrays import Array

FLOOR_SPACING = 0.1
"""Distance [m] between the points of an uneven floor."""
FLOOR_POINTS = (280, 120)
"""Number of points of an uneven floor along x and y: 28 m by 12 m, and level beyond."""
FLOOR_LENGTH_BEHIND = 4.0
"""Length [m] of an uneven floor behind the robots' start."""
_SLOPE_SPAN = 0.2
"""Half the distance [m] over which the slope of the smoothed ground is measured."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground in the world frame, z up: a field of cells, or the plane z = 0 without cells. Lengths are in m.

    The heights of the border continue beyond the field.
    """

    corners: Array = field(default_factory=lambda: np.zeros((0, 0, 2, 2)))
    """Heights at the corners of cells (X, Y, 2, 2): for each cell along x and y, at low and high x, and low and high y.
    A diagonal from low x and high y to high x and low y splits a cell into two triangles."""
    cell: float = 1.0
    """Side length of a cell."""
    center: tuple[float, float] = (0.0, 0.0)
    """Centre of the field."""
    smooth_heights: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Heights of the smoothed ground at the cell centres (X, Y), relative to which heights and tilts of robots are
    measured: for example the slope of stairs, or the mean of rough ground. Defaults to the plane z = 0."""
    friction: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Factors on the friction coefficient of feet, for square patches around the centre of the field (P, Q). Values at
    the border continue beyond. Defaults to 1 everywhere."""
    patch: float = 1.0
    """Side length of a patch."""

    @classmethod
    def from_points(
        cls,
        heights: Array,
        cell: float,
        center: tuple[float, float] = (0.0, 0.0),
        smooth_heights: Array | None = None,
    ) -> Ground:
        """Return the continuous ground through points.

        Args:
            heights: heights of the points (X, Y) [m].
            cell: distance between neighbouring points [m].
            center: centre of the field [m].
            smooth_heights: heights of the smoothed ground. Defaults to the mean height of each cell.
        """
        pairs = [[heights[:-1, :-1], heights[:-1, 1:]], [heights[1:, :-1], heights[1:, 1:]]]
        corners = np.moveaxis(np.array(pairs, float), (0, 1), (2, 3))
        return cls(corners, cell, center, corners.mean(axis=(2, 3)) if smooth_heights is None else smooth_heights)

    @property
    def is_flat(self) -> bool:
        """Whether the ground is the plane z = 0."""
        return not self.corners.size

    @property
    def grid(self) -> Array:
        """Grid of cells for compiled functions (3,) [m]: lowest x, lowest y and side of a cell."""
        sides = np.array(self.corners.shape[:2]) * self.cell
        return np.array([*(np.array(self.center) - sides / 2), self.cell])

    @property
    def patch_grid(self) -> Array:
        """Grid of friction patches for compiled functions (3,) [m]: lowest x, lowest y and side of a patch."""
        sides = np.array(self.friction.shape) * self.patch
        return np.array([*(np.array(self.center) - sides / 2), self.patch])

    def height(self, points: Array) -> Array:
        """Return the heights (...) at points (..., 2)."""
        return self.plane_at(points)[..., 0]

    def normal(self, points: Array) -> Array:
        """Return the unit normals (..., 3) at points (..., 2)."""
        slope = self.plane_at(points)[..., 1:]
        normal = np.concatenate([-slope, np.ones_like(slope[..., :1])], axis=-1)
        unit: Array = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        return unit

    def smooth_height(self, points: Array) -> Array:
        """Return the heights (...) of the smoothed ground at points (..., 2), relative to which robots are measured."""
        if not self.smooth_heights.size:
            return np.zeros(points.shape[:-1])
        last = np.array(self.smooth_heights.shape) - 1
        position = np.clip((points - self.grid[:2]) / self.cell - 0.5, 0, last)
        low = np.minimum(position.astype(np.int64), np.maximum(last - 1, 0))
        high = np.minimum(low + 1, last)
        u, v = np.moveaxis(position - low, -1, 0)
        (i, j), (k, m) = np.moveaxis(low, -1, 0), np.moveaxis(high, -1, 0)
        smooth_heights = self.smooth_heights
        level: Array = (1 - u) * ((1 - v) * smooth_heights[i, j] + v * smooth_heights[i, m])
        return level + u * ((1 - v) * smooth_heights[k, j] + v * smooth_heights[k, m])

    def tilt(self, points: Array, yaw: Array) -> Array:
        """Return roll and pitch (..., 2) [rad] of a base that is parallel to the smoothed ground.

        Args:
            points: positions of the base (..., 2) [m].
            yaw: yaw of the base (...) [rad].
        """
        if not self.smooth_heights.size:
            return np.zeros((*points.shape[:-1], 2))
        along = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        across = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
        span = _SLOPE_SPAN
        ahead, left = (
            (self.smooth_height(points + span * way) - self.smooth_height(points - span * way)) / (2 * span)
            for way in (along, across)
        )
        pitch = -np.arctan(ahead)
        return np.stack([np.arctan(left * np.cos(pitch)), pitch], axis=-1)

    def plane_at(self, points: Array) -> Array:
        """Return height, slope along x and slope along y (..., 3) of the triangles at points (..., 2)."""
        flat = np.ascontiguousarray(points, np.float64).reshape(-1, 2)
        planes = np.zeros((len(flat), 3))
        if not self.is_flat:
            # Imported here because a robot's computer, which never computes heights, has no numba.
            from surefoot.world.ground_contact import triangle_planes

            triangle_planes(self.corners, self.cell, np.array(self.center), flat, planes)
        return planes.reshape(*points.shape[:-1], 3)

    def triangles(self) -> Array:
        """Return the surface as triangles (T, 3, 3): tops of cells, and walls between cells with different heights.

        Neighbouring cells at the same level are merged into rectangles.
        """
        x, y = (
            np.arange(n + 1) * self.cell + low for n, low in zip(self.corners.shape[:2], self.grid[:2], strict=True)
        )
        quads: list[Any] = []
        for (i, k, j, m), (a, b, c, d) in _merge_cells(self.corners.reshape(*self.corners.shape[:2], 4)):
            quads.append([(x[i], y[j], a), (x[k], y[j], c), (x[i], y[m], b), (x[k], y[m], d)])
        for axis in (0, 1):
            cells = self.corners if axis == 0 else self.corners.transpose(1, 0, 3, 2)
            low, high = cells[:-1, :, 1, :], cells[1:, :, 0, :]
            walls = np.concatenate([low, high], axis=-1)
            place, along = (x, y) if axis == 0 else (y, x)
            for (i, _, j, m), (a, b, c, d) in _merge_cells(walls, rows=False):
                if (a, b) != (c, d):
                    wall = [(place[i + 1], along[j], a), (place[i + 1], along[j], c)]
                    wall += [(place[i + 1], along[m], b), (place[i + 1], along[m], d)]
                    quads.append(wall if axis == 0 else [(q, p, h) for p, q, h in wall])
        corners = np.array(quads).reshape(-1, 4, 3)
        both = np.concatenate([corners[:, [0, 1, 2]], corners[:, [3, 2, 1]]])
        area = np.linalg.norm(np.cross(both[:, 1] - both[:, 0], both[:, 2] - both[:, 0]), axis=1)
        triangles: Array = both[area > 0]
        return triangles


FLAT = Ground()


def _merge_cells(heights: Array, rows: bool = True) -> list[tuple[tuple[int, int, int, int], tuple[float, ...]]]:
    """Merge cells into rectangles, returned as (low i, high i, low j, high j), and the four heights of each.

    Level cells of the same height are merged along j and, with `rows`, also along i. Walls, whose four heights are
    those of one side and the other side, are merged along j if both sides are level.

    Args:
        heights: four heights of each cell (X, Y, 4).
        rows: whether to merge along i.
    """
    level = (heights == heights[..., :1]).all(-1) if rows else (heights[..., ::2] == heights[..., 1::2]).all(-1)
    rectangles: list[tuple[tuple[int, int, int, int], tuple[float, ...]]] = []
    before: dict[tuple[int, int, tuple[float, ...]], int] = {}
    for i in range(len(heights)):
        joins = level[i, 1:] & level[i, :-1] & (heights[i, 1:] == heights[i, :-1]).all(-1)
        starts = np.flatnonzero(np.concatenate([[True], ~joins]))
        now = {}
        for j, m in zip(starts.tolist(), [*starts[1:].tolist(), heights.shape[1]], strict=True):
            four = tuple(heights[i, j].tolist())
            key = (j, m, four)
            if rows and level[i, j] and key in before:
                number = before[key]
                rectangles[number] = ((rectangles[number][0][0], i + 1, j, m), four)
            else:
                number = len(rectangles)
                rectangles.append(((i, i + 1, j, m), four))
            now[key] = number
        before = now
    return rectangles


def uneven_floor(unevenness: float) -> Ground:
    """Return a random floor whose heights are independent with the standard deviation `unevenness` [m]; 0: the plane.

    The same unevenness gives the same floor. It is level around the robots' start and beyond its points.
    """
    if unevenness == 0.0:
        return FLAT
    seed, columns = int(np.float64(unevenness).view(np.uint64)), FLOOR_POINTS[1]
    draws = np.clip(np.random.default_rng(seed).standard_normal(FLOOR_POINTS), -3.0, 3.0)
    start = round(FLOOR_LENGTH_BEHIND / FLOOR_SPACING)
    draws[start - 5 : start + 5, columns // 2 - 5 : columns // 2 + 5] = 0.0
    draws[[0, -1]] = 0.0
    draws[:, [0, -1]] = 0.0
    center = (0.5 * FLOOR_SPACING * FLOOR_POINTS[0] - FLOOR_LENGTH_BEHIND, 0.0)
    return Ground.from_points(unevenness * draws, FLOOR_SPACING, center, smooth_heights=np.zeros((0, 0)))
