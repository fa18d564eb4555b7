"""The environment is the same in every world: spaces, and the reward for the same motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from surefoot.evaluate.rollout import run_episodes
from surefoot.evaluate.runs import Runs
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.world.interface import SimulationFactory, Truth
from surefoot.world.sim_world import SimWorld

pytest.importorskip("pybullet")
from surefoot.world.bullet_engine import BulletEngine

STEPS = 40


def in_bullet(*args: Any) -> SimWorld:
    return SimWorld(*args, engine=BulletEngine)


WORLDS: dict[str, SimulationFactory] = {"mujoco": SimWorld, "bullet": in_bullet}


class Wave:
    """Some feedback that makes the robot move, the same whatever it observes."""

    def __init__(self) -> None:
        self.calls = 0

    def feedback(self, observation: Any) -> np.ndarray:
        self.calls += 1
        return 0.2 * np.sin(0.1 * self.calls + np.arange(8.0)) * np.ones((len(observation), 1))


@pytest.fixture(scope="module", params=["trot", "gallop"])
def task(request: pytest.FixtureRequest) -> TaskConfig:
    task, _ = load_task(request.param)
    return replace(task, max_steps=STEPS)


def test_spaces_are_the_same(task: TaskConfig) -> None:
    here, there = (LocomotionEnv(task, 2, world) for world in WORLDS.values())
    for space in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(here, space) == getattr(there, space)
    assert here.observer.columns == there.observer.columns
    assert here.gait.action_names == there.gait.action_names
    assert here.reset()[0].shape == there.reset()[0].shape


def replaying(world: SimulationFactory, path: np.ndarray, energy: np.ndarray) -> SimulationFactory:
    """The world, in which the base goes a given path (K, 3) [m] and every step takes a given energy (K,) [J]."""

    def make(*args: Any) -> Any:
        made: Any = world(*args)
        truth: Callable[[], Truth] = made.truth
        made.played = 0
        step = made.step

        def count(*args: Any) -> Any:
            made.played += 1
            return step(*args)

        def played() -> Truth:
            now, k = truth(), made.played
            here = np.tile(path[k], (made.num_envs, 1))
            return replace(now, base_position_world=here, energy=np.full(made.num_envs, energy[k]))

        made.step, made.truth = count, played
        return made

    return make


def test_the_same_motion_has_the_same_reward(task: TaskConfig) -> None:
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.normal(0.003, 0.002, (STEPS + 1, 3)), axis=0)
    energy = rng.uniform(0.0, 0.5, STEPS + 1)
    rewards = []
    for world in WORLDS.values():
        env = LocomotionEnv(task, 1, replaying(world, path, energy), seed=0, autoreset=False)
        env.reset()
        rewards.append([float(env.step(np.zeros((1, 8)))[1][0]) for _ in range(STEPS - 1)])
    np.testing.assert_array_equal(rewards[0], rewards[1])
    # By hand: (p_n - p_{n-1}) . x - w E.
    expected = np.diff(path[:STEPS, 0]) - task.energy_weight * energy[1:STEPS]
    np.testing.assert_allclose(rewards[0], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", WORLDS)
def test_the_return_is_that_of_the_trace(task: TaskConfig, name: str) -> None:
    (trace,) = run_episodes(Wave(), task, 1, WORLDS[name], seed=3, world_name=name)
    env = LocomotionEnv(task, 1, WORLDS[name], seed=3, autoreset=False)
    observation, _ = env.reset()
    wave, total = Wave(), 0.0
    for _ in range(trace.num_steps):
        observation, reward, *_ = env.step(env.gait.action(wave.feedback(observation)))
        total += float(reward[0])
    assert total == pytest.approx(Runs.of_traces([trace]).returns[0], abs=1e-9)
