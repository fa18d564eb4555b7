"""Part of the ground that is drawn around a position, as triangles."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.world.ground import Ground

REACH = 12.0
"""Minimum distance along x and y up to which the ground is drawn, where it has faded into the haze [m]."""
_STRIDE = 4.0
"""Spacing of the positions around which parts are cut out, so that one part serves many frames [m]."""
MIN_STEP = 0.015
"""Minimum height of a step whose edge is drawn as a line [m]."""
_MAX_CELLS = 600
"""Maximum number of cells of a part along each side; finer cells are merged."""


def ground_around(ground: Ground, place: Array) -> Ground:
    """Return the part of a ground within `REACH` of a position (2,) [m]; its border is extended beyond its end."""
    return _part(ground, *(_STRIDE * np.round(place / _STRIDE)).tolist())


@functools.lru_cache(maxsize=16)
def _part(ground: Ground, x: float, y: float) -> Ground:
    reach = REACH + 0.5 * _STRIDE
    count = int(np.ceil(2 * reach / ground.cell))
    stride = -(-count // _MAX_CELLS)
    count = -(-count // stride)
    first = np.floor((np.array([x, y]) - reach - ground.grid[:2]) / ground.cell).astype(int)
    # Cells at the low and high ends of merged cells along x and y; beyond the border, the border's heights are used.
    ends = []
    for start, size in zip(first, ground.corners.shape[:2], strict=True):
        at = start + stride * np.arange(count) + [[0], [stride - 1]]
        ends.append((at.clip(0, size - 1), np.where(at < 0, 0, np.where(at >= size, 1, [[0], [1]]))))
    (i, end_x), (j, end_y) = ends
    corners = np.empty((count, count, 2, 2))
    for a in (0, 1):
        for b in (0, 1):
            corners[:, :, a, b] = ground.corners[i[a, :, None], j[b], end_x[a, :, None], end_y[b]]
    course = ground.smooth_heights[i[0, :, None], j[0]] if stride == 1 else corners.mean(axis=(2, 3))
    middle = ground.grid[:2] + ground.cell * (first + 0.5 * stride * count)
    return Ground(corners, stride * ground.cell, (float(middle[0]), float(middle[1])), course)


@functools.lru_cache(maxsize=16)
def faces(part: Ground) -> tuple[Array, Array]:
    """Return the triangles (T, 3, 3) of a ground and their unit normals (T, 3)."""
    triangles = part.triangles()
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return triangles, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@functools.lru_cache(maxsize=16)
def step_edges(part: Ground) -> NDArray[np.bool_]:
    """Return whether the ground steps down at each side of a cell (X, Y, 2, 2); last axes: x or y, low or high side."""
    edges = np.zeros(part.corners.shape, np.bool_)
    for axis in (0, 1):
        cells = part.corners if axis == 0 else part.corners.transpose(1, 0, 3, 2)
        rise = (cells[1:, :, 0] - cells[:-1, :, 1]).mean(axis=-1)
        ends = np.moveaxis(edges, axis, 0)[..., axis, :]
        ends[:-1, :, 1], ends[1:, :, 0] = rise < -MIN_STEP, rise > MIN_STEP
    return edges
