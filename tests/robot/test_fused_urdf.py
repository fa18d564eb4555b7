"""Fused links against parallel axes by hand, and against MuJoCo's own fusing."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from surefoot.robot import RobotDescription
from surefoot.robot.rigid_body import RigidBody
from surefoot.robot.urdf_file import format_urdf, read_urdf
from surefoot.rotations import matrix_rpy, rpy_matrix
from surefoot.world.mujoco_model import build_model

# 1 kg at the origin and, .4 m along x, .1 m up and turned a quarter about z, 3 kg whose centre is .2 m along its y:
# that is .2 m back along x. A third link moves against the second.
DUMBBELL = """<robot name="dumbbell">
  <link name="a">
    <inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.15"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision>
  </link>
  <link name="b">
    <inertial><origin xyz="0 0.2 0"/><mass value="3"/>
      <inertia ixx="0.3" ixy="0" ixz="0" iyy="0.4" iyz="0" izz="0.5"/></inertial>
    <visual><geometry><sphere radius="0.2"/></geometry></visual>
    <collision><origin xyz="0 0.1 0"/><geometry><sphere radius="0.3"/></geometry></collision>
  </link>
  <joint name="bolt" type="fixed">
    <parent link="a"/><child link="b"/><origin xyz="0.4 0 0.1" rpy="0 0 1.5707963267948966"/>
  </joint>
  <link name="c">
    <inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="b"/><child link="c"/><origin xyz="0 1 0"/><axis xyz="0 1 0"/>
  </joint>
</robot>
"""


@pytest.fixture
def dumbbell(tmp_path: Path) -> Path:
    path = tmp_path / "dumbbell.urdf"
    path.write_text(DUMBBELL)
    return path


def test_parallel_axes_by_hand(dumbbell: Path):
    fused = read_urdf(dumbbell).fuse_fixed_links()
    assert list(fused.links) == ["a", "c"]
    body = fused.links["a"].body
    assert body.mass == 4.0
    # The second centre is at (.4 - .2, 0, .1); both together at 3/4 of that.
    np.testing.assert_allclose(body.centre, [0.15, 0.0, 0.075], atol=1e-15)
    # m1 m2 / (m1 + m2) = .75 kg at the distance (.2, 0, .1); the second body's xx and yy change places.
    np.testing.assert_allclose(
        body.inertia,
        [
            [0.1 + 0.4 + 0.75 * 0.01, 0, -0.75 * 0.02],
            [0, 0.2 + 0.3 + 0.75 * 0.05, 0],
            [-0.75 * 0.02, 0, 0.15 + 0.5 + 0.75 * 0.04],
        ],
        atol=1e-15,
    )


def test_shapes_and_joints_keep_their_places(dumbbell: Path, tmp_path: Path):
    urdf = read_urdf(dumbbell)
    (tmp_path / "fused.urdf").write_text(format_urdf(urdf.fuse_fixed_links(), "dumbbell", principal=True))
    for fused in (urdf.fuse_fixed_links(), read_urdf(tmp_path / "fused.urdf")):
        assert list(fused.joints) == ["hinge"]
        assert fused.joints["hinge"].parent == "a"
        assert fused.links["a"].visuals == ()
        # The second link's y points backward along the first one's x.
        places = [fused.links["a"].collisions[1].position, fused.joints["hinge"].frame[:3, 3]]
        np.testing.assert_allclose(places, [[0.3, 0, 0.1], [-0.6, 0, 0.1]], atol=1e-15)
        body = urdf.fuse_fixed_links().links["a"].body
        np.testing.assert_allclose(fused.links["a"].body.inertia, body.inertia, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(fused.links["a"].body.centre, body.centre, rtol=1e-12)
    top, frame = urdf.places["b"]
    assert top == "a"
    np.testing.assert_allclose(frame @ [0, 0.2, 0, 1], [0.2, 0, 0.1, 1], atol=1e-15)


def test_minitaurs_fused_bodies_are_mujocos(robot: RobotDescription):
    # MuJoCo reads the same URDF with a reader, a fusing and an eigenvalue solver of its own.
    fused, model = robot.urdf.fuse_fixed_links(), build_model(robot)
    assert len(fused.links) == model.nbody - 1 == 17
    for name, link in fused.links.items():
        body, theirs = link.body, model.body(name)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, theirs.iquat)
        turn = turn.reshape(3, 3)
        assert body.mass == pytest.approx(theirs.mass[0], rel=1e-12)
        np.testing.assert_allclose(body.centre, theirs.ipos, atol=1e-12)
        np.testing.assert_allclose(body.inertia, turn @ np.diag(theirs.inertia) @ turn.T, atol=1e-12)


def test_principal_moments_and_axes_make_the_inertia_again(rng: np.random.Generator):
    for _ in range(50):
        turn = rpy_matrix(*rng.uniform(-3, 3, 3))
        inertia = turn @ np.diag(rng.uniform(1, 2, 3)) @ turn.T
        moments, axes = RigidBody(1.0, np.zeros(3), inertia).principal()
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes @ np.diag(moments) @ axes.T, inertia, atol=1e-12)


def test_a_body_along_its_frame_keeps_its_frame():
    moments, axes = RigidBody(1.0, np.zeros(3), np.diag([3.0, 1.0, 2.0])).principal()
    np.testing.assert_array_equal(moments, [3.0, 1.0, 2.0])
    np.testing.assert_array_equal(axes, np.eye(3))


@pytest.mark.parametrize("pitch", [0.3, -1.2, np.pi / 2, -np.pi / 2])
def test_roll_pitch_yaw_of_a_rotation_make_it_again(pitch: float, rng: np.random.Generator):
    for roll, yaw in rng.uniform(-3, 3, (20, 2)):
        turn = rpy_matrix(roll, pitch, yaw)
        np.testing.assert_allclose(rpy_matrix(*matrix_rpy(turn)), turn, atol=1e-9)


def test_rotation_turns_about_x_then_y_then_z():
    # A quarter turn about x takes y to z, then one about z leaves it there.
    np.testing.assert_allclose(rpy_matrix(np.pi / 2, 0, np.pi / 2) @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(rpy_matrix(0, np.pi / 2, 0) @ [1, 0, 0], [0, 0, -1], atol=1e-15)
