"""One robot as a Gymnasium environment, its ids, and Stable-Baselines3 on both forms."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scripted import ScriptedWorld

import surefoot.envs
from surefoot.errors import SurefootError
from surefoot.task.config import FeedbackConfig, TaskConfig, preset_names
from surefoot.task.env import LocomotionEnv, LocomotionSingleEnv
from surefoot.world.sim_world import SimWorld

FEEDBACK = FeedbackConfig(swing=(-0.5, 0.5), extension=(1.0, 2.0))


@pytest.fixture
def single():
    def make(**values) -> LocomotionSingleEnv:
        return LocomotionSingleEnv(TaskConfig(**{"feedback": FEEDBACK, **values}), ScriptedWorld, seed=0)

    return make


def test_an_episode_ends_after_its_steps_and_starts_anew_with_a_reset(single):
    env = single(max_steps=3)
    env.reset()
    env.batch.world.speed[:] = 1.0
    for _ in range(2):
        *_, truncated, info = env.step(np.zeros(8))
        assert not truncated
    *_, terminated, truncated, info = env.step(np.zeros(8))
    assert (terminated, truncated) == (False, True)
    assert info["figures"] == pytest.approx({"return": 0.018, "steps": 3, "distance": 0.018, "duration": 0.018})
    env.reset()
    assert env.batch.steps.tolist() == [0]


def test_a_single_robot_moves_as_robot_0_of_a_batch():
    task = TaskConfig(feedback=FEEDBACK, params={"imu_noise": 0.02})
    one = LocomotionSingleEnv(task, SimWorld, seed=0)
    many = LocomotionEnv(task, 3, SimWorld, 0, autoreset=False, threads=1)
    observation, _ = one.reset(seed=5)
    assert np.array_equal(observation, many.reset(seed=5)[0][0])
    action = np.linspace(-1, 1, 8)
    for _ in range(30):
        first, second = one.step(action), many.step(np.tile(action, (3, 1)))
        assert np.array_equal(first[0], second[0][0])
        assert first[1] == second[1][0]


def test_without_a_seed_robots_differ():
    task = TaskConfig(feedback=FEEDBACK)
    first, second = (LocomotionSingleEnv(task, SimWorld).reset()[0] for _ in range(2))
    assert not np.array_equal(first, second)


# --- ids --------------------------------------------------------------------------------------------------


def test_every_preset_has_an_id():
    assert {"surefoot/Gallop-v0", "surefoot/Trot-v0", "surefoot/TrotRobust-v0"} <= set(surefoot.envs.IDS)
    assert len(surefoot.envs.IDS) == len(preset_names())


@pytest.mark.parametrize("name", ["surefoot/Gallop-v0", "surefoot/Trot-v0"])
# Raw SI readings have no bounds; nothing else may be amiss.
@pytest.mark.filterwarnings("error::UserWarning", "ignore:.*infinity:UserWarning")
def test_gymnasiums_checker_passes(name):
    check_env(gymnasium.make(name).unwrapped)


def test_an_id_can_bring_its_module_and_adds_no_time_limit_and_its_spec_survives_json():
    env = gymnasium.make("surefoot.envs:surefoot/Trot-v0")
    assert env.spec.max_episode_steps is None
    assert env.unwrapped.batch.task.max_steps == 1000
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again.unwrapped, LocomotionSingleEnv)
    assert again.observation_space.shape == (4,)


def test_an_id_takes_another_task():
    env = gymnasium.make("surefoot/Gallop-v0", task=TaskConfig(feedback=FEEDBACK, observations=("roll",)))
    assert env.observation_space.shape == (1,)
    with pytest.raises(SurefootError, match="task 'waltz' does not exist"):
        gymnasium.make("surefoot/Gallop-v0", task="waltz")


def test_gymnasiums_statistics_wrap_one_robot_and_a_batch():
    task = TaskConfig(feedback=FEEDBACK, max_steps=3)
    one = gymnasium.make("surefoot/Gallop-v0", task=task)
    batch = gymnasium.make_vec("surefoot/Gallop-v0", num_envs=2, task=task, threads=1)
    for env, shape in (
        (gymnasium.wrappers.RecordEpisodeStatistics(one), (8,)),
        (gymnasium.wrappers.vector.RecordEpisodeStatistics(batch), (2, 8)),
    ):
        env.reset(seed=0)
        for _ in range(3):
            *_, info = env.step(np.zeros(shape, np.float32))
        assert np.all(info["episode"]["l"] == 3)
        assert info["episode"]["r"] == pytest.approx(info["figures"]["return"], abs=1e-5)
