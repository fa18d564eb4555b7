"""Reading of URDFs: links, shapes, joints, their frames, and files with one thing wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.urdf import GREY, Urdf
from surefoot.robot.urdf_file import read_urdf

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'


def link(name: str, shapes: str = "") -> str:
    return f'<link name="{name}">{INERTIAL}{shapes}</link>'


def joint(name: str, parent: str, child: str, more: str = "", kind: str = "continuous") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{more}</joint>'


def read(folder: Path, *elements: str) -> Urdf:
    path = folder / "toy.urdf"
    path.write_text(f'<robot name="toy">{"".join(elements)}</robot>')
    return read_urdf(path)


def read_elbow(folder: Path, more: str, kind: str = "continuous") -> Urdf:
    """Read an arm on a base, with elements of its joint."""
    return read(folder, link("base"), link("arm"), joint("elbow", "base", "arm", more, kind))


@pytest.mark.parametrize(
    ("name", "mass", "inertia"),
    [
        ("base", 3.353, (0.006837, 0.027262, 0.02987)),
        ("left_rail", 1.32, (0.004147, 0.040913, 0.04184)),
        ("front_left_1_upper", 0.034, (0.00003877, 0.000042198, 0.000003603)),
        ("front_left_1_lower", 0.072, (0.00023166, 0.00023325, 0.00000198)),
        ("front_left_2_lower", 0.086, (0.00032459, 0.00032637, 0.000002178)),
        ("back_right_2_rotor", 0.072, (0.00011397, 0.00011397, 0.00021765)),
    ],
)
def test_mass_and_inertia_of_the_minitaurs_links(robot: RobotDescription, name: str, mass: float, inertia: tuple):
    body = robot.urdf.links[name].body
    assert body.mass == pytest.approx(mass)
    assert np.linalg.eigvalsh(body.inertia) == pytest.approx(sorted(inertia))


def test_rails_are_fixed_to_the_base(robot: RobotDescription):
    assert robot.urdf.root == "base"
    assert robot.urdf.fixed_to("left_rail") == {"base", "left_rail", "right_rail"}


def test_a_joint_moves_the_links_below_it(robot: RobotDescription):
    expected = {f"front_left_1_{part}" for part in ("rotor", "upper", "lower")}
    assert robot.urdf.below("front_left_1_motor") == expected


@pytest.mark.parametrize(
    ("origin", "place"),
    [
        ('<origin xyz="0.1 -2 3e-1" rpy="0 0 0"/>', (0.1, -2.0, 0.3)),
        ('<origin rpy="1 0 0"/>', (0.0, 0.0, 0.0)),
        ("", (0.0, 0.0, 0.0)),
    ],
)
def test_a_joint_has_its_place_in_its_parents_frame(tmp_path: Path, origin: str, place: tuple[float, float, float]):
    elbow = read_elbow(tmp_path, origin).joints["elbow"]
    assert tuple(elbow.frame[:3, 3]) == place
    assert (elbow.parent, elbow.child, elbow.axis) == ("base", "arm", (1.0, 0.0, 0.0))


def test_a_revolute_joint_has_limits_and_a_continuous_one_none(tmp_path: Path):
    limits = '<limit lower="-0.5" upper="1.25" effort="3" velocity="4"/>'
    assert read_elbow(tmp_path, limits, "revolute").joints["elbow"].limits == (-0.5, 1.25)
    assert read_elbow(tmp_path, limits).joints["elbow"].limits is None


# A quarter turn about z: the child's x axis is the parent's y axis. The arm's hand is .2 along the arm's x.
def test_frames_follow_places_and_angles_of_joints(tmp_path: Path):
    turn = f'rpy="0 0 {np.pi / 2}"/><axis xyz="0 0 2"/>'
    # The hand comes first: the order in the file does not matter.
    urdf = read(
        tmp_path,
        *map(link, ("hand", "arm", "base")),
        joint("wrist", "arm", "hand", f'<origin xyz="0.2 0 0" {turn}'),
        joint("elbow", "base", "arm", f'<origin xyz="1 2 3" {turn}'),
    )
    frames = urdf.frames()
    np.testing.assert_array_equal(frames["base"], np.eye(4))
    np.testing.assert_allclose(frames["arm"][:3], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-15)
    np.testing.assert_allclose(frames["hand"][:3], [[-1, 0, 0, 1], [0, -1, 0, 2.2], [0, 0, 1, 3]], atol=1e-15)
    # Another quarter turn of the elbow: the hand is .2 along the base's -x.
    turned = urdf.frames({"elbow": np.array([0.0, np.pi / 2])})["hand"]
    np.testing.assert_allclose(turned[0], frames["hand"], atol=1e-15)
    np.testing.assert_allclose(turned[1][:3], [[0, 1, 0, 0.8], [-1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-15)


def test_shapes_have_sizes_frames_and_colors(tmp_path: Path):
    shapes = (
        '<visual><origin xyz="0 0 1"/><geometry><box size="2 4 6"/></geometry><material name="red"/></visual>'
        '<visual><geometry><cylinder radius="1" length="3"/></geometry>'
        '<material name="own"><color rgba="0 0 1 1"/></material></visual>'
        '<visual><geometry><mesh filename="trunk.stl"/></geometry></visual>'
        '<collision><geometry><sphere radius="0.5"/></geometry></collision>'
    )
    urdf = read(tmp_path, '<material name="red"><color rgba="1 0 0 1"/></material>', link("base", shapes))
    box, cylinder = urdf.links["base"].visuals
    assert (box.link, box.kind, box.size, box.color) == ("base", "box", (1.0, 2.0, 3.0), (255, 0, 0))
    assert box.position.tolist() == [0.0, 0.0, 1.0]
    assert (cylinder.kind, cylinder.size, cylinder.color) == ("cylinder", (1.0, 1.5), (0, 0, 255))
    (sphere,) = urdf.links["base"].collisions
    assert (sphere.kind, sphere.size, sphere.color) == ("sphere", (0.5,), GREY)


@pytest.mark.parametrize(
    ("more", "kind", "message"),
    [
        ('<origin xyz="1 2"/>', "fixed", "origin is '1 2'; it must be 3 finite numbers"),
        ('<origin xyz="a b c"/>', "fixed", "origin is 'a b c'; it must be 3 finite numbers"),
        ('<origin rpy="0 0 nan"/>', "fixed", "rpy is '0 0 nan'; it must be 3 finite numbers"),
        ('<axis xyz="0 0 0"/>', "continuous", "axis is (0, 0, 0); it must have a direction"),
        ('<limit lower="1" upper="-1"/>', "revolute", "limits are [1, -1]; the lower one must be below the upper"),
        ("", "prismatic", "type is 'prismatic'; choices: fixed, revolute, continuous"),
        ("", "revolute", "limits are [0, 0]; the lower one must be below the upper"),
        ('<limit lower="low" upper="1"/>', "revolute", "limit lower is 'low'; it must be a finite number"),
    ],
)
def test_an_invalid_joint_is_refused(tmp_path: Path, more: str, kind: str, message: str):
    with pytest.raises(SurefootError) as caught:
        read_elbow(tmp_path, more, kind)
    assert str(caught.value) == f"{tmp_path / 'toy.urdf'}: joint 'elbow': {message}"


VISUAL = "<visual><geometry>{}</geometry></visual>"


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ((link("base"), link("base")), "there are two links 'base'; each must have a name of its own"),
        (
            (link("a"), link("b"), joint("j", "a", "b"), joint("j", "a", "b")),
            "there are two joints 'j'; each must have a name of its own",
        ),
        ((link("a"), joint("j", "trunk", "a")), "joint 'j' joins 'trunk', not a link; choices: a"),
        ((link("a"), link("b")), "2 links have no parent (a, b); exactly one must be the root"),
        (
            (link("a"), link("b"), joint("j", "a", "b"), joint("k", "a", "b")),
            "link 'b' has two parents; joints must be a tree",
        ),
        (
            (link("a"), link("b"), link("c"), joint("j", "b", "c"), joint("k", "c", "b")),
            "links are joined in a circle (b, c); joints must be a tree",
        ),
        (
            (link("a", VISUAL.format('<box size="1 1"/>')),),
            "link 'a': visual: box: size is '1 1'; it must be 3 finite numbers",
        ),
        (
            (link("a", VISUAL.format('<sphere radius="0"/>')),),
            "link 'a': visual: sphere has a side, radius or length of 0; they must be over 0 m",
        ),
        (('<material name="red"><color rgba="1"/></material>',), "material 'red': rgba is '1'; it must be 4 finite"),
    ],
)
def test_an_invalid_file_is_refused(tmp_path: Path, elements: tuple[str, ...], message: str):
    with pytest.raises(SurefootError) as caught:
        read(tmp_path, *elements)
    assert str(caught.value).startswith(f"{tmp_path / 'toy.urdf'}: {message}")
