"""Reader for mesh files, and decimation of meshes."""

from __future__ import annotations

import functools
import io
import itertools
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import collada
import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, describe_os_errors
from surefoot.files import check_readable
from surefoot.robot.importing.named_files import MAX_MESH_BYTES

SUFFIXES = (".stl", ".obj", ".dae")
"""Supported mesh formats."""
_MAX_COORDINATE = 1e6
_MAX_TRIANGLES = 10_000_000
_MAX_INSTANCES = 2000
"""Maximum number of geometry instances in a COLLADA file."""
_MAX_NODES = 20_000
"""Maximum number of scene nodes in a COLLADA file, including all instances."""
_MIN_TRIANGLES = 24
"""Minimum number of triangles of a decimated surface."""
_MAX_DEVIATION = 0.01
"""Maximum deviation of a decimated surface relative to the size of the largest surface."""
_FEW_EXTRA_TRIANGLES = 500
"""Excess of triangles up to which hidden triangles are not searched."""
_SURFACE_SAMPLES, _PIXELS = 40_000, 64
"""Number of sampled points on a surface, and image width in pixels, for the detection of hidden triangles."""
_CELLS = 1 << 20
"""Number of grid cells along a mesh within which vertices are merged."""
Color = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh of one colour."""

    vertices: Array
    """Positions (V, 3) [m]."""
    faces: NDArray[np.integer[Any]]
    """Indices (F, 3) of vertices, counter-clockwise seen from outside."""
    color: Color | None = None
    """Colour, or None if the mesh has none."""

    @property
    def area(self) -> float:
        """Area [m2]."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    def place(self, frame: Array) -> Surface:
        """Transform the surface by a matrix (4, 4), which may scale and mirror; faces keep their outside."""
        faces = self.faces if np.linalg.det(frame[:3, :3]) > 0 else self.faces[:, ::-1]
        return Surface(self.vertices @ frame[:3, :3].T + frame[:3, 3], faces, self.color)


class _Folder(trimesh.resolvers.Resolver):
    """Resolver of files that a mesh refers to, such as materials and textures: regular files of limited size.

    They may be in other folders, because meshes in ROS packages refer to `../textures/...`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, name: str) -> bytes:
        path = self.folder / str(name).strip().replace("\\", "/")
        check_readable(path, MAX_MESH_BYTES)
        return path.read_bytes()

    def namespaced(self, namespace: str) -> _Folder:
        return _Folder(self.folder / namespace)

    def write(self, name: str, data: bytes) -> None:
        raise NotImplementedError

    def keys(self) -> list[str]:
        return []


def read_mesh(path: Path) -> list[Surface]:
    """Read an STL, OBJ or COLLADA file as one surface per colour.

    Units and node transforms of a COLLADA file are applied. Its `up_axis` is ignored as in viewers of URDFs, for which
    files are made.

    Raises:
        SurefootError: the file can't be read, is too large or damaged, or has another format.
    """
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise SurefootError(f"{path.name} is not a file of type {', '.join(SUFFIXES)}")
    with describe_os_errors(path.name):
        check_readable(path, MAX_MESH_BYTES)
        content = path.read_bytes()
    if kind == ".dae" and b"<!ENTITY" in content:
        raise SurefootError(f"{path.name} declares XML entities")
    try:
        with np.errstate(all="ignore"):  # numbers that are not finite are rejected later
            if kind == ".dae":
                _check_instances(content)
            surfaces = _read_surfaces(content, kind, path.parent)
            if not surfaces and kind == ".dae":
                surfaces = _read_surfaces(_drop_broken_materials(content), kind, path.parent)
    except Exception as error:  # Parsers raise any kind of error on a damaged file.
        message = " ".join(str(error).split()) or type(error).__name__
        raise SurefootError(f"{path.name} can't be read as {kind[1:].upper()}: {message}") from error
    if not surfaces:
        raise SurefootError(f"{path.name} has no triangles")
    return surfaces


def _check_instances(content: bytes) -> None:
    """Reject a COLLADA file with too many nodes or geometries, counting all instances of nested nodes."""
    root = ElementTree.fromstring(content)
    nodes = [element for element in root.iter() if element.tag.endswith(("}node", "}visual_scene"))]
    by_url: dict[str, list[ElementTree.Element]] = {}
    for node in nodes:
        by_url.setdefault(f"#{node.get('id')}", []).append(node)

    @functools.cache
    def count(node: ElementTree.Element) -> tuple[int, int]:
        """Return the number of nodes below and including a node, and the number of their geometries."""
        children = [*node.findall("{*}node")]
        for item in node.findall("{*}instance_node"):
            children += by_url.get(item.get("url", ""), [])
        counts = [count(child) for child in children]
        geometries = len(node.findall("{*}instance_geometry"))
        return 1 + sum(one for one, _ in counts), geometries + sum(one for _, one in counts)

    most_nodes = max((count(node)[0] for node in nodes), default=0)
    most = max((count(node)[1] for node in nodes if node.tag.endswith("}node")), default=0)
    if most_nodes > _MAX_NODES:
        raise ValueError(f"its nested nodes amount to {most_nodes}; at most {_MAX_NODES} are read")
    if most > _MAX_INSTANCES:
        raise ValueError(f"a node has {most} geometries; at most {_MAX_INSTANCES} are read")


def _drop_broken_materials(content: bytes) -> bytes:
    """Remove references to unreadable materials from a COLLADA file, for which pycollada would drop the geometry."""
    document = collada.Collada(io.BytesIO(content), ignore=[collada.common.DaeError])
    targets = {f"#{material.id}" for material in document.materials}
    root = ElementTree.fromstring(content)
    for parent in root.iter():
        for item in parent.findall("{*}instance_material"):
            if item.get("target") not in targets:
                parent.remove(item)
    return ElementTree.tostring(root)


def _read_surfaces(content: bytes, kind: str, folder: Path) -> list[Surface]:
    """Parse a mesh file and merge its surfaces by colour."""
    scene = trimesh.load_scene(io.BytesIO(content), file_type=kind[1:], resolver=_Folder(folder), process=False)
    by_color: dict[Color | None, list[Surface]] = {}
    triangles = 0
    for node in scene.graph.nodes_geometry:
        frame, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        vertices, faces = np.asarray(geometry.vertices, float), np.asarray(geometry.faces, np.int64)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("it has triangles with vertices that do not exist")
        if (triangles := triangles + len(faces)) > _MAX_TRIANGLES:
            raise ValueError(f"it has more than {_MAX_TRIANGLES} triangles")
        unit = str(geometry.metadata.get("units", "")).removesuffix("* meters").strip()
        frame = np.diag([*[float(unit)] * 3, 1.0]) @ frame if unit and unit != "meters" else np.array(frame)
        surface = Surface(vertices, faces).place(frame)
        if not (np.abs(surface.vertices) < _MAX_COORDINATE).all():
            raise ValueError(f"it has coordinates that are not finite, or not within {_MAX_COORDINATE:g} m")
        by_color.setdefault(_mean_color(geometry.visual), []).append(surface)
    return [merge_surfaces(parts, color) for color, parts in by_color.items()]


def _mean_color(visual: Any) -> Color | None:
    """Return the mean colour of a mesh's material, texture or vertices, or None."""
    if visual.kind is None:
        return None
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        if image is None:
            rgba = np.asarray(material.main_color, float)
        elif visual.uv is None:
            from PIL import ImageStat

            rgba = np.array(ImageStat.Stat(image.convert("RGB")).mean)
        else:
            rgba = trimesh.visual.color.uv_to_color(visual.uv, image).mean(axis=0)
    else:
        rgba = np.asarray(getattr(visual, f"{visual.kind}_colors"), float).mean(axis=0)
    red, green, blue = (round(float(value)) / 255 for value in np.clip(rgba[:3], 0, 255))
    return red, green, blue


def merge_surfaces(surfaces: Sequence[Surface], color: Color | None = None) -> Surface:
    """Merge surfaces into one of the given colour."""
    starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces])
    return Surface(
        np.concatenate([surface.vertices for surface in surfaces]),
        np.concatenate([surface.faces + start for surface, start in zip(surfaces, starts, strict=False)]),
        color,
    )


def decimate(surfaces: Sequence[Surface], scales: Sequence[float], uses: Sequence[int], total: int) -> list[Surface]:
    """Decimate surfaces to about `total` triangles, counting each surface as often as it is used.

    Each scaled surface gets triangles in proportion to the square root of its area, and more if it would otherwise
    deviate by more than `_MAX_DEVIATION`.
    """
    surfaces = [_weld(surface, _CELLS) for surface in surfaces]
    available = np.array([len(surface.faces) for surface in surfaces])
    sizes = np.sqrt([surface.area for surface in surfaces]) * scales
    extents = [float(np.ptp(surface.vertices, axis=0).max()) if len(surface.faces) else 0.0 for surface in surfaces]
    tolerance = _MAX_DEVIATION * float(np.max(np.multiply(extents, scales), initial=0.0))

    def counts(density: float) -> Array:
        return np.minimum(np.maximum(density * sizes, _MIN_TRIANGLES), available)

    low, high = 0.0, 2.0 * total / max(float(sizes.min(initial=1.0)), 1e-9)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if counts(middle) @ uses <= total else (low, middle)
    return [
        _reduce(surface, int(count), tolerance / scale)
        for surface, count, scale in zip(surfaces, counts(low), scales, strict=True)
    ]


def _reduce(surface: Surface, count: int, tolerance: float) -> Surface:
    """Decimate a surface to `count` triangles, or more if it would otherwise deviate by over a tolerance [m]."""
    if len(surface.faces) <= count:
        return surface
    # Slivers, which CAD programs write, can't be collapsed, but their vertices can be merged.
    welded = _weld(surface, 512)
    reduced = _simplify(welded, count, tolerance)
    if len(reduced.faces) > max(1.5 * count, count + _FEW_EXTRA_TRIANGLES):
        reduced = _simplify(_drop_hidden(welded), count, tolerance)
    cells = 256
    while len(reduced.faces) > 8 * count and cells:
        reduced, cells = _weld(reduced, cells), cells // 2
    return reduced


def _simplify(surface: Surface, count: int, tolerance: float) -> Surface:
    """Collapse edges down to `count` triangles while the deviation stays below a tolerance [m]."""
    # The library raises its threshold of squared distances to 1e-9 (100 + 3)^agg after 100 rounds.
    scale = math.sqrt(1e-9 * 103**3) / max(tolerance, 1e-9)
    vertices, faces = fast_simplification.simplify(
        scale * surface.vertices, surface.faces, target_count=min(count, len(surface.faces)), agg=3
    )
    return _weld(Surface(np.asarray(vertices, float) / scale, np.asarray(faces, np.int64), surface.color), _CELLS)


def _drop_hidden(surface: Surface) -> Surface:
    """Remove triangles that are not visible from any of 14 directions around the surface."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    owner = np.repeat(np.arange(len(areas)), np.ceil(_SURFACE_SAMPLES * areas / areas.sum()).astype(np.int64).clip(1))
    weight = np.random.default_rng(0).random((len(owner), 2))
    weight = np.where(weight.sum(axis=1, keepdims=True) > 1, 1 - weight, weight)
    points = a[owner] + weight[:, :1] * (b - a)[owner] + weight[:, 1:] * (c - a)[owner]
    cell = float(np.ptp(surface.vertices, axis=0).max()) / _PIXELS
    visible = np.zeros(len(areas), bool)
    for direction in itertools.product((-1.0, 0.0, 1.0), repeat=3):
        if np.count_nonzero(direction) in (0, 2):
            continue
        axis = np.array(direction) / np.linalg.norm(direction)
        right = np.cross(axis, [0.3, 0.5, 0.8])
        right /= np.linalg.norm(right)
        pixel = np.floor(points @ np.column_stack([right, np.cross(axis, right)]) / cell).astype(np.int64)
        column, row = (pixel - pixel.min(axis=0)).T
        index, height = column * (int(row.max()) + 1) + row, points @ axis
        top = np.full(int(index.max()) + 1, -np.inf)
        np.maximum.at(top, index, height)
        visible[owner[height >= top[index] - cell]] = True
    return _weld(Surface(surface.vertices, surface.faces[visible], surface.color), _CELLS)


def _weld(surface: Surface, cells: int) -> Surface:
    """Merge vertices within cells of a grid along the surface; drop degenerate triangles and unused vertices.

    The result may be empty.
    """
    if not len(surface.faces):
        return surface
    low, size = surface.vertices.min(axis=0), float(np.ptp(surface.vertices, axis=0).max())
    x, y, z = np.rint((surface.vertices - low) * (cells / max(size, 1e-12))).astype(np.int64).T
    _, first, index = np.unique((x << 42) | (y << 21) | z, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[surface.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return Surface(surface.vertices[first[used]], faces.reshape(-1, 3), surface.color)
