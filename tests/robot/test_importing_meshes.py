"""Meshes of a robot's files: places, units and colours of what is read, and hostile files."""

import time
from pathlib import Path

import numpy as np
import pytest


from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.importing.meshes import Surface, decimate, read_mesh
from surefoot.robot.importing.reader import read_robot
from surefoot.robot.importing.writer import write_robot

GEOMETRY = '<instance_geometry url="#g"/>'


def collada(nodes: str, unit: str = "1", library: str = "") -> str:
    """Return a COLLADA file of the triangle (0, 0, 0), (1, 0, 0), (0, 2, 0)."""
    params = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    return f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
    <asset><unit meter="{unit}"/></asset><library_geometries><geometry id="g"><mesh><source id="p">
    <float_array id="a" count="9">0 0 0 1 0 0 0 2 0</float_array><technique_common>
    <accessor source="#a" count="3" stride="3">{params}</accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="1">
    <input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry></library_geometries>
    <library_nodes>{library}</library_nodes><library_visual_scenes><visual_scene id="s">{nodes}</visual_scene>
    </library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def matrix(first: str) -> str:
    """Return a node with the geometry, moved by 3 along x, whose first element is given."""
    return f"<node><matrix>{first} 0 0 3 0 1 0 0 0 0 1 0 0 0 0 1</matrix>{GEOMETRY}</node>"


def doubling(levels: int) -> str:
    """Return nodes b0, b1, ..., of which each holds the one before twice."""
    nodes = [f'<node id="b0">{GEOMETRY}</node>']
    nodes += [f'<node id="b{k}">{2 * f"""<instance_node url="#b{k - 1}"/>"""}</node>' for k in range(1, levels + 1)]
    return "".join(nodes)


def read(folder: Path, text: str, name: str = "part.dae") -> list[Surface]:
    (folder / name).write_text(text)
    return read_mesh(folder / name)


def test_units_and_nodes_of_a_collada_file_place_its_triangles(tmp_path: Path) -> None:
    (surface,) = read(tmp_path, collada(matrix("-1"), unit="0.01"))
    corners = surface.vertices[surface.faces[0]]
    np.testing.assert_allclose(sorted(map(tuple, corners)), [(0.02, 0, 0), (0.03, 0, 0), (0.03, 0.02, 0)], atol=1e-12)
    # Mirrored: outside stays outside, so the normal is that of the triangle before, +z.
    assert np.cross(corners[1] - corners[0], corners[2] - corners[0])[2] > 0


def test_an_obj_file_has_the_colours_of_its_materials_in_another_folder(tmp_path: Path) -> None:
    (tmp_path / "looks").mkdir()
    (tmp_path / "looks" / "dog.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n")
    (tmp_path / "meshes").mkdir()
    text = "mtllib ../looks/dog.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl red\nf 1 2 3\nusemtl blue\nf 1 2 4\n"
    surfaces = read(tmp_path / "meshes", text, "dog.obj")
    assert sorted(surface.color or () for surface in surfaces) == [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]


HOSTILE = {
    "unit that is no number": collada(f"<node>{GEOMETRY}</node>", unit="nan"),
    "unit without bounds": collada(f"<node>{GEOMETRY}</node>", unit="1e300"),
    "node that is no number": collada(matrix("nan")),
    "node without bounds": collada(matrix("1e200")),
    "2 to the power of 40 triangles": collada('<node><instance_node url="#b40"/></node>', library=doubling(40)),
    "node in itself": collada('<node id="n"><instance_node url="#n"/></node>'),
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.filterwarnings("error")
def test_a_hostile_collada_file_is_refused_at_once_in_one_line(case: str, tmp_path: Path) -> None:
    begin = time.perf_counter()
    with pytest.raises(SurefootError, match="part.dae can't be read as DAE") as refusal:
        read(tmp_path, HOSTILE[case])
    assert "\n" not in str(refusal.value)
    assert time.perf_counter() - begin < 2.0


def test_a_surface_without_an_area_is_left_out_by_decimation() -> None:
    line = Surface(np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0, 1, 1], [0, 0, 1]]))
    box = Surface(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    assert [len(surface.faces) for surface in decimate([line, box], [1.0, 1.0], [1, 1], 100)] == [0, 1]


def test_what_can_not_be_drawn_is_noted_and_the_folder_loads(tmp_path: Path) -> None:
    (tmp_path / "far.obj").write_text("v 2000 0 0\nv 2001 0 0\nv 2000 1 0\nf 1 2 3\n")
    (tmp_path / "line.obj").write_text("v 0 0 0\nv 1 0 0\nf 1 2 2\n")
    meshes = "".join(
        f'<visual><geometry><mesh filename="{name}.obj" scale="{scale}"/></geometry></visual>'
        for name, scale in (("far", "1 1 1"), ("line", "1 1 1"), ("far", "1e-9 1e-9 1e-9"))
    )
    text = RobotDescription.load("solo8").urdf.path.read_text().replace('<link name="base">', f'<link name="base">{meshes}', 1)
    (tmp_path / "dog.urdf").write_text(text)
    robot = read_robot(tmp_path / "dog.urdf")
    assert any(note.startswith("not drawn: link 'base': visual: scale is 1e-09") for note in robot.notes)
    write_robot(robot, tmp_path / "dog", "dog")
    links = {part.link for part in RobotDescription.load(tmp_path / "dog").appearance().parts}
    assert links >= {"front_left_upper", "back_right_lower"}
