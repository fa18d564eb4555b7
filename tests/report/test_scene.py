"""Scene: poses of links from the URDF agree with MuJoCo's kinematics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("PIL.Image")
pytest.importorskip("numba")

from surefoot.errors import SurefootError
from surefoot.report.drawing.mesh import Mesh, link_meshes
from surefoot.report.drawing.renderer import Camera, View
from surefoot.report.drawing.scene import extent, poses, trace_poses
from surefoot.robot import RobotDescription
from surefoot.robot.appearance import Appearance, VisualPart
from surefoot.task.trace import EpisodeTrace

ROBOT = RobotDescription.load("minitaur")
FOOT = np.array([0.0, 0.0, 0.2315, 1.0])  # centre of the foot's sphere in the frame of its link, see the URDF
LEVEL = [1.0, 0.0, 0.0, 0.0]


def test_feet_agree_with_the_leg_geometry():
    """The centre of a foot is one radius before its end, on the line from the knee."""
    theta = ROBOT.pose_angles([[0.2, -0.3, 0.0, 0.4]], [[1.8, 2.1, 1.5, 1.2]])
    placed = poses(ROBOT, [[0.0, 0.0, 0.0]], [LEVEL], theta)
    bars = ROBOT.five_bar
    for leg, index in zip(ROBOT.legs, ROBOT.leg_motor_index, strict=True):
        angles = theta[0, index]
        end, knee = bars.foot_in_plane(angles), bars.knees(angles)[1]
        centre = knee + (end - knee) * (bars.foot - bars.foot_radius) / bars.foot
        hip = placed[leg.motors[0].replace("motor", "rotor")][0, :3, 3]
        assert np.allclose((placed[leg.foot][0] @ FOOT)[[0, 2]], hip[[0, 2]] + centre, atol=1e-9)


def test_loops_are_closed():
    theta = ROBOT.pose_angles([[0.2, -0.3, 0.0, 0.4]], [[1.8, 2.1, 1.5, 1.2]])
    placed = poses(ROBOT, [[0.1, 0.2, 0.3]], [[0.5, 0.5, 0.5, 0.5]], theta)
    for loop in ROBOT.loops:
        ends = [placed[link][0] @ [*point, 1] for link, point in zip(loop.links, loop.points, strict=True)]
        assert np.allclose(*ends, atol=1e-9)


def test_all_bodies_agree_with_mujoco():
    mujoco = pytest.importorskip("mujoco")
    from surefoot.world.mujoco_model import build_model, resting_qpos

    model = build_model(ROBOT)
    data = mujoco.MjData(model)
    data.qpos[:] = resting_qpos(ROBOT, model)
    quat = np.array([0.9, 0.1, -0.2, 0.3]) / np.linalg.norm([0.9, 0.1, -0.2, 0.3])
    data.qpos[:7] = [0.3, -0.2, 0.5, *quat]
    mujoco.mj_kinematics(model, data)
    placed = poses(ROBOT, data.qpos[None, :3], data.qpos[None, 3:7], ROBOT.resting_angles[None])
    for body in range(1, model.nbody):
        pose = placed[model.body(body).name][0]
        assert np.allclose(pose[:3, 3], data.xpos[body], atol=1e-9)
        assert np.allclose(pose[:3, :3], data.xmat[body].reshape(3, 3), atol=1e-9)


def test_positions_that_are_not_finite_are_rejected():
    with pytest.raises(SurefootError, match="base position is not known"):
        poses(ROBOT, [[np.nan, 0, 0]], [LEVEL], ROBOT.resting_angles[None])


def test_a_loop_that_can_not_close_is_rejected():
    short = replace(ROBOT, leg_geometry=replace(ROBOT.five_bar, lower=(0.09, 0.09)))
    with pytest.raises(SurefootError, match="leg front_left can't close its loop at step 1"):
        poses(short, np.zeros((2, 3)), [LEVEL] * 2, [np.full(8, 2.6), np.full(8, np.pi / 2)])


@pytest.fixture(scope="module")
def trace() -> EpisodeTrace:
    pytest.importorskip("mujoco")
    pytest.importorskip("gymnasium")
    from surefoot.evaluation.rollout import run_episodes
    from surefoot.task.config import load_task
    from surefoot.world.sim_world import SimWorld

    class Still:
        def feedback(self, observation: object) -> np.ndarray:
            return np.zeros((1, 8))

    task, _ = load_task("trot")
    (trace,) = run_episodes(Still(), replace(task, max_steps=150), 1, SimWorld, threads=1)
    return trace


def test_feet_in_a_trace_agree_with_the_simulation(trace: EpisodeTrace):
    placed = trace_poses(ROBOT, trace)
    for k, leg in enumerate(ROBOT.legs):
        apart = (placed[leg.foot] @ FOOT)[:, :3] - trace.foot_position_world[:, k]
        # The engine's positions of geoms are from before its last millisecond.
        assert np.abs(apart).max() < 0.01
        assert np.abs(apart).mean() < 0.002


def test_the_lowest_foot_touches_the_ground(trace: EpisodeTrace):
    placed = trace_poses(ROBOT, trace)
    heights = np.stack([(placed[leg.foot] @ FOOT)[:, 2] for leg in ROBOT.legs], -1) - 0.0085
    lowest = heights.min(axis=1)[30:]
    assert lowest.min() > -0.03
    assert abs(np.median(lowest)) < 0.015
    down = trace.foot_contact[30:] == 1
    assert np.all(heights[30:][down] < 0.002)


def test_poses_of_a_trace_without_true_angles_use_its_readings(trace: EpisodeTrace):
    blind = replace(trace, true_motor_angle=np.empty(0))
    name = ROBOT.legs[0].foot
    expected = poses(ROBOT, trace.base_position_world[1:], trace.base_quat_world[1:], np.array(trace.motor_angle))
    assert np.array_equal(trace_poses(ROBOT, blind)[name], expected[name])


def test_the_viewer_places_every_link_by_its_pose(trace: EpisodeTrace):
    mujoco = pytest.importorskip("mujoco")
    from surefoot.cli.helpers.viewer import build_stage, set_stage

    appearance, placed = ROBOT.appearance(), trace_poses(ROBOT, trace)
    model = build_stage(appearance)
    assert model.ngeom == len(link_meshes(appearance)) + 1
    data = mujoco.MjData(model)
    set_stage(model, data, placed, 99)
    for link in {part.link for part in appearance.parts}:
        body = model.body(link).id
        assert np.allclose(data.xpos[body], placed[link][99, :3, 3])
        assert np.allclose(data.xmat[body].reshape(3, 3), placed[link][99, :3, :3], atol=1e-6)


def test_the_viewer_shows_uneven_ground():
    mujoco = pytest.importorskip("mujoco")
    from surefoot.cli.helpers.viewer import build_stage
    from surefoot.world.terrain import make_terrain

    model = build_stage(ROBOT.appearance(), make_terrain("stairs:0.10"))
    data, found = mujoco.MjData(model), np.zeros(1, np.int32)
    mujoco.mj_forward(model, data)
    for x, height in ((0.9, 0.0), (1.15, 0.1), (1.45, 0.2)):
        distance = mujoco.mj_ray(model, data, np.array([x, 0.0, 5.0]), np.array([0.0, 0.0, -1.0]), None, 1, -1, found)
        assert found[0] == 0
        assert distance == pytest.approx(5.0 - height, abs=1e-6)


@pytest.mark.parametrize("name", RobotDescription.available())
def test_a_robot_of_any_size_fills_the_image(name: str) -> None:
    robot = RobotDescription.load(name)
    camera = Camera.for_robot(extent(robot))
    if name == "minitaur":
        assert camera == Camera()
    placed = poses(robot, [0.0, 0.0, 0.3 * extent(robot)], LEVEL, robot.resting_angles)
    mesh, view = Mesh(robot.appearance(), list(placed)), View(camera, (0.0, 0.0), (960, 540))
    pixels, _ = view.project(mesh.place(np.array([frames[0] for frames in placed.values()]))[0])
    wide, high = np.ptp(pixels, axis=0) / [view.width, view.height]
    assert 0.35 < wide < 0.75
    assert 0.35 < high < 0.95
    assert (pixels > 0).all()
    assert (pixels < [view.width, view.height]).all()


def test_the_viewer_skips_meshes_that_mujoco_rejects():
    pytest.importorskip("mujoco")
    from surefoot.cli.helpers.viewer import build_stage

    square = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], np.float32)
    faces = np.array([(0, 1, 2), (1, 3, 2)], np.int32)
    triangle, line = (
        VisualPart("b", square[:3], faces[:1], (1, 0, 0)),
        VisualPart("c", square * [1, 0, 0], faces, (1, 0, 0)),
    )
    assert build_stage(Appearance((VisualPart("a", square, faces, (1, 0, 0)), triangle, line))).ngeom == 2
