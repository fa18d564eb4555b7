"""Triangle meshes of robots for rendering, with smooth normals on round surfaces and sharp edges elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot.appearance import Appearance, VisualPart
from surefoot.robot.urdf import Color

_CREASE = np.cos(np.radians(40.0))
"""Cosine of the angle between two triangles above which their common edge is sharp."""
_SAME_PLACE = 1e-5
"""Distance below which vertices are merged [m]."""


def smooth(vertices: NDArray[Any], faces: NDArray[np.int32]) -> tuple[Array, Array, NDArray[np.int32]]:
    """Return points (P, 3), their normals (P, 3) and triangles (F, 3) from vertices and faces.

    The normal at a corner is the mean normal of the adjacent triangles that are not separated by a sharp edge, weighted
    by their angles at the corner. Corners with the same position and normal are merged to one point.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    units = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    sides = np.roll(corners, -1, axis=1) - corners
    sides = sides / np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), 1e-20)
    cosines = -np.einsum("fki,fki->fk", sides, np.roll(sides, 1, axis=1))
    weighted = (np.arccos(np.clip(cosines, -1.0, 1.0))[..., None] * units[:, None]).reshape(-1, 3)
    _, place = np.unique(np.rint(vertices / _SAME_PLACE).astype(np.int64), axis=0, return_inverse=True)
    at = place.reshape(-1)[faces].reshape(-1)
    # All pairs of corners at the same position: each corner with every corner in its group of the sorted list.
    order, count = np.argsort(at, kind="stable"), np.bincount(at)
    first = np.cumsum(count) - count
    one = np.repeat(np.arange(len(at)), count[at])
    step = np.arange(len(one)) - np.repeat(np.cumsum(count[at]) - count[at], count[at])
    other = order[np.repeat(first[at], count[at]) + step]
    flat = np.einsum("ij,ij->i", units[one // 3], units[other // 3]) > _CREASE
    one, other = one[flat], other[flat]
    sums: Array = np.stack([np.bincount(one, weighted[other, k], len(at)) for k in range(3)], axis=1)
    sums = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-20)
    keys = np.column_stack([at, np.rint(500 * sums).astype(np.int64)])
    _, point, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return corners.reshape(-1, 3)[point], sums[point], index.reshape(-1, 3).astype(np.int32)


def link_meshes(appearance: Appearance) -> list[tuple[str, Color, Array, NDArray[np.int32]]]:
    """Return one mesh per link and color: link, color, points (P, 3) [m], triangles (F, 3).

    Points at sharp edges are duplicated, so that normals computed from the mesh are the same as from `smooth`.
    """
    groups: dict[tuple[str, Color], list[VisualPart]] = {}
    for part in appearance.parts:
        groups.setdefault((part.link, cast(Color, tuple(round(255 * value) for value in part.color))), []).append(part)
    meshes = []
    for (link, color), parts in groups.items():
        points, _, faces = join([smooth(part.vertices, part.faces) for part in parts])
        meshes.append((link, color, points, faces))
    return meshes


def join(meshes: Sequence[tuple[Array, Array, NDArray[np.int32]]]) -> tuple[Array, Array, NDArray[np.int32]]:
    """Join points, normals and triangles of several meshes."""
    points, normals, faces = zip(*meshes, strict=True)
    starts = np.cumsum([0, *map(len, points[:-1])])
    shifted = np.concatenate([part + start for part, start in zip(faces, starts, strict=True)])
    return (
        np.concatenate(points).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        shifted.astype(np.int32),
    )


class Mesh:
    """Mesh of all visual parts of a robot, in the frames of their links.

    Args:
        appearance: the parts.
        links: names of links, in the order of the poses given to `place`.
    """

    def __init__(self, appearance: Appearance, links: list[str]) -> None:
        parts = appearance.parts
        pieces = [smooth(part.vertices, part.faces) for part in parts]
        self.points, self.normals, self.faces = join(pieces)
        """Positions [m] and normals (P, 3), and point indices of triangles (F, 3)."""
        counts = [len(points) for points, _, _ in pieces]
        self.link = np.repeat([links.index(part.link) for part in parts], counts).astype(np.int32)
        """Link index of each point (P,)."""
        counts = [len(faces) for _, _, faces in pieces]
        self.color = np.repeat([part.color for part in parts], counts, axis=0).astype(np.float32)
        """Red, green and blue of each triangle (F, 3), 0 to 1."""

    def place(self, poses: Array) -> tuple[Array, Array]:
        """Return all points and normals (P, 3) in the world frame, for poses (L, 4, 4) of the links."""
        turn, shift = poses[self.link, :3, :3].astype(np.float32), poses[self.link, :3, 3].astype(np.float32)
        points = np.einsum("pij,pj->pi", turn, self.points) + shift
        return points, np.einsum("pij,pj->pi", turn, self.normals)
