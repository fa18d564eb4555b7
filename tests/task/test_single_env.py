"""Single-robot Gymnasium environment, and environment ids."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scripted_world import ScriptedWorld

import surefoot.envs
from surefoot.errors import SurefootError
from surefoot.task.config import FeedbackConfig, TaskConfig, preset_names
from surefoot.task.env import LocomotionEnv
from surefoot.task.single_env import LocomotionSingleEnv
from surefoot.world.sim_world import SimWorld

FEEDBACK = FeedbackConfig(swing=(-0.5, 0.5), extension=(1.0, 2.0))


@pytest.fixture
def single():
    def make(**values) -> LocomotionSingleEnv:
        return LocomotionSingleEnv(TaskConfig(**{"feedback": FEEDBACK, **values}), ScriptedWorld, seed=0)

    return make


def test_an_episode_ends_after_its_steps_until_a_reset(single):
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
    assert env.batch.state.steps.tolist() == [0]


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
# Readings in SI units have no bounds, which the checker may warn about.
@pytest.mark.filterwarnings("error::UserWarning", "ignore:.*infinity:UserWarning")
def test_gymnasiums_checker_passes(name):
    check_env(gymnasium.make(name).unwrapped)


def test_gymnasiums_checker_passes_with_images():
    env = gymnasium.make("surefoot/Trot-v0", robot="go2", render_mode="rgb_array").unwrapped
    check_env(env)
    env.reset(seed=0)
    first = env.render()
    assert (first.shape, first.dtype) == ((480, 640, 3), np.uint8)
    for _ in range(30):
        env.step(np.zeros(env.action_space.shape, np.float32))
    assert np.abs(first.astype(int) - env.render()).mean() > 1
    with pytest.raises(SurefootError, match="render_mode is 'human'; it must be 'rgb_array'"):
        surefoot.envs.make_single("trot", render_mode="human")


def test_a_batch_renders_an_image_of_each_robot():
    envs = gymnasium.make_vec("surefoot/Trot-v0", num_envs=2, threads=1, render_mode="rgb_array")
    envs.reset(seed=0)
    pictures = envs.render()
    assert [picture.shape for picture in pictures] == [(480, 640, 3)] * 2
    assert gymnasium.make_vec("surefoot/Trot-v0", num_envs=2, threads=1).unwrapped.render() is None


def test_info_describes_every_step():
    env = gymnasium.make("surefoot/Steer-v0", robot="go2", seed=2).unwrapped
    env.reset(seed=2)
    for _ in range(3):
        *_, reward, terminated, _, info = env.step(np.zeros(env.action_space.shape, np.float32))
    weights = env.batch.task.reward
    assert sum(info["reward_terms"].values()) == pytest.approx(reward)
    assert set(info["reward_terms"]) == set(weights)
    assert info["time"] == pytest.approx(3 * float(env.batch.nominal.control_step[0]))
    assert (info["fell"], terminated) == (False, False)
    assert info["torque"].shape == (12,)
    assert np.array_equal(info["tracking_error"], info["velocity"] - info["command"])


def test_info_of_a_batch_is_that_of_each_robot():
    def step(envs, num_envs):
        envs.reset(seed=1)
        return envs.step(np.zeros((num_envs, 8), np.float32))[-1]

    batch = step(gymnasium.make_vec("surefoot/Steer-v0", num_envs=2, threads=1), 2)
    rows = step(gymnasium.wrappers.vector.DictInfoToList(gymnasium.make_vec("surefoot/Steer-v0", num_envs=2)), 2)
    for row, info in enumerate(rows):
        assert info["time"] == batch["time"][row]
        assert np.array_equal(info["command"], batch["command"][row])
        assert info["reward_terms"]["torque"] == batch["reward_terms"]["torque"][row]


def test_info_distinguishes_a_fall_from_other_ends():
    env = LocomotionSingleEnv(TaskConfig(feedback=FEEDBACK, fall_height=0.5), SimWorld, seed=0)
    env.reset()
    *_, terminated, _, info = env.step(np.zeros(8))
    assert (terminated, info["fell"]) == (True, True)


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


def test_robots_of_the_ensemble_are_not_randomized():
    with pytest.raises(SurefootError, match="world 'ensemble' has robots of its own, whose parameters can't be"):
        surefoot.envs.make_vector("trot-robust", 2, world="ensemble")
    with pytest.raises(SurefootError, match="world 'ensemble' has robots of its own"):
        surefoot.envs.make_single("trot-robust", world="ensemble")
