"""What a URDF or MJCF draws: meshes and primitive shapes, with their colours and places."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import mjtGeom, mjtTextureRole

from surefoot.arrays import Array
from surefoot.errors import SurefootError, describe_os_errors
from surefoot.files import check_readable
from surefoot.native_output import mujoco_errors
from surefoot.robot.appearance import triangulate
from surefoot.robot.importing.meshes import Color, Surface, decimate, read_mesh
from surefoot.robot.importing.named_files import MAX_MESH_BYTES
from surefoot.robot.urdf_file import read_colors, read_frame, read_material, read_numbers, read_shape
from surefoot.rotations import quat_matrix

TARGET_TRIANGLES = 24_000
"""Triangles of a robot that are kept, about."""
_SOLIDS = {
    mjtGeom.mjGEOM_BOX: "box",
    mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mjtGeom.mjGEOM_SPHERE: "sphere",
    mjtGeom.mjGEOM_CAPSULE: "sphere",
    mjtGeom.mjGEOM_ELLIPSOID: "sphere",
}
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
"""Colour of MuJoCo's geoms that have none of their own: a material's counts then."""
_VISIBLE_GROUPS = 3
"""Groups of geoms that MuJoCo's viewer shows."""


class Visual(NamedTuple):
    """A surface on a body of MuJoCo's model."""

    body: str | int
    """The body's name or number."""
    surface: Surface
    """The same object in all visuals of a mesh."""
    frame: Array
    """Frame (4, 4) in the body's, which may scale and mirror."""
    color: Color


def decimate_visuals(visuals: Sequence[Visual]) -> list[Visual]:
    """Return visuals of about `TARGET_TRIANGLES` in all; a mesh that is there several times is decimated once."""
    uses: dict[Surface, list[Visual]] = {}
    for visual in visuals:
        uses.setdefault(visual.surface, []).append(visual)
    sizes = [np.cbrt(abs(np.linalg.det(items[0].frame[:3, :3]))) for items in uses.values()]
    reduced = decimate(list(uses), sizes, list(map(len, uses.values())), TARGET_TRIANGLES)
    surfaces = dict(zip(uses, reduced, strict=True))
    return [visual._replace(surface=surfaces[visual.surface]) for visual in visuals]


def read_urdf_visuals(
    root: ElementTree.Element, path: Path, find_mesh: Callable[[str, Path], Path], notes: list[str]
) -> tuple[list[Visual], list[str]]:
    """Return what a URDF draws, and the links of which something can't be read, which is left out and noted.

    A mesh has its own colours, else that of the URDF's material, as in RViz.
    """
    colors, visuals, problems, incomplete = read_colors(root, path), [], [], []
    meshes: dict[Path, list[Surface]] = {}
    for link in root.findall("link"):
        name = link.get("name", "")
        for element in link.findall("visual"):
            where = f"link '{name}': visual"
            try:
                red, green, blue = (value / 255 for value in read_material(element, colors, where))
                frame = read_frame(element.find("origin"), where)
                if (mesh := element.find("geometry/mesh")) is not None:
                    file = find_mesh(mesh.get("filename", ""), path)
                    if file not in meshes:
                        meshes[file] = read_mesh(file)
                    surfaces = meshes[file]
                    frame = frame @ np.diag([*read_numbers(mesh.get("scale", "1 1 1"), 3, f"{where}: scale"), 1.0])
                elif (shape := read_shape(element, name, colors, where)) is not None:
                    surfaces = [Surface(*triangulate(shape.kind, shape.size))]
                else:
                    continue
                if mesh is not None and not 1e-15 < abs(np.linalg.det(frame)) < 1e15:
                    raise SurefootError(f"{where}: scale is {mesh.get('scale')}; a volume is scaled by 1e-15 to 1e+15")
            except SurefootError as error:
                problems.append(str(error).removeprefix(f"{path}: "))
                incomplete.append(name)
                continue
            visuals += [Visual(name, surface, frame, surface.color or (red, green, blue)) for surface in surfaces]
    note_problems("not drawn", problems, notes)
    return visuals, incomplete


def read_mjcf_visuals(path: Path, notes: list[str]) -> list[Visual]:
    """Return what an MJCF draws.

    Bodies that are welded together are one part. If one of its shapes that collide with nothing is a mesh, those shapes
    are drawn; else, if one that MuJoCo's viewer shows is a mesh, what the viewer shows; else all shapes.
    """
    try:
        with mujoco_errors(path):
            spec = mujoco.MjSpec.from_file(str(path))
            spec.compiler.fusestatic = False
            for key in list(spec.keys):
                spec.delete(key)
            for mesh in spec.meshes:
                with describe_os_errors(mesh.file):
                    if (file := Path(spec.modelfiledir, spec.meshdir, mesh.file)).exists():
                        check_readable(file, MAX_MESH_BYTES)
            model = spec.compile()
    except SurefootError as error:
        note_problems("not drawn", [str(error).removeprefix(f"{path}: ")], notes)
        return []
    part, mesh_geoms = model.body_weldid[model.geom_bodyid], model.geom_type == mjtGeom.mjGEOM_MESH
    shown = model.geom_group < _VISIBLE_GROUPS
    decor = (model.geom_contype == 0) & (model.geom_conaffinity == 0)
    shown |= ~np.isin(part, part[shown & mesh_geoms])
    shown = np.where(np.isin(part, part[decor & mesh_geoms]), decor, shown)
    surfaces: dict[int, Surface] = {}
    visuals = []
    for geom in np.flatnonzero(shown):
        kind, size, mesh = int(model.geom_type[geom]), model.geom_size[geom], int(model.geom_dataid[geom])
        rgba = _geom_rgba(model, int(geom))
        if rgba[3] == 0.0 or (kind != mjtGeom.mjGEOM_MESH and kind not in _SOLIDS):
            continue
        if kind != mjtGeom.mjGEOM_MESH:
            surface = _solid(mjtGeom(kind), size)
        else:
            surface = surfaces[mesh] = surfaces.get(mesh) or _mesh_surface(model, mesh)
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = quat_matrix(model.geom_quat[geom]), model.geom_pos[geom]
        red, green, blue = (float(value) for value in np.clip(rgba[:3], 0, 1))
        visuals.append(Visual(int(model.geom_bodyid[geom]), surface, frame, (red, green, blue)))
    return visuals


def _mesh_surface(model: mujoco.MjModel, mesh: int) -> Surface:
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
    return Surface(vertices.astype(float), faces.astype(np.int64))


def _solid(kind: mjtGeom, size: Array) -> Surface:
    """Return the surface of a primitive geom; a capsule is a sphere in two halves, an ellipsoid a scaled one."""
    if kind == mjtGeom.mjGEOM_ELLIPSOID:
        points, faces = triangulate("sphere", (1.0,))
        return Surface(points * size, faces)
    points, faces = triangulate(_SOLIDS[kind], tuple(size.tolist()))
    if kind == mjtGeom.mjGEOM_CAPSULE:
        points[:, 2] += np.sign(points[:, 2]) * size[1]
    return Surface(points, faces)


def _geom_rgba(model: mujoco.MjModel, geom: int) -> Array:
    """Return a geom's red, green, blue and alpha: its own, or its material's, times the mean of its texture."""
    rgba, material = model.geom_rgba[geom].astype(float), int(model.geom_matid[geom])
    if material < 0:
        return rgba
    if np.allclose(rgba, _DEFAULT_RGBA):
        rgba = model.mat_rgba[material].astype(float)
    if (texture := int(model.mat_texid[material, mjtTextureRole.mjTEXROLE_RGB])) >= 0:
        count = int(model.tex_height[texture]) * int(model.tex_width[texture])
        channels = int(model.tex_nchannel[texture])
        texels = model.tex_data[model.tex_adr[texture] :][: count * channels].reshape(count, channels)
        rgba[:3] *= texels[:, :3].mean(axis=0) / 255
    return rgba


def note_problems(consequence: str, problems: Iterable[str], notes: list[str]) -> None:
    """Add one note about problems that were met, the first of them in full."""
    if messages := list(dict.fromkeys(problems)):
        more = f" (and {len(messages) - 1} more)" if len(messages) > 1 else ""
        notes.append(f"{consequence}: {messages[0]}{more}")
