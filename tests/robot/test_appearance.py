"""Visual meshes of robots: triangulated primitive shapes, the file of visuals, and invalid files."""

from __future__ import annotations

import runpy
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.npz import read_npz, write_npz
from surefoot.robot import RobotDescription
from surefoot.robot.appearance import VISUALS_FILE, Appearance, VisualPart, visual_shapes
from surefoot.robot.urdf import Link, Shape, Urdf

SOLO = RobotDescription.load("solo8")


def volume(part: VisualPart) -> float:
    """Return the volume enclosed by a part's triangles, negative if they face inward."""
    a, b, c = np.moveaxis(part.vertices[part.faces].astype(float), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def triangulate_shape(kind: str, size: tuple[float, ...], place: tuple[float, float, float]) -> VisualPart:
    frame = np.eye(4)
    frame[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    frame[:3, 3] = place
    shape = Shape("base", kind, size, frame, (255, 51, 0))
    body = SOLO.urdf.links["base"].body
    (part,) = Appearance.from_urdf(Urdf(Path("x"), {"base": Link(body, (shape,), ())}, {}), ()).parts
    return part


@pytest.mark.parametrize(
    ("kind", "size", "exact", "half"),
    [
        ("box", (0.1, 0.2, 0.3), 0.048, (0.2, 0.1, 0.3)),
        ("cylinder", (0.1, 0.3), np.pi * 0.01 * 0.6, (0.1, 0.1, 0.3)),
        ("sphere", (0.1,), 4 / 3 * np.pi * 1e-3, (0.1, 0.1, 0.1)),
    ],
)
def test_a_shape_is_a_closed_surface_in_its_frame(kind: str, size: tuple[float, ...], exact: float, half: tuple):
    part = triangulate_shape(kind, size, (1.0, 2.0, 3.0))
    assert part.color == (1.0, 0.2, 0.0)
    assert (part.vertices.dtype, part.faces.dtype) == (np.float32, np.int32)
    # A polygon with 20 corners has 1.6 % less area than its circle; a sphere also has flat ends.
    assert volume(part) == pytest.approx(exact, rel=1e-5 if kind == "box" else 0.06)
    np.testing.assert_allclose(part.vertices.max(axis=0) - [1, 2, 3], half, rtol=0.03)
    # Each edge of a closed surface belongs to two triangles, in opposite directions.
    edges = {tuple(edge) for face in part.faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)}
    assert len(edges) == 3 * len(part.faces)
    assert {(b, a) for a, b in edges} == edges


def test_a_robot_without_visual_meshes_has_the_parts_of_its_urdf():
    robot = replace(RobotDescription.load("minitaur"), visuals=None)
    visuals = [shape for link in robot.urdf.links.values() for shape in link.visuals]
    parts = robot.appearance().parts
    assert [part.link for part in parts] == [shape.link for shape in visuals]
    assert parts[0].color == tuple(value / 255 for value in visuals[0].color)


@pytest.mark.parametrize("name", ["go2", "pupper_v2"])
def test_hips_without_visuals_are_cylinders_between_the_joints(name: str):
    robot = RobotDescription.load(name)
    shapes, frames = visual_shapes(robot.urdf, robot.legs), robot.link_frames(robot.resting_angles)
    for leg in robot.legs:
        abduction, upper = (robot.urdf.joints[motor].child for motor in leg.motors[:2])
        (hip,) = (shape for shape in shapes if shape.link == abduction)
        assert np.allclose(hip.rotation @ hip.rotation.T, np.eye(3))
        assert np.linalg.det(hip.rotation) == pytest.approx(1.0)
        ends = [hip.position + side * hip.size[1] * hip.rotation[:, 2] for side in (-1.0, 1.0)]
        places = [(frames[abduction] @ [*end, 1.0])[:3] for end in ends]
        assert np.allclose(places, [frames[link][:3, 3] for link in (abduction, upper)], atol=1e-9)


@pytest.mark.parametrize("name", RobotDescription.available())
def test_visuals_of_released_robots_match_their_script(name: str, tmp_path: Path) -> None:
    script = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "visuals.py"))
    robot = RobotDescription.load(name)
    script["appearance"](script["ROBOTS"][name]).save(tmp_path / VISUALS_FILE)
    assert (tmp_path / VISUALS_FILE).read_bytes() == (robot.folder / VISUALS_FILE).read_bytes()
    parts = robot.appearance().parts
    # Visual feet end where the robot's foot spheres end, to a millimetre.
    frames = robot.link_frames(robot.resting_angles)
    for leg in robot.legs:
        points = np.concatenate([part.vertices for part in parts if part.link == leg.foot])
        (shape,) = (shape for shape in robot.urdf.links[leg.foot].collisions if shape.kind == "sphere")
        sole = (frames[leg.foot] @ [*shape.position, 1.0])[2] - shape.size[0]
        lowest = (points @ frames[leg.foot][2, :3] + frames[leg.foot][2, 3]).min()
        assert lowest == pytest.approx(sole, abs=1e-3)


def write_visuals(folder: Path, change: Callable[[dict[str, Any], dict[str, Any]], None] | None = None) -> Path:
    """Write a robot's folder with two visual parts, and modify the arrays and meta of the file."""
    shutil.copytree(SOLO.folder, folder)
    corners = np.array([(0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0, 0, 0.1)], np.float32)
    faces = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], np.int32)
    parts = (
        VisualPart("base", corners, faces, (1.0, 0.5, 0.0)),
        VisualPart("front_left_upper", corners[:3] - np.float32(0.123456), faces[:1], (0.2, 0.2, 0.2)),
    )
    Appearance(parts).save(folder / VISUALS_FILE)
    if change is not None:
        arrays = read_npz(folder / VISUALS_FILE)
        arrays.pop("meta")
        meta = {"links": [part.link for part in parts]}
        change(arrays, meta)
        write_npz(folder / VISUALS_FILE, arrays, meta)
    return folder


def test_saved_visuals_are_read_back_with_16_bit_precision(tmp_path: Path) -> None:
    folder = write_visuals(tmp_path / "mine")
    first, second = RobotDescription.load(folder).appearance().parts
    assert (first.link, second.link) == ("base", "front_left_upper")
    np.testing.assert_allclose(first.color, (1.0, 0.5, 0.0), atol=0.002)
    assert volume(first) == pytest.approx(0.3 * 0.2 * 0.1 / 6, rel=1e-5)
    np.testing.assert_allclose(second.vertices[1], [0.3 - 0.123456, -0.123456, -0.123456], atol=0.3 / 65535)
    np.testing.assert_array_equal(second.faces, [(0, 2, 1)])
    before = (folder / VISUALS_FILE).read_bytes()
    Appearance((first, second)).save(folder / VISUALS_FILE)
    assert (folder / VISUALS_FILE).read_bytes() == before


def setter(name: str, index: Any, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    def change(arrays: dict[str, Any], meta: dict[str, Any]) -> None:
        arrays[name][index] = value

    return change


def replacer(name: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda arrays, meta: arrays.update({name: value})


HOSTILE = {
    "no links": (lambda arrays, meta: meta.clear(), "meta has no list 'links'"),
    "links that are none": (lambda arrays, meta: meta.update(links="base"), "meta has no list 'links'"),
    "another robot's link": (lambda arrays, meta: meta.update(links=["base", "tail"]), "has a part on 'tail'"),
    "a link that is a list": (lambda arrays, meta: meta.update(links=["base", [1]]), r"has a part on \[1\]"),
    "too few rows": (lambda arrays, meta: meta.update(links=["base"]), "must have one for each of 1 parts"),
    "a missing array": (lambda arrays, meta: arrays.pop("faces"), "has no array 'faces'"),
    "floats": (replacer("faces", np.zeros((5, 3))), "has no array 'faces' of type u4 with 3 columns"),
    "one dimension": (replacer("faces", np.zeros(15, np.uint32)), "has no array 'faces' of type u4"),
    "a wide array": (replacer("color", np.zeros((2, 4), np.uint8)), "has no array 'color'"),
    "counts over what is there": (setter("counts", (1, 0), 4), "does not sum to"),
    "counts that overflow": (setter("counts", slice(None), 0xFFFFFFFF), "does not sum to"),
    "an empty part": (setter("counts", slice(None), [(7, 5), (0, 0)]), "a part without"),
    "a vertex of another part": (setter("faces", (4, 0), 3), "part 1 has a triangle with a vertex that does not exist"),
    "no number": (setter("low", (0, 0), np.nan), "not within 1000 m"),
    "too far": (setter("low", (0, 0), 1e4), "not within 1000 m"),
    "a negative span": (setter("span", (0, 0), -1), "a span is negative"),
    "too many triangles": (
        lambda arrays, meta: arrays.update(
            faces=np.zeros((200_002, 3), np.uint32), counts=np.array([(4, 200_001), (3, 1)], np.uint32)
        ),
        "has 200002 triangles; at most 200000",
    ),
    "unpacked too large": (replacer("more", np.zeros(1 << 24, np.uint8)), "unpacks to more than 16777216 bytes"),
    "too large": (replacer("more", np.random.default_rng(0).bytes(1 << 21)), "at most 2097152 are read"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_invalid_visuals_files_are_rejected(case: str, tmp_path: Path) -> None:
    change, message = HOSTILE[case]
    robot = RobotDescription.load(write_visuals(tmp_path / "mine", change))
    with pytest.raises(SurefootError, match=f"visuals.npz: .*{message}"):
        robot.appearance()


@pytest.mark.parametrize("name", ["../visuals.npz", "/etc/passwd", "", ".."])
def test_visuals_outside_the_robots_folder_are_rejected(name: str, tmp_path: Path) -> None:
    folder = write_visuals(tmp_path / "mine")
    sheet = folder / "robot.toml"
    sheet.write_text(sheet.read_text().replace(f'"{VISUALS_FILE}"', f'"{name}"'))
    with pytest.raises(SurefootError, match=r"visuals is '.*'; it must be the name of a file in the robot's folder"):
        RobotDescription.load(folder)


def test_truncated_and_missing_visuals_are_rejected(tmp_path: Path) -> None:
    folder = write_visuals(tmp_path / "mine")
    robot = RobotDescription.load(folder)
    (folder / VISUALS_FILE).write_bytes((folder / VISUALS_FILE).read_bytes()[:-40])
    with pytest.raises(SurefootError, match=r"visuals.npz: is cut off"):
        robot.appearance()
    (folder / VISUALS_FILE).unlink()
    with pytest.raises(SurefootError, match=r"visuals.npz: can't be read: No such file"):
        robot.appearance()
