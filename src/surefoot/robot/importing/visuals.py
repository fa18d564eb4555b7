"""Visual meshes and primitive shapes of a URDF or MJCF, with their colours and frames."""

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
"""Approximate number of triangles of a robot after decimation."""
_SOLIDS = {
    mjtGeom.mjGEOM_BOX: "box",
    mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mjtGeom.mjGEOM_SPHERE: "sphere",
    mjtGeom.mjGEOM_CAPSULE: "sphere",
    mjtGeom.mjGEOM_ELLIPSOID: "sphere",
}
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
"""Default colour of MuJoCo's geoms, which a material overrides."""
_VISIBLE_GROUPS = 3
"""Number of geom groups that MuJoCo's viewer shows by default."""


class Visual(NamedTuple):
    """A visual surface on a body of a MuJoCo model."""

    body: str | int
    """The body's name or number."""
    surface: Surface
    """The surface; all visuals with the same mesh share one object."""
    frame: Array
    """Transform (4, 4) to the body's frame, which may scale and mirror."""
    color: Color


def decimate_visuals(visuals: Sequence[Visual]) -> list[Visual]:
    """Decimate visuals to about `TARGET_TRIANGLES` triangles in total; a shared mesh is decimated once."""
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
    """Read the visuals of a URDF.

    A mesh has its own colours, or else the colour of the URDF's material, as in RViz.

    Returns:
        The visuals, and the names of links with a visual that can't be read; it is left out and noted.
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
                    raise SurefootError(
                        f"{where}: scale is {mesh.get('scale')}; the product of its factors must be 1e-15 to 1e+15"
                    )
            except SurefootError as error:
                problems.append(str(error).removeprefix(f"{path}: "))
                incomplete.append(name)
                continue
            visuals += [Visual(name, surface, frame, surface.color or (red, green, blue)) for surface in surfaces]
    note_problems("not drawn", problems, notes)
    return visuals, incomplete


def read_mjcf_visuals(path: Path, notes: list[str]) -> list[Visual]:
    """Read the visuals of an MJCF.

    Bodies that are welded together form one part. If the non-colliding geoms of a part include a mesh, these geoms are
    its visuals; else, if the geoms that MuJoCo's viewer shows include a mesh, these; else all its geoms.
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
    """Triangulate a primitive geom; a capsule is a sphere split into two halves, an ellipsoid a scaled sphere."""
    if kind == mjtGeom.mjGEOM_ELLIPSOID:
        points, faces = triangulate("sphere", (1.0,))
        return Surface(points * size, faces)
    points, faces = triangulate(_SOLIDS[kind], tuple(size.tolist()))
    if kind == mjtGeom.mjGEOM_CAPSULE:
        points[:, 2] += np.sign(points[:, 2]) * size[1]
    return Surface(points, faces)


def _geom_rgba(model: mujoco.MjModel, geom: int) -> Array:
    """Return the RGBA colour of a geom: its own or its material's, multiplied by the mean colour of its texture."""
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
    """Add one note about several problems, with the first message in full."""
    if messages := list(dict.fromkeys(problems)):
        more = f" (and {len(messages) - 1} more)" if len(messages) > 1 else ""
        notes.append(f"{consequence}: {messages[0]}{more}")
