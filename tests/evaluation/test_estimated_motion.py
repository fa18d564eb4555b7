"""Estimated motion of recorded runs, against the truth of the simulation that recorded them."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from surefoot.api.policies import find_policy, load_gait
from surefoot.evaluation.conditions import Condition
from surefoot.evaluation.estimated_motion import (
    estimate_intervals,
    estimate_motion,
    interval_text,
    is_estimated,
    path_length,
    torque_delay,
    with_estimated_motion,
)
from surefoot.evaluation.rollout import run_episodes
from surefoot.evaluation.runs import measure_runs
from surefoot.robot.randomization import load_ranges
from surefoot.rotations import from_base_frame, in_heading_frame, rpy_matrix
from surefoot.task.trace import EpisodeTrace
from surefoot.world.registry import find_world

benchmark = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "velocity_estimation.py")))
BLIND = ("base_position_world", "base_quat_world", "foot_contact", "foot_position_world", "true_motor_angle")


def blind(trace: EpisodeTrace) -> EpisodeTrace:
    """Return a run as a robot without motion capture records it."""
    return replace(trace, **{name: np.full_like(getattr(trace, name), np.nan) for name in BLIND})


@pytest.fixture(scope="module")
def walks() -> list[EpisodeTrace]:
    """Return three runs of Go2s from table I at 0.6 m/s, with noise and delays."""
    return walk(3)


def walk(episodes: int, **ranges: tuple[float, float]) -> list[EpisodeTrace]:
    """Return runs of Go2s from table I, with other ranges of some parameters, at 0.6 m/s."""
    policy, robot, task, _ = load_gait(find_policy("go2-steer"), None)
    randomize = {**load_ranges("table1", robot=robot.folder), **ranges}
    condition = Condition(randomize=randomize, command_rows=((0.6, 0.0, 0.2),), duration=4.0)
    return run_episodes(policy, condition.apply(task, robot), episodes, find_world("mujoco"), seed=5, threads=1)


def test_walking_robots_are_estimated_within_a_few_percent(walks):
    robot = walks[0].load_robot()
    errors = benchmark.EstimationErrors.from_runs(walks, estimate_motion(walks, robot))
    assert errors.rmse[:2].max() < 0.05
    assert errors.distance_rmse < 0.02
    assert errors.covered == 1.0
    # The true motion that it is compared with is that of the runs: about what was commanded.
    assert np.mean([benchmark.true_motion(trace)[50:, 0].mean() for trace in walks]) == pytest.approx(0.6, abs=0.1)


def test_the_delay_of_torques_is_found_in_the_run_of_a_robot(walks):
    for trace in walks:
        robot, latency = trace.load_robot(), trace.meta["params"]["control_latency"]
        assert torque_delay(trace, robot) == latency
        unknown = replace(trace, meta={**trace.meta, "params": {}})
        found = torque_delay(unknown, robot)
        assert found == pytest.approx(latency, abs=0.01)
        # Torques of the control step before are older than the other readings.
        older = replace(unknown, motor_torque=np.roll(trace.motor_torque, 1, axis=0))
        assert torque_delay(older, robot) < found


@pytest.mark.parametrize(("latency", "low", "high"), [(0.0, 0.0, 0.01), (0.03, 0.025, 0.04)])
def test_long_and_short_delays_of_torques_are_told_apart(latency: float, low: float, high: float):
    (trace,) = walk(1, control_latency=(latency, latency))
    assert low <= torque_delay(replace(trace, meta={**trace.meta, "params": {}}), trace.load_robot()) <= high


def test_runs_of_a_batch_are_estimated_as_alone(walks):
    robot = walks[0].load_robot()
    together, (alone,) = estimate_motion(walks, robot), estimate_motion(walks[1:2], robot)
    np.testing.assert_allclose(together[1].velocity, alone.velocity, rtol=1e-9, atol=1e-12)
    assert len(together[1].velocity) == walks[1].num_steps


def test_a_run_without_motion_capture_gets_one_that_is_marked(walks):
    robot = walks[0].load_robot()
    estimated = with_estimated_motion(blind(walks[0]), robot)
    assert is_estimated(estimated)
    assert not is_estimated(walks[0])
    assert with_estimated_motion(walks[0], robot) is walks[0]
    start, end = walks[0].base_position_world[[0, -1]]
    path = 0.6 * walks[0].duration
    # It began at the origin, heading along x.
    np.testing.assert_allclose(estimated.base_position_world[-1, :2], (end - start)[:2], atol=0.04 * path)
    np.testing.assert_allclose(
        estimated.base_position_world[5:, 2].mean(), walks[0].base_position_world[5:, 2].mean(), atol=0.03
    )
    speeds = [measure_runs([trace]).speed[0] for trace in (walks[0], estimated)]
    assert speeds[1] == pytest.approx(speeds[0], rel=0.03)


def test_distance_speed_and_return_have_the_intervals_of_the_estimates_error(walks):
    robot, means = walks[0].load_robot(), {"distance_mean": 2.0, "speed_mean": 0.5, "return_mean": None, "gap": np.nan}
    estimated = [with_estimated_motion(blind(trace), robot) for trace in walks[:2]]
    errors = [trace.meta["distance_error"] for trace in estimated]
    # One percent for the robot's lengths, and about as much for the estimator.
    assert all(0.01 < error / (0.6 * trace.duration) < 0.06 for error, trace in zip(errors, walks, strict=False))
    intervals = estimate_intervals(estimated, means)
    width = 1.96 * sum(errors) / 2
    assert intervals["distance_mean"] == pytest.approx([2.0 - width, 2.0 + width])
    slower = 1.96 * sum(error / trace.duration for error, trace in zip(errors, walks, strict=False)) / 2
    assert intervals["speed_mean"] == pytest.approx([0.5 - slower, 0.5 + slower])
    assert set(intervals) == {"distance_mean", "speed_mean"}
    assert interval_text({"speed_mean": [0.4, 0.6]}).endswith("speed 0.40 to 0.60")
    # Measured runs have no error of this kind, and half of the runs half of it.
    measured = estimate_intervals([estimated[0], walks[2]], means)["distance_mean"]
    assert measured == pytest.approx([2.0 - 0.98 * errors[0], 2.0 + 0.98 * errors[0]])


def test_a_robot_that_comes_back_has_a_path(walks):
    # Half a second along each side of a square, again and again.
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    count = round(0.5 / walks[0].meta["control_step"])
    rows = np.arange(walks[0].num_steps + 1) / count
    place = np.column_stack([np.interp(rows, np.arange(16), np.tile(one, 4)) for one in corners.T])
    square = replace(walks[0], base_position_world=np.column_stack([place, np.zeros(len(rows))]))
    assert path_length(square) == pytest.approx(rows[-1])


def test_rows_of_missed_steps_do_not_change_the_distance(walks):
    robot, missed = walks[0].load_robot(), [100, 101, 150]
    names = ("roll_pitch_yaw", "angular_velocity_base", "motor_angle", "motor_velocity", "motor_torque")
    columns = {name: getattr(walks[0], name).copy() for name in names}
    for values in columns.values():
        # Of a missed step and the row before, all have the readings of the last one.
        values[99:101], values[149] = values[101], values[150]
    holed = replace(walks[0], **columns, meta={**walks[0].meta, "missed_steps": missed})
    whole, patched = (estimate_motion([trace], robot)[0].velocity for trace in (walks[0], holed))
    assert patched[:, 0].sum() == pytest.approx(whole[:, 0].sum(), rel=0.01)
    np.testing.assert_array_equal(patched[99], patched[101])


def test_the_level_frame_is_the_heading_frame_of_the_world():
    random = np.random.default_rng(0)
    vector, attitude = random.normal(size=(5, 3)), random.uniform(-1, 1, (5, 3))
    world = np.array([rpy_matrix(*turn) @ one for one, turn in zip(vector, attitude, strict=True)])
    np.testing.assert_allclose(from_base_frame(vector, attitude), in_heading_frame(world, attitude[:, 2]), atol=1e-12)
