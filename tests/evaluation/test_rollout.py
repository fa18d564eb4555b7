"""Rollouts: each episode is recorded to its own end, and traces equal the simulation."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from references import read_reference

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")

from surefoot.evaluation.rollout import run_episodes, run_to_end
from surefoot.evaluation.runs import measure_runs
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.gait import HybridGait
from surefoot.task.trace import EpisodeTrace
from surefoot.world.sim_world import SimWorld

ROBOT = RobotDescription.load("minitaur")


class Constant:
    """Controller with constant feedback that records its observations."""

    def __init__(self, swing: float = 0.0, extension: float = 0.0) -> None:
        self.row = np.repeat([swing, extension], 4)
        self.seen: list[NDArray[np.float64]] = []

    def feedback(self, observation: ArrayLike) -> NDArray[np.float64]:
        self.seen.append(np.array(observation, float))
        return np.tile(self.row, (len(self.seen[-1]), 1))


def trot(max_steps: int = 60, **changes: object) -> TaskConfig:
    task, _ = load_task("trot")
    return replace(task, max_steps=max_steps, pushes=replace(task.pushes, enabled=False), **changes)


def test_a_trace_equals_the_environments_steps():
    policy, task = Constant(0.05, -0.02), trot(40)
    first, second = run_episodes(policy, task, 2, SimWorld, seed=5, threads=1, policy_name="constant")
    env = LocomotionEnv(task, 2, SimWorld, 5, autoreset=False, threads=1)
    observation, _ = env.reset()
    reward = np.zeros(2)
    assert np.array_equal(second.base_position_world[0], env.state.truth.base_position_world[1])
    for step in range(40):
        assert np.allclose(second.observation[step], observation[1])
        target = env.gait.motor_targets(env.state.readings.time, np.tile(policy.row, (2, 1)))
        assert np.allclose(second.target[step], target[1])
        observation, gained, *_ = env.step(env.gait.action(np.tile(policy.row, (2, 1))))
        reward += gained
        assert second.time[step] == env.state.readings.time[1]
        assert np.array_equal(second.motor_angle[step], env.state.readings.motor_angle[1])
        assert np.array_equal(second.true_motor_angle[step], env.state.truth.motor_angle[1])
        assert np.array_equal(second.base_position_world[step + 1], env.state.truth.base_position_world[1])
        assert np.array_equal(second.foot_contact[step], env.state.truth.foot_contact[1])
    assert np.allclose(second.feedback, policy.row)
    assert measure_runs([first, second])["return"].to_numpy() == pytest.approx(reward, abs=1e-9)
    assert first.meta["policy"] == "constant"
    assert first.meta["ended"] == "time"
    assert first.num_steps == 40
    assert np.isfinite(first.foot_position_world).all()


@pytest.mark.parametrize(
    ("reward", "limits"),
    [
        ({"progress": 1.0, "transport_cost": -0.4}, {"progress": 0.3}),
        ({"progress": 2.0, "tilt": -2.0, "feedback_change": -0.05}, {}),
    ],
)
def test_the_return_is_the_sum_of_the_tasks_own_reward(reward, limits):
    task = trot(40, reward=reward, reward_limits=limits)
    traces = run_episodes(Constant(0.05, -0.02), task, 2, SimWorld, seed=5, threads=1)
    env = LocomotionEnv(task, 2, SimWorld, 5, autoreset=False, threads=1)
    runs = run_to_end(lambda _: env.gait.action(np.tile(Constant(0.05, -0.02).row, (2, 1))), env, env.reset()[0])
    assert runs["return"].std() > 0
    for returns in (measure_runs(traces)["return"], [trace.reward.sum() for trace in traces]):
        np.testing.assert_allclose(returns, runs["return"], atol=1e-12)


def test_the_return_equals_the_traces_return_in_another_engine():
    pytest.importorskip("pybullet")
    make, policy = partial(SimWorld, engine="bullet"), Constant(0.05, -0.02)
    (trace,) = run_episodes(policy, trot(40), 1, make, seed=3)
    env = LocomotionEnv(trot(40), 1, make, 3, autoreset=False)
    env.reset()
    action = env.gait.action(policy.row[None])
    total = sum(float(env.step(action)[1][0]) for _ in range(trace.num_steps))
    assert total == pytest.approx(measure_runs([trace])["return"][0], abs=1e-9)


def test_an_episode_does_not_depend_on_the_batch():
    three = run_episodes(Constant(), trot(30), 3, SimWorld, seed=2, threads=1)
    one = run_episodes(Constant(), trot(30), 1, SimWorld, seed=2, threads=1)
    assert np.array_equal(three[0].base_position_world, one[0].base_position_world)
    assert not np.array_equal(three[0].base_position_world, three[1].base_position_world)


def test_fallen_robots_end_and_the_others_continue():
    # With a low fall angle, the untrained gait falls in some of the episodes.
    task = trot(300, fall_angle=0.12)
    traces = run_episodes(Constant(), task, 6, SimWorld, seed=1, threads=1)
    for trace in traces:
        if trace.fell:
            assert trace.num_steps < 300
        else:
            assert trace.num_steps == 300
    assert any(trace.fell for trace in traces)
    assert len({trace.num_steps for trace in traces}) > 1


def test_pushes_move_the_robot():
    calm = trot(260)
    pushed = replace(calm, pushes=replace(calm.pushes, enabled=True, probability=1.0))
    still, moved = (run_episodes(Constant(), task, 1, SimWorld, threads=1)[0] for task in (calm, pushed))
    steps = min(still.num_steps, moved.num_steps)
    apart = np.linalg.norm(still.base_position_world[:steps] - moved.base_position_world[:steps], axis=1)
    # The first push comes after 1.2 s (200 control steps).
    assert apart[:200].max() == 0
    assert apart.max() > 0.02
    # The trace has the force of each control step: 10 of 6 ms, from the 201st on.
    pushing = np.linalg.norm(moved.push_force_world, axis=1)
    assert np.flatnonzero(pushing).tolist() == list(range(200, min(210, moved.num_steps)))
    assert 130.0 <= pushing.max() <= 220.0
    assert np.isnan(still.push_force_world).all()


def test_history_records_the_newest_observation():
    policy = Constant()
    (trace,) = run_episodes(policy, trot(10, history=3), 1, SimWorld, threads=1)
    assert policy.seen[0].shape == (1, 12)
    assert trace.observation.shape == (10, 4)
    assert np.array_equal(policy.seen[5][0, 4:8], trace.observation[4])


def test_progress_is_reported_every_step():
    shares: list[float] = []
    run_episodes(Constant(), trot(5), 2, SimWorld, threads=1, progress=shares.append)
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_action_is_the_inverse_of_feedback(rng: np.random.Generator):
    gait = HybridGait(ROBOT, read_reference({}, ROBOT), (-0.2, 0.4), (1.5, 1.5))
    unit = rng.uniform(-1, 1, (20, 8))
    unit[:, 4:] = 0
    assert np.allclose(gait.action(gait.feedback(unit)), unit)
    assert np.array_equal(gait.action(np.full((1, 8), 9.0)), [[1.0] * 4 + [0.0] * 4])


def test_true_motor_angles_are_newer_than_readings(tmp_path: Path):
    (trace,) = run_episodes(Constant(), trot(60), 1, SimWorld, threads=1)
    # Readings are 20 ms old: 3 1/3 control steps of 6 ms.
    late = (2 * trace.true_motor_angle[40 - 3] + trace.true_motor_angle[40 - 4]) / 3
    assert np.allclose(trace.motor_angle[40], late, atol=0.01)
    again = EpisodeTrace.load(trace.save(tmp_path / "t.npz"))
    assert np.array_equal(again.true_motor_angle, trace.true_motor_angle)
