"""Terrain in tasks: starts, curriculum, falls and heights in MuJoCo, and height scans worked by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from exact_resume import assert_resumes_exactly

from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import on_terrain
from surefoot.evaluation.rollout import EpisodeRecorder
from surefoot.evaluation.tracking import distance_along, is_successful
from surefoot.robot import RobotDescription
from surefoot.rotations import in_heading_frame
from surefoot.task.config import load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.height_scan import CRITIC_GRID, HeightScanner, ScanConfig, scan_heights
from surefoot.task.state import base_height
from surefoot.task.terminations import is_low, is_tilted
from surefoot.task.terrain import TerrainConfig
from surefoot.task.terrain_curriculum import TerrainCurriculum
from surefoot.world.ground import FLAT
from surefoot.world.registry import find_world
from surefoot.world.terrain import make_terrain

FIELD = TerrainConfig(sizes={"stairs": (0.02, 0.10), "slope_down": (3.0, 20.0)}, levels=3, columns=2, start_level=0)


@pytest.fixture(scope="module")
def env() -> LocomotionEnv:
    """Four robots on two kinds of terrain."""
    task, _ = load_task("go2-steer")
    task = replace(task, terrain=replace(FIELD, heading=180.0), start_linear_speed=0.0, start_angular_speed=0.0)
    return LocomotionEnv(task, 4, find_world("mujoco"), 0, threads=1)


def test_robots_start_at_the_centres_of_their_tiles(env):
    env.reset(seed=0)
    starts = env.component(TerrainCurriculum).tiles.starts
    # The base is some centimetres away from the centre of the feet, and rotates with the robot.
    yaw = env.state.truth.roll_pitch_yaw[:, 2]
    away = np.column_stack([env.state.truth.base_position_world[:, :2] - starts[0, [0, 1, 0, 1]], np.zeros(4)])
    rest = in_heading_frame(away, yaw)
    np.testing.assert_allclose(rest, np.tile(rest[0], (4, 1)), atol=1e-9)
    assert len(np.unique(yaw)) == 4
    over = env.state.truth.base_position_world[:, 2] - env.state.ground.height(
        env.state.truth.base_position_world[:, :2]
    )
    np.testing.assert_allclose(over, over[0], atol=1e-9)
    feet = env.world.foot_positions()
    radius = 0.022
    np.testing.assert_allclose(feet[..., 2] - env.state.ground.height(feet[..., :2]), radius, atol=0.006)


def test_levels_follow_the_covered_distance():
    curriculum = TerrainCurriculum(FIELD, FIELD.build(0), 4, 0)
    rows, none = np.arange(4), np.zeros(4, bool)
    curriculum.begin(rows, none)
    assert curriculum.level.tolist() == [0, 0, 0, 0]
    command = np.tile([0.6, 0.8], (4, 1))

    def go(shares, turn=0.0, steps=6, fell=none):
        for k in range(steps):
            gone = command * np.array(shares)[:, None]
            curriculum.record(command, gone, np.full(4, turn * k), np.full(4, 0.5))
        ways = curriculum.commanded.copy(), curriculum.led.copy()
        curriculum.begin(rows, fell)
        return ways

    commanded, led = go([1.0, 0.69, 0.71, 1.26])
    np.testing.assert_allclose(commanded, 3.0)
    np.testing.assert_allclose(led, 3 * command)
    assert curriculum.level.tolist() == [1, 0, 1, 0]
    go([0.51, 0.49, 1.0, 1.0], fell=np.array([False, False, True, False]))
    assert curriculum.level.tolist() == [1, 0, 0, 1]
    # An episode with a short commanded path, or a path in a circle, does not change the level.
    go([1.0] * 4, steps=4)
    commanded, led = go([1.0] * 4, turn=np.pi / 3)
    np.testing.assert_allclose(commanded, 3.0)
    np.testing.assert_allclose(led, 0.0, atol=1e-12)
    assert curriculum.level.tolist() == [1, 0, 0, 1]
    # A random level follows the last one.
    curriculum.level[:] = 2
    go([1.0] * 4)
    assert set(curriculum.level.tolist()) <= {0, 1, 2}


def test_few_robots_are_spread_over_all_kinds_of_terrain():
    few = TerrainCurriculum(FIELD, FIELD.build(0), 1, 0)
    assert set(few.levels()) == {"stairs"}
    config = replace(FIELD, columns=12)
    tiles = config.build(0)
    some = TerrainCurriculum(config, tiles, 4, 0)
    assert len({tiles.kinds[column] for column in some.column}) == 2
    assert some.column.tolist() == [0, 3, 6, 9]


def test_the_curriculum_and_the_success_rate_use_the_same_distances(env):
    env.reset(seed=5)
    recorder = EpisodeRecorder(env, pushed=False)
    rng = np.random.default_rng(1)
    for _ in range(60):
        start, seen = env.state.readings.time, env._observation()
        env.step(0.1 * rng.uniform(-1, 1, (4, env.single_action_space.shape[0])))
        recorder.record(start, seen)
    for i in range(4):
        trace = recorder.trace(i, 60, {"world": "mujoco", "policy": "", "seed": 5, "episode": i, "ended": "time"})
        covered = env.component(TerrainCurriculum).covered[i]
        assert distance_along(trace) == pytest.approx(covered, abs=1e-9)
        share = (
            covered / env.component(TerrainCurriculum).commanded[i]
            if env.component(TerrainCurriculum).commanded[i]
            else 0.0
        )
        assert is_successful(trace) == bool(0.7 <= share <= 1.25 or not env.component(TerrainCurriculum).commanded[i])
    assert np.abs(env.component(TerrainCurriculum).covered).max() > 0.01


def test_an_environment_on_terrain_resumes_exactly(env):
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (12, 4, env.single_action_space.shape[0]))
    for action in actions[:6]:
        env.step(action)
    assert_resumes_exactly(env, actions[6:])
    assert len(env.privileged_columns) == env.privileged().shape[1] == len(set(env.privileged_columns))


def test_tilt_and_height_are_relative_to_the_smoothed_ground():
    task, _ = load_task("go2-steer")
    env = LocomotionEnv(on_terrain(task, "slope:25"), 1, find_world("mujoco"), 0, threads=1)
    angles = np.array([[0.0, -np.radians(25), 0.0]])
    truth = replace(
        env.state.truth,
        roll_pitch_yaw=angles,
        base_position_world=np.array([[3.0, 0.0, 2 * np.tan(np.radians(25)) + 0.3]]),
    )
    on_slope = SimpleNamespace(truth=truth, ground=env.state.ground)
    on_floor = SimpleNamespace(truth=truth, ground=FLAT)
    assert not is_tilted(on_slope, 0.3)[0]
    assert not is_low(on_slope, 0.2)[0]
    assert is_tilted(on_floor, 0.3)[0]
    assert base_height(truth.base_position_world, env.state.ground)[0] == pytest.approx(0.3, abs=1e-6)


def test_a_scan_has_the_heights_around_a_rotated_robot():
    robot, ground = RobotDescription.load("go2"), make_terrain("stairs:0.10")
    points, length = CRITIC_GRID.points(robot), robot.leg_geometry.length
    assert points.shape == (91, 2)
    position, yaw = np.array([[1.0, 0.0, 0.3]] * 2), np.array([0.0, np.pi])
    heights = dict(zip(CRITIC_GRID.columns(), scan_heights(ground, points, position, yaw).T, strict=True))
    # One leg length of 0.426 m ahead is on the second tread, and behind on the level area.
    assert length == pytest.approx(0.426)
    assert heights["ground4.middle"].round(6).tolist() == [-0.1, -0.3]
    assert heights["ground-4.left2"].round(6).tolist() == [-0.3, -0.1]


def test_a_height_map_has_delay_and_errors():
    robot, ground = RobotDescription.load("go2"), make_terrain("slope:20")
    exact = HeightScanner(ScanConfig(0.0, 0.0, 0.0, 0.0, 2), robot, 2, 0)
    rough = HeightScanner(ScanConfig(0.02, 0.0, 0.0, 0.1, 0), robot, 2, 0)
    yaw, places = np.zeros(2), [np.array([[1.0 + 0.1 * k, 0.0, 0.3]] * 2) for k in range(4)]
    for scanner in (exact, rough):
        scanner.reset(np.arange(2), ground, places[0], yaw)
    for place in places[1:]:
        for scanner in (exact, rough):
            scanner.update(ground, place, yaw)
    np.testing.assert_allclose(exact.heights, scan_heights(ground, exact.points, places[1], yaw))
    error = rough.heights - scan_heights(ground, rough.points, places[3], yaw)
    assert 0.005 < np.median(np.abs(error)) < 0.03
    assert (rough.heights[0] != rough.heights[1]).any()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sizes": {"stair": (0.1, 0.2)}}, "terrain 'stair' does not exist"),
        ({"sizes": {"stairs": (0.1, 2.0)}}, "size is 2 m"),
        ({"sizes": {"stairs": (0.1, 0.2)}, "shares": {"slope": 1.0}}, "terrain.shares.slope is not a kind"),
        (
            {"sizes": {"stairs": (0.1, 0.2)}, "columns": 60},
            "terrain.columns is 60; it must be 1 .the number of kinds. to 40 ",
        ),
        ({"sizes": {"stairs": (0.1, 0.2)}, "levels": 2}, "terrain.start_level is 2"),
        ({"sizes": {"stairs": (0.1, 0.2)}, "tile": 8.05}, "terrain.tile is 8.05; it must be a multiple of 0.2 m"),
        (
            {"sizes": {"stairs": (0.1, 0.2)}, "shares": {"stairs": 0.0}},
            "terrain.shares are all 0; at least one must be above 0",
        ),
    ],
)
def test_an_invalid_field_is_rejected(values, message):
    with pytest.raises(SurefootError, match=message):
        TerrainConfig(**values)


def test_kinds_with_share_0_are_excluded():
    sizes = {"stairs": (0.1, 0.2), "slope": (5.0, 10.0), "gaps": (0.1, 0.2), "rough": (0.02, 0.05)}
    config = TerrainConfig(sizes=sizes, shares={"stairs": 0.0, "gaps": 2.0, "rough": 0.0}, columns=3)
    assert config.build(0).kinds == ("slope", "gaps", "gaps")


def test_friction_is_random_for_patches_up_to_the_border():
    config = replace(FIELD, friction=(0.4, 1.2), friction_patch=0.5)
    ground, plain = config.build(3).ground, FIELD.build(3).ground
    # Three by two tiles of 8 m.
    assert ground.friction.shape == (48, 32)
    assert ground.patch_grid.tolist() == [-4.0, -4.0, 0.5]
    assert 0.4 <= ground.friction.min() < 0.45
    assert 1.15 < ground.friction.max() <= 1.2
    np.testing.assert_array_equal(ground.corners, plain.corners)
    assert plain.friction.size == 0
    np.testing.assert_array_equal(ground.friction, config.build(3).ground.friction)
    assert (ground.friction != config.build(4).ground.friction).any()
    level = TerrainConfig(friction=(0.4, 1.2)).build(0).ground
    assert level.is_flat
    assert level.friction.shape == (40, 40)
    with pytest.raises(SurefootError, match="the smaller factor must come first"):
        TerrainConfig(friction=(1.2, 0.4))


def test_the_curriculum_sees_a_fall_without_autoreset(monkeypatch: pytest.MonkeyPatch):
    task, _ = load_task("go2-steer")
    env = LocomotionEnv(replace(task, terrain=FIELD), 4, find_world("mujoco"), 0, autoreset=False, threads=1)
    env.reset()
    begin, fallen = TerrainCurriculum.begin, []
    monkeypatch.setattr(
        TerrainCurriculum, "begin", lambda self, rows, fell: fallen.append(fell.tolist()) or begin(self, rows, fell)
    )
    # As after the last step of four episodes, two of which ended in a fall.
    env.state.terminated, env.state.over[:] = np.array([True, False, False, True]), True
    env.reset()
    assert fallen == [[True, False, False, True]]
    assert not env.state.terminated.any()
