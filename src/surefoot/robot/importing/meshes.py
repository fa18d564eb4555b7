"""Reader of the meshes that a robot's file names, and their decimation."""

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
"""Kinds of mesh that are read."""
_MAX_COORDINATE = 1e6
_MAX_TRIANGLES = 10_000_000
_MAX_INSTANCES = 2000
"""Placed copies of geometries in a COLLADA file."""
_MAX_NODES = 20_000
"""Nodes of a scene in a COLLADA file, each as often as it is placed."""
_MIN_TRIANGLES = 24
"""What decimation leaves of the smallest parts."""
_TOLERANCE = 0.01
"""How far decimation may move a surface, in sizes of the largest one."""
_FEW_EXTRA_TRIANGLES = 500
"""Triangles that are not worth a search for hidden ones."""
_SAMPLES, _PIXELS = 40_000, 64
"""Points on a surface, and pixels along it, by which hidden triangles are recognized."""
_CELLS = 1 << 20
"""Cells along a mesh in which vertices count as one."""
Color = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one colour."""

    vertices: Array
    """Places (V, 3) [m]."""
    faces: NDArray[np.integer[Any]]
    """Indices (F, 3) of vertices, counter-clockwise seen from outside."""
    color: Color | None = None
    """None: the mesh does not say."""

    @property
    def area(self) -> float:
        """Area [m2]."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    def place(self, frame: Array) -> Surface:
        """Return the surface in a frame (4, 4), which may scale and mirror; outside stays outside."""
        faces = self.faces if np.linalg.det(frame[:3, :3]) > 0 else self.faces[:, ::-1]
        return Surface(self.vertices @ frame[:3, :3].T + frame[:3, 3], faces, self.color)


class _Folder(trimesh.resolvers.Resolver):
    """What a mesh names, such as materials and textures: regular files of limited size.

    They may lie in other folders: meshes of packages name `../textures/...`.
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
    """Read the surfaces of an STL, OBJ or COLLADA file, one a colour.

    Units and transforms of nodes in a COLLADA file are applied. Its `up_axis` is not: viewers of URDFs ignore it, and
    files are made so.

    Raises:
        SurefootError: it can't be read, is too large, of another kind, or damaged.
    """
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise SurefootError(f"{path.name} is no {', '.join(SUFFIXES)} file")
    with describe_os_errors(path.name):
        check_readable(path, MAX_MESH_BYTES)
        content = path.read_bytes()
    if kind == ".dae" and b"<!ENTITY" in content:
        raise SurefootError(f"{path.name} declares XML entities")
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused
            if kind == ".dae":
                _check_instances(content)
            surfaces = _read_surfaces(content, kind, path.parent)
            if not surfaces and kind == ".dae":
                surfaces = _read_surfaces(_drop_broken_materials(content), kind, path.parent)
    except Exception as error:  # What parsers raise on a damaged file is any kind of error.
        message = " ".join(str(error).split()) or type(error).__name__
        raise SurefootError(f"{path.name} can't be read as {kind[1:].upper()}: {message}") from error
    if not surfaces:
        raise SurefootError(f"{path.name} has no triangles")
    return surfaces


def _check_instances(content: bytes) -> None:
    """Refuse a COLLADA file whose nodes, which may hold each other many times, come to too many, or geometries do."""
    root = ElementTree.fromstring(content)
    nodes = [element for element in root.iter() if element.tag.endswith(("}node", "}visual_scene"))]
    by_url: dict[str, list[ElementTree.Element]] = {}
    for node in nodes:
        by_url.setdefault(f"#{node.get('id')}", []).append(node)

    @functools.cache
    def count(node: ElementTree.Element) -> tuple[int, int]:
        """Return how many nodes there are from a node on, and how many geometries they place."""
        children = [*node.findall("{*}node")]
        for item in node.findall("{*}instance_node"):
            children += by_url.get(item.get("url", ""), [])
        counts = [count(child) for child in children]
        geometries = len(node.findall("{*}instance_geometry"))
        return 1 + sum(one for one, _ in counts), geometries + sum(one for _, one in counts)

    most_nodes = max((count(node)[0] for node in nodes), default=0)
    most = max((count(node)[1] for node in nodes if node.tag.endswith("}node")), default=0)
    if most_nodes > _MAX_NODES:
        raise ValueError(f"its nodes, which hold each other, come to {most_nodes}; at most {_MAX_NODES} are read")
    if most > _MAX_INSTANCES:
        raise ValueError(f"a node places {most} geometries; at most {_MAX_INSTANCES} are read")


def _drop_broken_materials(content: bytes) -> bytes:
    """Return a COLLADA file without what can't be read of its materials: pycollada drops the geometry with it."""
    document = collada.Collada(io.BytesIO(content), ignore=[collada.common.DaeError])
    targets = {f"#{material.id}" for material in document.materials}
    root = ElementTree.fromstring(content)
    for parent in root.iter():
        for item in parent.findall("{*}instance_material"):
            if item.get("target") not in targets:
                parent.remove(item)
    return ElementTree.tostring(root)


def _read_surfaces(content: bytes, kind: str, folder: Path) -> list[Surface]:
    """Return the surfaces of a file's content, merged by colour."""
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
            raise ValueError("it has triangles of vertices that it does not have")
        if (triangles := triangles + len(faces)) > _MAX_TRIANGLES:
            raise ValueError(f"it has more than {_MAX_TRIANGLES} triangles")
        unit = str(geometry.metadata.get("units", "")).removesuffix("* meters").strip()
        frame = np.diag([*[float(unit)] * 3, 1.0]) @ frame if unit and unit != "meters" else np.array(frame)
        surface = Surface(vertices, faces).place(frame)
        if not (np.abs(surface.vertices) < _MAX_COORDINATE).all():
            raise ValueError(f"it has coordinates that are no numbers, or not within {_MAX_COORDINATE:g} m")
        by_color.setdefault(_mean_color(geometry.visual), []).append(surface)
    return [merge_surfaces(parts, color) for color, parts in by_color.items()]


def _mean_color(visual: Any) -> Color | None:
    """Return the mean colour of a mesh's material, texture or vertices; None without any."""
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
    """Return surfaces as one of this colour."""
    starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces])
    return Surface(
        np.concatenate([surface.vertices for surface in surfaces]),
        np.concatenate([surface.faces + start for surface, start in zip(surfaces, starts, strict=False)]),
        color,
    )


def decimate(surfaces: Sequence[Surface], scales: Sequence[float], uses: Sequence[int], total: int) -> list[Surface]:
    """Return surfaces of about `total` triangles, where each counts as often as it is used.

    A surface, scaled, keeps triangles in proportion to the square root of its area, if it has that many; more where it
    would change by more than a share of the size of the largest one.
    """
    surfaces = [_weld(surface, _CELLS) for surface in surfaces]
    available = np.array([len(surface.faces) for surface in surfaces])
    sizes = np.sqrt([surface.area for surface in surfaces]) * scales
    extents = [float(np.ptp(surface.vertices, axis=0).max()) if len(surface.faces) else 0.0 for surface in surfaces]
    tolerance = _TOLERANCE * float(np.max(np.multiply(extents, scales), initial=0.0))

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
    """Return a surface of `count` triangles, or more where that would move it by more than a tolerance [m]."""
    if len(surface.faces) <= count:
        return surface
    # Slivers as CAD writes them can't be collapsed, but welded.
    welded = _weld(surface, 512)
    reduced = _simplify(welded, count, tolerance)
    if len(reduced.faces) > max(1.5 * count, count + _FEW_EXTRA_TRIANGLES):
        reduced = _simplify(_drop_hidden(welded), count, tolerance)
    cells = 256
    while len(reduced.faces) > 8 * count and cells:
        reduced, cells = _weld(reduced, cells), cells // 2
    return reduced


def _simplify(surface: Surface, count: int, tolerance: float) -> Surface:
    """Collapse edges down to `count` triangles, as long as the surface moves by less than a tolerance [m]."""
    # The library raises its threshold of squared distances up to 1e-9 (100 + 3)^agg, after 100 rounds.
    scale = math.sqrt(1e-9 * 103**3) / max(tolerance, 1e-9)
    vertices, faces = fast_simplification.simplify(
        scale * surface.vertices, surface.faces, target_count=min(count, len(surface.faces)), agg=3
    )
    return _weld(Surface(np.asarray(vertices, float) / scale, np.asarray(faces, np.int64), surface.color), _CELLS)


def _drop_hidden(surface: Surface) -> Surface:
    """Return the triangles that are seen from one of 14 directions around the surface."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    owner = np.repeat(np.arange(len(areas)), np.ceil(_SAMPLES * areas / areas.sum()).astype(np.int64).clip(1))
    share = np.random.default_rng(0).random((len(owner), 2))
    share = np.where(share.sum(axis=1, keepdims=True) > 1, 1 - share, share)
    points = a[owner] + share[:, :1] * (b - a)[owner] + share[:, 1:] * (c - a)[owner]
    cell = float(np.ptp(surface.vertices, axis=0).max()) / _PIXELS
    seen = np.zeros(len(areas), bool)
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
        seen[owner[height >= top[index] - cell]] = True
    return _weld(Surface(surface.vertices, surface.faces[seen], surface.color), _CELLS)


def _weld(surface: Surface, cells: int) -> Surface:
    """Merge vertices within cells of a fraction of the surface's size; drop triangles without area and vertices.

    Nothing may be left.
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
