"""URDFs: links, shapes, joints, frames, fused links compared with hand calculation and MuJoCo, and invalid files."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.rigid_body import RigidBody
from surefoot.robot.urdf import GREY, Urdf
from surefoot.robot.urdf_file import format_urdf, read_urdf
from surefoot.rotations import matrix_rpy, rpy_matrix
from surefoot.world.mujoco_model import build_model

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
    """Read a URDF with an arm on a base; the argument has elements of the joint."""
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
    assert robot.urdf.links_below("front_left_1_motor") == expected


@pytest.mark.parametrize(
    ("origin", "place"),
    [
        ('<origin xyz="0.1 -2 3e-1" rpy="0 0 0"/>', (0.1, -2.0, 0.3)),
        ('<origin rpy="1 0 0"/>', (0.0, 0.0, 0.0)),
        ("", (0.0, 0.0, 0.0)),
    ],
)
def test_joint_frames_are_in_the_parents_frame(tmp_path: Path, origin: str, place: tuple[float, float, float]):
    elbow = read_elbow(tmp_path, origin).joints["elbow"]
    assert tuple(elbow.frame[:3, 3]) == place
    assert (elbow.parent, elbow.child, elbow.axis) == ("base", "arm", (1.0, 0.0, 0.0))


def test_a_revolute_joint_has_limits_and_a_continuous_one_none(tmp_path: Path):
    limits = '<limit lower="-0.5" upper="1.25" effort="3" velocity="4"/>'
    assert read_elbow(tmp_path, limits, "revolute").joints["elbow"].limits == (-0.5, 1.25)
    assert read_elbow(tmp_path, limits).joints["elbow"].limits is None


# A quarter turn about z: the child's x axis is the parent's y axis. The arm's hand is 0.2 along the arm's x.
def test_link_frames_follow_joint_frames_and_angles(tmp_path: Path):
    turn = f'rpy="0 0 {np.pi / 2}"/><axis xyz="0 0 2"/>'
    # The hand is first in the file, because the order does not matter.
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
    # Another quarter turn of the elbow: the hand is 0.2 along the base's -x.
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
    urdf = read(tmp_path, '<material name="red"><color rgba="1e308 -1 0 1"/></material>', link("base", shapes))
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
def test_invalid_joints_are_rejected(tmp_path: Path, more: str, kind: str, message: str):
    with pytest.raises(SurefootError) as caught:
        read_elbow(tmp_path, more, kind)
    assert str(caught.value) == f"{tmp_path / 'toy.urdf'}: joint 'elbow': {message}"


VISUAL = "<visual><geometry>{}</geometry></visual>"


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ((link("base"), link("base")), "there are two links 'base'; names must be unique"),
        (
            (link("a"), link("b"), joint("j", "a", "b"), joint("j", "a", "b")),
            "there are two joints 'j'; names must be unique",
        ),
        ((link("a"), joint("j", "trunk", "a")), "joint 'j' refers to 'trunk', which is not a link; choices: a"),
        ((link("a"), link("b")), "2 links have no parent (a, b); exactly one must be the root"),
        (
            (link("a"), link("b"), joint("j", "a", "b"), joint("k", "a", "b")),
            "link 'b' has two parents; joints must form a tree",
        ),
        (
            (link("a"), link("b"), link("c"), joint("j", "b", "c"), joint("k", "c", "b")),
            "joints form a loop (b, c); they must form a tree",
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
def test_invalid_urdf_files_are_rejected(tmp_path: Path, elements: tuple[str, ...], message: str):
    with pytest.raises(SurefootError) as caught:
        read(tmp_path, *elements)
    assert str(caught.value).startswith(f"{tmp_path / 'toy.urdf'}: {message}")


# 1 kg at the origin and, 0.4 m along x, 0.1 m up and turned a quarter about z, 3 kg whose centre is 0.2 m along its y:
# that is 0.2 m back along x. A third link moves relative to the second.
def read_dumbbell(folder: Path) -> Urdf:
    body = '<inertial><origin xyz="0 {} 0"/><mass value="{}"/><inertia ixx="{}" iyy="{}" izz="{}"/></inertial>'
    ball = '<origin xyz="0 {} 0"/><geometry><sphere radius="0.1"/></geometry>'
    return read(
        folder,
        f'<link name="a">{body.format(0, 1, 0.1, 0.2, 0.15)}<collision>{ball.format(0)}</collision></link>',
        f'<link name="b">{body.format(0.2, 3, 0.3, 0.4, 0.5)}<visual>{ball.format(0)}</visual>'
        f"<collision>{ball.format(0.1)}</collision></link>",
        joint("bolt", "a", "b", f'<origin xyz="0.4 0 0.1" rpy="0 0 {np.pi / 2}"/>', "fixed"),
        link("c"),
        joint("hinge", "b", "c", '<origin xyz="0 1 0"/><axis xyz="0 1 0"/>'),
    )


def test_parallel_axes_by_hand(tmp_path: Path):
    fused = read_dumbbell(tmp_path).fuse_fixed_links()
    assert list(fused.links) == ["a", "c"]
    body = fused.links["a"].body
    assert body.mass == 4.0
    # The second centre is at (0.4 - 0.2, 0, 0.1); both together at 3/4 of that.
    np.testing.assert_allclose(body.centre, [0.15, 0.0, 0.075], atol=1e-15)
    # m1 m2 / (m1 + m2) = 0.75 kg at the distance (0.2, 0, 0.1); the second body's xx and yy change places.
    np.testing.assert_allclose(
        body.inertia,
        [
            [0.1 + 0.4 + 0.75 * 0.01, 0, -0.75 * 0.02],
            [0, 0.2 + 0.3 + 0.75 * 0.05, 0],
            [-0.75 * 0.02, 0, 0.15 + 0.5 + 0.75 * 0.04],
        ],
        atol=1e-15,
    )


def test_fusing_preserves_shape_and_joint_positions(tmp_path: Path):
    urdf = read_dumbbell(tmp_path)
    (tmp_path / "fused.urdf").write_text(format_urdf(urdf.fuse_fixed_links(), "dumbbell", principal=True))
    for fused in (urdf.fuse_fixed_links(), read_urdf(tmp_path / "fused.urdf")):
        assert list(fused.joints) == ["hinge"]
        assert fused.joints["hinge"].parent == "a"
        assert fused.links["a"].visuals == ()
        # The second link's y axis points backward along the first link's x axis.
        places = [fused.links["a"].collisions[1].position, fused.joints["hinge"].frame[:3, 3]]
        np.testing.assert_allclose(places, [[0.3, 0, 0.1], [-0.6, 0, 0.1]], atol=1e-15)
        body = urdf.fuse_fixed_links().links["a"].body
        np.testing.assert_allclose(fused.links["a"].body.inertia, body.inertia, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(fused.links["a"].body.centre, body.centre, rtol=1e-12)
    top, frame = urdf.fused_frames["b"]
    assert top == "a"
    np.testing.assert_allclose(frame @ [0, 0.2, 0, 1], [0.2, 0, 0.1, 1], atol=1e-15)


def test_fused_bodies_of_the_minitaur_match_mujoco(robot: RobotDescription):
    # MuJoCo has its own URDF reader, fusion of links and eigenvalue solver.
    fused, model = robot.urdf.fuse_fixed_links(), build_model(robot)
    assert len(fused.links) == model.nbody - 1 == 17
    for name, link in fused.links.items():
        body, mujoco_body = link.body, model.body(name)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, mujoco_body.iquat)
        turn = turn.reshape(3, 3)
        assert body.mass == pytest.approx(mujoco_body.mass[0], rel=1e-12)
        np.testing.assert_allclose(body.centre, mujoco_body.ipos, atol=1e-12)
        np.testing.assert_allclose(body.inertia, turn @ np.diag(mujoco_body.inertia) @ turn.T, atol=1e-12)


def test_principal_moments_and_axes_reproduce_the_inertia(rng: np.random.Generator):
    for _ in range(50):
        turn = rpy_matrix(*rng.uniform(-3, 3, 3))
        inertia = turn @ np.diag(rng.uniform(1, 2, 3)) @ turn.T
        moments, axes = RigidBody(1.0, np.zeros(3), inertia).principal()
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes @ np.diag(moments) @ axes.T, inertia, atol=1e-12)


def test_a_diagonal_inertia_keeps_the_links_frame():
    moments, axes = RigidBody(1.0, np.zeros(3), np.diag([3.0, 1.0, 2.0])).principal()
    np.testing.assert_array_equal(moments, [3.0, 1.0, 2.0])
    np.testing.assert_array_equal(axes, np.eye(3))


@pytest.mark.parametrize("pitch", [0.3, -1.2, np.pi / 2, -np.pi / 2])
def test_roll_pitch_yaw_round_trip(pitch: float, rng: np.random.Generator):
    for roll, yaw in rng.uniform(-3, 3, (20, 2)):
        turn = rpy_matrix(roll, pitch, yaw)
        np.testing.assert_allclose(rpy_matrix(*matrix_rpy(turn)), turn, atol=1e-9)


def test_rotation_turns_about_x_then_y_then_z():
    # A quarter turn about x maps y to z, and a turn about z does not change it.
    np.testing.assert_allclose(rpy_matrix(np.pi / 2, 0, np.pi / 2) @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(rpy_matrix(0, np.pi / 2, 0) @ [1, 0, 0], [0, 0, -1], atol=1e-15)
