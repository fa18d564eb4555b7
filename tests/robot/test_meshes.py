"""Meshes of imported robots: colours, transforms to link frames, decimation, feet, and damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.importing.foot_sphere import fit_sphere
from surefoot.robot.importing.meshes import Surface, decimate, read_mesh
from surefoot.robot.importing.reader import read_robot
from surefoot.robot.importing.writer import write_robot

SOLO = RobotDescription.load("solo8")
SOLID = np.array([(0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0, 0, 0.1)])
FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
"""A corner of a box, whose longest edge is along x and whose volume is 0.001 m3."""


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the enclosed volume, negative if the triangles face inward."""
    a, b, c = np.moveaxis(np.asarray(vertices, float)[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def write_obj(folder: Path) -> Path:
    """Write the solid with two triangles red and two blue."""
    lines = ["mtllib solid.mtl", *(f"v {x} {y} {z}" for x, y, z in SOLID)]
    for name, faces in (("red", FACES[:2]), ("blue", FACES[2:])):
        lines += [f"usemtl {name}", *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]
    (folder / "solid.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n")
    (folder / "solid.obj").write_text("\n".join(lines))
    return folder / "solid.obj"


def write_dae(folder: Path, extra: str = "") -> Path:
    """Write the solid in mm, rotated by a node by a quarter turn about z, in a file with y as up axis."""
    points = " ".join(f"{1000 * value:g}" for value in SOLID.ravel())
    (folder / "solid.dae").write_text(f"""<?xml version="1.0"?>{extra}
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="millimeter" meter="0.001"/><up_axis>Y_UP</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="t"><phong><diffuse><color>0 1 0 1</color></diffuse>
</phong></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa" count="12">{points}</float_array>
<technique_common><accessor source="#pa" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles material="s" count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<p>{" ".join(map(str, FACES.ravel()))}</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node id="n"><rotate>0 0 1 90</rotate><instance_geometry url="#g">
<bind_material><technique_common><instance_material symbol="s" target="#m"/></technique_common></bind_material>
</instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#w"/></scene></COLLADA>""")
    return folder / "solid.dae"


def write_stl(folder: Path) -> Path:
    trimesh.Trimesh(SOLID, FACES, process=False).export(folder / "solid.stl")
    return folder / "solid.stl"


def test_an_obj_has_one_surface_per_material_colour(tmp_path: Path) -> None:
    surfaces = {surface.color: surface for surface in read_mesh(write_obj(tmp_path))}
    assert set(surfaces) == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}
    assert [len(surface.faces) for surface in surfaces.values()] == [2, 2]
    np.testing.assert_allclose(surfaces[1.0, 0.0, 0.0].vertices.max(axis=0), [0.3, 0.2, 0.1])


@pytest.mark.parametrize("broken", [False, True])
def test_collada_units_and_node_transforms_are_applied_but_not_up_axis(broken: bool, tmp_path: Path) -> None:
    path = write_dae(tmp_path)
    if broken:  # The reader would drop the geometry with a missing material; without it the URDF's colour applies.
        path.write_text(path.read_text().replace('url="#e"', 'url="#none"'))
    (surface,) = read_mesh(path)
    assert surface.color == (None if broken else (0.0, 1.0, 0.0))
    # (x, y, z) is turned to (-y, x, z).
    np.testing.assert_allclose(surface.vertices.min(axis=0), [-0.2, 0, 0], atol=1e-7)
    np.testing.assert_allclose(surface.vertices.max(axis=0), [0, 0.3, 0.1], atol=1e-7)
    assert volume(surface.vertices, surface.faces) == pytest.approx(0.001)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.stl", b"solid nothing", "no triangles|can't be read as STL"),
        ("a.stl", bytes(80) + b"\xff\xff\xff\x7f", "has no triangles"),
        ("a.obj", b"v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", "coordinates that are not finite"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 9\n", "can't be read as OBJ"),
        ("a.dae", b"<COLLADA", "can't be read as DAE"),
        ("a.dae", b'<!DOCTYPE c [<!ENTITY a "b">]><COLLADA/>', "declares XML entities"),
        ("a.ply", b"", r"is not a file of type \.stl, \.obj, \.dae"),
    ],
)
def test_damaged_meshes_are_rejected_in_one_line(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SurefootError, match=message) as caught:
        read_mesh(tmp_path / name)
    assert "\n" not in str(caught.value)


def doubling(levels: int) -> str:
    """Return nodes b0, b1, ..., each of which instantiates the previous node twice."""
    nodes = '<node id="b0"><instance_geometry url="#g"/></node>'
    for k in range(1, levels + 1):
        nodes += f'<node id="b{k}">{2 * f"""<instance_node url="#b{k - 1}"/>"""}</node>'
    return f"<library_nodes>{nodes}</library_nodes>"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('meter="0.001"', 'meter="nan"'),
        ('meter="0.001"', 'meter="1e300"'),
        ("<rotate>0 0 1 90</rotate>", "<scale>nan 1 1</scale>"),
        ("<rotate>0 0 1 90</rotate>", "<scale>1 1e200 1</scale>"),
        ("<rotate>0 0 1 90</rotate>", '<instance_node url="#n"/>'),
        ("<library_visual", f"{doubling(40)}<library_visual"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_excessive_nodes_and_units_are_rejected_in_one_line(old: str, new: str, tmp_path: Path) -> None:
    path = write_dae(tmp_path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(SurefootError, match=r"solid\.dae can't be read as DAE: ") as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value)


@pytest.mark.timeout(20)
def test_nodes_without_geometries_are_counted(tmp_path: Path) -> None:
    """Three kilobytes of nodes, each of which instantiates the previous node ten times, expand to 10^11 nodes."""
    nodes = '<node id="b0"/>'
    for k in range(1, 12):
        nodes += f'<node id="b{k}">{10 * f"""<instance_node url="#b{k - 1}"/>"""}</node>'
    path = write_dae(tmp_path)
    text = path.read_text().replace("<library_visual", f"<library_nodes>{nodes}</library_nodes><library_visual", 1)
    path.write_text(text.replace("<rotate>0 0 1 90</rotate>", '<instance_node url="#b11"/>'))
    with pytest.raises(
        SurefootError, match=r"solid\.dae can't be read as DAE: its nested nodes.* at most 20000 are read"
    ):
        read_mesh(path)


def test_nodes_with_the_same_name_are_all_counted(tmp_path: Path) -> None:
    path = write_dae(tmp_path)
    double = f'<node id="b40"/>{doubling(40).removeprefix("<library_nodes>")}'
    text = path.read_text().replace("<library_visual", f"<library_nodes>{double}<library_visual", 1)
    path.write_text(text.replace("</library_nodes>", '<node id="b40"/></library_nodes>', 1))
    with pytest.raises(SurefootError, match="at most 20000 are read"):
        read_mesh(path)


def test_decimation_preserves_the_shape_within_the_budget() -> None:
    ball, dot = trimesh.creation.icosphere(5, 0.5), trimesh.creation.icosphere(1, 0.01)
    surfaces = [Surface(np.array(mesh.vertices), np.array(mesh.faces)) for mesh in (ball, dot)]
    large, small = decimate(surfaces, [1.0, 1.0], [1, 4], 1000)
    assert len(ball.faces) == 20480
    # More triangles than requested, because a coarser ball would deviate by more than the tolerance.
    assert 900 < len(large.faces) + 4 * len(small.faces) < 2000
    assert volume(large.vertices, large.faces) == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.02)
    np.testing.assert_allclose(np.ptp(large.vertices, axis=0), 1.0, atol=0.02)


def test_decimation_removes_hidden_triangles() -> None:
    outside, inside = trimesh.creation.icosphere(4, 0.5), trimesh.creation.icosphere(6, 0.2)
    both = trimesh.util.concatenate([outside, inside])
    (surface,) = decimate([Surface(np.array(both.vertices), np.array(both.faces))], [1.0], [1], 60)
    assert np.linalg.norm(surface.vertices, axis=1).min() > 0.4


def add_visuals(visuals: str, materials: str = "") -> str:
    text = SOLO.urdf.path.read_text()
    return text.replace('<link name="front_left_upper">', f'{materials}<link name="front_left_upper">{visuals}', 1)


def visual(mesh: str, scale: str, material: str = "", origin: str = '<origin xyz=".1 .2 .3" rpy="0 0 0"/>') -> str:
    return f'<visual>{origin}<geometry><mesh filename="{mesh}" scale="{scale}"/></geometry>{material}</visual>'


def test_meshes_are_transformed_to_the_written_link_frames(tmp_path: Path) -> None:
    write_stl(tmp_path)
    write_obj(tmp_path)
    red = '<material name="own"><color rgba=".2 .4 .6 1"/></material>'
    mirrored = visual("solid.stl", "1 -1 1", '<material name="own"/>')
    (tmp_path / "solo.urdf").write_text(
        add_visuals(visual("package://any/solid.obj", "2 2 2") + mirrored + visual("none.stl", "1 1 1"), red)
    )
    imported = read_robot(tmp_path / "solo.urdf")
    assert "not drawn: mesh 'none.stl' does not exist; put it where the file names it" in imported.notes
    write_robot(imported, tmp_path / "mine", "mine")
    robot = RobotDescription.load(tmp_path / "mine")
    parts = {part.color: part for part in robot.appearance().parts if part.link == "front_left_upper"}
    own = next(part for color, part in parts.items() if np.allclose(color, (0.2, 0.4, 0.6)))
    # The file's link frames are parallel to the base frame and at the hinges, like the written frames.
    place = imported.axis_points[0, 0] - SOLO.urdf.frames()["front_left_upper"][:3, 3]
    np.testing.assert_allclose(own.vertices.min(axis=0), np.array([0.1, 0.0, 0.3]) - place, atol=1e-4)
    np.testing.assert_allclose(own.vertices.max(axis=0), np.array([0.4, 0.2, 0.4]) - place, atol=1e-4)
    # Mirrored meshes still face outward.
    assert volume(own.vertices - own.vertices.mean(axis=0), own.faces) == pytest.approx(0.001, rel=1e-3)
    np.testing.assert_allclose(parts[1.0, 0.0, 0.0].vertices.max(axis=0), np.array([0.7, 0.6, 0.5]) - place, atol=1e-4)
    assert read_robot(tmp_path / "solo.urdf", meshes=False).parts == ()


def test_unreadable_visuals_are_noted_and_the_written_folder_loads(tmp_path: Path) -> None:
    write_obj(tmp_path)
    (tmp_path / "line.obj").write_text("v 0 0 0\nv 1 0 0\nf 1 2 2\n")
    visuals = visual("solid.obj", "1e4 1e4 1e4") + visual("solid.obj", "1 0 1") + visual("line.obj", "1 1 1")
    (tmp_path / "solo.urdf").write_text(add_visuals(visuals))
    imported = read_robot(tmp_path / "solo.urdf")
    message = "link 'front_left_upper': visual: scale is 1 0 1; the product of its factors must be 1e-15 to 1e+15"
    assert f"not drawn: {message}" in imported.notes
    message = "shapes of front_left_upper have no area, or are farther away than 1000 m"
    assert f"not drawn: {message}" in imported.notes
    write_robot(imported, tmp_path / "mine", "mine")
    assert RobotDescription.load(tmp_path / "mine").appearance().parts


def foot(radius: float, width: float, tilt: float) -> np.ndarray:
    """Return points of a disc about the y axis at the end of a 0.2 m leg, which is rotated about the knee."""
    angle = np.linspace(0, 2 * np.pi, 200)
    points = np.array([(radius * np.cos(a), y, radius * np.sin(a) - 0.2) for a in angle for y in (0, width)])
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    return np.concatenate([points, [[0.01, 0, 0], [-0.01, 0, 0]]]) @ turn.T


@pytest.mark.parametrize("tilt", [-0.6, 0.0, 0.6])
def test_the_foot_is_the_sphere_on_which_the_link_rolls(tilt: float) -> None:
    end = np.array([-0.19 * np.sin(tilt), 0.0, -0.19 * np.cos(tilt)])
    fitted = fit_sphere(foot(0.016, 0.01, tilt), np.zeros(3), end)
    assert fitted is not None
    centre, radius = fitted
    assert radius == pytest.approx(0.016, rel=0.01)
    np.testing.assert_allclose(centre, [-0.2 * np.sin(tilt), 0.005, -0.2 * np.cos(tilt)], atol=2e-4)


def test_a_link_that_does_not_roll_has_no_sphere() -> None:
    stick = np.array([(x, y, z) for x in (-0.1, 0.1) for y in (-0.01, 0.01) for z in (0.0, -0.2)])
    assert fit_sphere(stick, np.zeros(3), np.array([0.0, 0.0, -0.2])) is None
