"""The ground: where its height and normal come from, for contact, resets, falls, rewards, cameras and pages.

A ground is the plane z = 0, or a field of square cells. Each cell has heights of its own at its four corners, so that
the ground can slope within a cell and step between two cells, with a vertical wall. Engines build the shape that bodies
collide with from the same cells; feet use
`surefoot.world.ground_contact`; everything else calls the methods.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surefoot.arrays import Array

FLOOR_SPACING = 0.1
"""Distance [m] of the points at which an uneven floor has its heights."""
FLOOR_POINTS = (280, 120)
"""Points of an uneven floor along x and y: 28 m by 12 m, level beyond."""
FLOOR_LENGTH_BEHIND = 4.0
"""Length [m] of an uneven floor behind the place where robots start."""
_SLOPE_SPAN = 0.2
"""Half the distance [m] over which the slope of a course is measured."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A ground in the world frame, z up; without cells it is the plane z = 0. Lengths in m.

    Beyond the field the heights of its border go on.
    """

    corners: Array = field(default_factory=lambda: np.zeros((0, 0, 2, 2)))
    """Heights of cells along x and y, (X, Y, 2, 2): at low and high x, and low and high y, of each cell. A diagonal
    from low x and high y to high x and low y parts a cell into two triangles."""
    cell: float = 1.0
    """Side of a cell."""
    center: tuple[float, float] = (0.0, 0.0)
    """Middle of the field."""
    course: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Smooth course of the ground at the middles of the cells, (X, Y), from which robots' heights and tilts are
    measured: the slope of stairs, the mean of rough ground; the plane z = 0, if not given."""
    friction: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Factors on the coefficient of friction of feet, on square patches around the middle of the field, (P, Q). Beyond
    them those of the border go on; none: 1 everywhere."""
    patch: float = 1.0
    """Side of a patch."""

    @classmethod
    def from_points(
        cls,
        heights: Array,
        cell: float,
        center: tuple[float, float] = (0.0, 0.0),
        course: Array | None = None,
    ) -> Ground:
        """Return the continuous ground through heights (X, Y) at points, a cell apart.

        Without a course it is that of the mean height of each cell.
        """
        pairs = [[heights[:-1, :-1], heights[:-1, 1:]], [heights[1:, :-1], heights[1:, 1:]]]
        corners = np.moveaxis(np.array(pairs, float), (0, 1), (2, 3))
        return cls(corners, cell, center, corners.mean(axis=(2, 3)) if course is None else course)

    @property
    def is_flat(self) -> bool:
        """Whether this is the plane z = 0."""
        return not self.corners.size

    @property
    def grid(self) -> Array:
        """What compiled loops take beside the corners: low x, low y and side of a cell [m], (3,)."""
        sides = np.array(self.corners.shape[:2]) * self.cell
        return np.array([*(np.array(self.center) - sides / 2), self.cell])

    @property
    def patch_grid(self) -> Array:
        """What compiled loops take beside the friction: low x, low y and side of a patch [m], (3,)."""
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

    def level(self, points: Array) -> Array:
        """Return the heights (...) of the course at points (..., 2): robots' heights are measured from it."""
        if not self.course.size:
            return np.zeros(points.shape[:-1])
        last = np.array(self.course.shape) - 1
        place = np.clip((points - self.grid[:2]) / self.cell - 0.5, 0, last)
        low = np.minimum(place.astype(np.int64), np.maximum(last - 1, 0))
        high = np.minimum(low + 1, last)
        u, v = np.moveaxis(place - low, -1, 0)
        (i, j), (k, m) = np.moveaxis(low, -1, 0), np.moveaxis(high, -1, 0)
        course = self.course
        level: Array = (1 - u) * ((1 - v) * course[i, j] + v * course[i, m])
        return level + u * ((1 - v) * course[k, j] + v * course[k, m])

    def tilt(self, points: Array, yaw: Array) -> Array:
        """Return roll and pitch (..., 2) [rad] of a base that lies along the course at points (..., 2).

        Args:
            points: where.
            yaw: heading of the base there (...) [rad].
        """
        if not self.course.size:
            return np.zeros((*points.shape[:-1], 2))
        along = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        across = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
        span = _SLOPE_SPAN
        ahead, left = (
            (self.level(points + span * way) - self.level(points - span * way)) / (2 * span) for way in (along, across)
        )
        pitch = -np.arctan(ahead)
        return np.stack([np.arctan(left * np.cos(pitch)), pitch], axis=-1)

    def plane_at(self, points: Array) -> Array:
        """Return height and slope along x and y (..., 3) of the triangles at points (..., 2)."""
        flat = np.ascontiguousarray(points, np.float64).reshape(-1, 2)
        planes = np.zeros((len(flat), 3))
        if not self.is_flat:
            # The robot's computer, which has no numba, only ever names its ground.
            from surefoot.world.ground_contact import triangle_planes

            triangle_planes(self.corners, self.cell, np.array(self.center), flat, planes)
        return planes.reshape(*points.shape[:-1], 3)

    def triangles(self) -> Array:
        """Return the surface as triangles (T, 3, 3): tops of cells, and walls between cells that do not join.

        Neighbours that lie in one level are joined into rectangles.
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
    """Return rectangles of cells as (low i, high i, low j, high j), and the four heights of each.

    Cells of which all four heights are the same number are joined along j, and along i with `rows`. Walls, whose
    heights are those of one side and of the other, are joined along j where both sides are level.

    Args:
        heights: four heights of each cell, (X, Y, 4).
        rows: see above.
    """
    level = (heights == heights[..., :1]).all(-1) if rows else (heights[..., ::2] == heights[..., 1::2]).all(-1)
    found: list[tuple[tuple[int, int, int, int], tuple[float, ...]]] = []
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
                found[number] = ((found[number][0][0], i + 1, j, m), four)
            else:
                number = len(found)
                found.append(((i, i + 1, j, m), four))
            now[key] = number
        before = now
    return found


def uneven_floor(unevenness: float) -> Ground:
    """Return a floor whose heights have a standard deviation [m]; 0 gives the plane.

    The same unevenness gives the same floor. Its heights are independent; it is level where robots start, and beyond
    its points.
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
    return Ground.from_points(unevenness * draws, FLOOR_SPACING, center, course=np.zeros((0, 0)))
