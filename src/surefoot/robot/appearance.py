"""Visual meshes of a robot: coloured triangles on its links, from a file or from the URDF's primitive shapes.

The file `visuals.npz` stores P parts with V vertices and F triangles in total: `counts` (P, 2), the numbers of vertices
and triangles of each part; `color` (P, 3), 0 to 255; `low` and `span` (P, 3) [m], the bounding box of each part;
`vertices` (V, 3) in 65535ths of that box; `faces` (F, 3), vertex indices within the part; and in `meta` the list
`links`, one link name per part.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, prefix_errors, quote
from surefoot.npz import pop_meta, read_npz, write_npz
from surefoot.robot.data_sheet import Leg
from surefoot.robot.urdf import Shape, Urdf

VISUALS_FILE = "visuals.npz"
"""Name of the file that `robot new` writes."""
MAX_BYTES = 1 << 21
"""Maximum file size [byte]; unpacked, the file may be eight times larger."""
MAX_PARTS = 2000
MAX_TRIANGLES = 200_000
"""Maximum number of triangles in a file."""
MAX_EXTENT = 1e3
"""Maximum coordinate of a vertex in its link's frame [m]."""
_COORDINATE_STEPS = 65535
_CIRCLE_SIDES = 20
"""Sides of the polygon that replaces a circle."""
_HIP_RADIUS_RATIO = 0.35
"""Radius of a drawn hip cylinder relative to its length."""
_ARRAYS = {"counts": ("u4", 2), "color": ("u1", 3), "low": ("f4", 3), "span": ("f4", 3)}
_POINT_ARRAYS = {"vertices": ("u2", 3), "faces": ("u4", 3)}


@dataclass(frozen=True, eq=False)
class VisualPart:
    """A triangle mesh of one colour on a link."""

    link: str
    vertices: NDArray[np.float32]
    """Positions (V, 3) in the link's frame [m]."""
    faces: NDArray[np.int32]
    """Indices (F, 3) of vertices, counter-clockwise seen from outside."""
    color: tuple[float, float, float]
    """Red, green and blue, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """All visual parts of a robot."""

    parts: tuple[VisualPart, ...]

    @classmethod
    def from_urdf(cls, urdf: Urdf, legs: Sequence[Leg]) -> Appearance:
        """Triangulate the shapes that `visual_shapes` returns."""
        return cls(tuple(map(triangulate_shape, visual_shapes(urdf, legs))))

    @classmethod
    def load(cls, path: Path, links: Collection[str]) -> Appearance:
        """Read a file of visual parts, each on one of the robot's `links`.

        Raises:
            SurefootError: the file can't be read, is too large, or has invalid arrays or link names.
        """
        with prefix_errors(path):
            arrays = read_npz(path, MAX_BYTES, 8 * MAX_BYTES)
            names = (pop_meta(arrays) or {}).get("links")
            if not isinstance(names, list) or not 0 < len(names) <= MAX_PARTS:
                raise SurefootError(f"meta has no list 'links' of 1 to {MAX_PARTS} names; not a file of visuals")
            if odd := [name for name in names if not isinstance(name, str) or name not in links]:
                raise SurefootError(
                    f"has a part on {quote(odd[0])}, not a link of the robot; choices: {choices(links)}"
                )
            return cls(_read_parts(names, arrays))

    def save(self, path: Path) -> None:
        """Write the file; vertices are rounded to 65535ths of their part's bounding box."""
        low = np.array([part.vertices.min(axis=0) for part in self.parts], np.float32)
        span = np.array([np.ptp(part.vertices, axis=0) for part in self.parts], np.float32)
        scale = _COORDINATE_STEPS / np.maximum(span, 1e-9)
        vertices = [
            np.rint(scale[k] * (part.vertices - low[k])).clip(0, _COORDINATE_STEPS).astype(np.uint16)
            for k, part in enumerate(self.parts)
        ]
        arrays = {
            "counts": np.array([(len(part.vertices), len(part.faces)) for part in self.parts], np.uint32),
            "color": np.array([np.rint(255 * np.array(part.color)) for part in self.parts], np.uint8),
            "low": low,
            "span": span,
            "vertices": np.concatenate(vertices),
            "faces": np.concatenate([part.faces for part in self.parts]).astype(np.uint32),
        }
        write_npz(path, arrays, {"links": [part.link for part in self.parts]})


def visual_shapes(urdf: Urdf, legs: Sequence[Leg]) -> list[Shape]:
    """Return the boxes, cylinders and spheres among the URDF's visuals.

    A link between abduction and hip joint that has no such visual is drawn as a cylinder.

    Raises:
        SurefootError: the URDF has no such visual.
    """
    shapes = [shape for link in urdf.links.values() for shape in link.visuals]
    if not shapes:
        raise SurefootError(f"{urdf.path}: has nothing to draw; a link's <visual> must be a box, cylinder or sphere")
    return shapes + _hip_cylinders(urdf, legs, {shape.link for shape in shapes})


def solid(kind: str, size: tuple[float, ...]) -> tuple[Array, list[tuple[int, ...]]]:
    """Return the vertices (P, 3) of a solid around its centre, and its polygons as vertex indices.

    Polygons are counter-clockwise seen from outside. Kinds and sizes are defined in `Shape`.
    """
    # The solid consists of stacked rings, each with a scale and a height: two for a box or cylinder, more for a sphere.
    angle = 2 * np.pi * np.arange(_CIRCLE_SIDES) / _CIRCLE_SIDES
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if kind == "box":
        ring = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * np.array(size[:2])
        levels = [(1.0, -size[2]), (1.0, size[2])]
    elif kind == "cylinder":
        levels = [(size[0], -size[1]), (size[0], size[1])]
    else:
        tilt = np.linspace(-0.44, 0.44, _CIRCLE_SIDES // 2 - 2) * np.pi
        levels = [(size[0] * np.cos(t), size[0] * np.sin(t)) for t in tilt]
    points, count = np.array([(scale * x, scale * y, z) for scale, z in levels for x, y in ring]), len(ring)
    below, top = range(0, len(points) - count, count), range(len(points) - count, len(points))
    across = [(i, (i + 1) % count, (i + 1) % count + count, i + count) for i in range(count)]
    sides = [tuple(start + i for i in face) for start in below for face in across]
    return points, [*sides, tuple(reversed(range(count))), tuple(top)]


def triangulate(kind: str, size: tuple[float, ...]) -> tuple[Array, NDArray[np.int32]]:
    """Return the vertices (P, 3) of a solid around its centre, and its triangles (F, 3); see `solid`."""
    points, faces = solid(kind, size)
    triangles = [(face[0], *pair) for face in faces for pair in itertools.pairwise(face[1:])]
    return points, np.array(triangles, np.int32)


def triangulate_shape(shape: Shape) -> VisualPart:
    """Convert a primitive shape to a triangle mesh."""
    points, faces = triangulate(shape.kind, shape.size)
    red, green, blue = (value / 255 for value in shape.color)
    return VisualPart(
        shape.link, (points @ shape.rotation.T + shape.position).astype(np.float32), faces, (red, green, blue)
    )


def _hip_cylinders(urdf: Urdf, legs: Sequence[Leg], links_with_visuals: set[str]) -> list[Shape]:
    """Return a cylinder from abduction to hip joint for each hip link that is not in `links_with_visuals`."""
    shapes = []
    for leg in legs:
        hip = urdf.joints[leg.motors[-2]]
        length = float(np.linalg.norm(hip.frame[:3, 3]))
        is_hip_link = len(leg.motors) == 3 and hip.parent == urdf.joints[leg.motors[0]].child
        if is_hip_link and hip.parent not in links_with_visuals and length > 1e-3:
            along = hip.frame[:3, 3] / length
            side = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 else [0.0, 0.0, 1.0])
            side /= np.linalg.norm(side)
            frame = np.eye(4)
            frame[:3] = np.column_stack([side, np.cross(along, side), along, hip.frame[:3, 3] / 2])
            shapes.append(Shape(hip.parent, "cylinder", (_HIP_RADIUS_RATIO * length, length / 2), frame))
    return shapes


def _read_parts(links: list[str], arrays: dict[str, NDArray[Any]]) -> tuple[VisualPart, ...]:
    for name, (kind, width) in {**_ARRAYS, **_POINT_ARRAYS}.items():
        array = arrays.get(name)
        if array is None or array.dtype != np.dtype(kind) or array.ndim != 2 or array.shape[1] != width:
            raise SurefootError(f"has no array '{name}' of type {kind} with {width} columns")
        if name in _ARRAYS and len(array) != len(links):
            raise SurefootError(f"'{name}' has {len(array)} rows; it must have one for each of {len(links)} parts")
    counts, low, span = arrays["counts"].astype(np.int64), arrays["low"].astype(float), arrays["span"].astype(float)
    totals = len(arrays["vertices"]), len(arrays["faces"])
    if not (counts > 0).all() or tuple(counts.sum(axis=0)) != totals:
        raise SurefootError("'counts' has a part without vertices or triangles, or does not sum to their counts")
    if totals[1] > MAX_TRIANGLES:
        raise SurefootError(f"has {totals[1]} triangles; at most {MAX_TRIANGLES} are drawn")
    if not (np.abs(low) <= MAX_EXTENT).all() or not ((span >= 0) & (low + span <= MAX_EXTENT)).all():
        raise SurefootError(f"'low' or 'low' plus 'span' is not within {MAX_EXTENT:g} m, or a span is negative")
    vertices, faces = (np.split(arrays[name], np.cumsum(counts[:-1, k])) for k, name in enumerate(_POINT_ARRAYS))
    parts = []
    for k, link in enumerate(links):
        if faces[k].max() >= counts[k, 0]:
            raise SurefootError(f"part {k} has a triangle with a vertex that does not exist")
        red, green, blue = (float(value) / 255 for value in arrays["color"][k])
        positions = (low[k] + span[k] * (vertices[k] / _COORDINATE_STEPS)).astype(np.float32)
        parts.append(VisualPart(link, positions, faces[k].astype(np.int32), (red, green, blue)))
    return tuple(parts)
