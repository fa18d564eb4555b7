"""Stable-Baselines3 on one robot and on a batch."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import surefoot.envs  # registers the ids
from surefoot.errors import SurefootError
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.world.sim_world import SimWorld

stable_baselines3 = pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from torch.nn.utils import parameters_to_vector  # noqa: E402

from surefoot.learn.sb3 import SB3VecEnv  # noqa: E402

FEEDBACK = FeedbackConfig(swing=(-0.5, 0.5), extension=(1.0, 2.0))


def batch(num_envs: int = 2, autoreset: bool = True, **values) -> LocomotionEnv:
    task = TaskConfig(**{"feedback": FEEDBACK, **values})
    return LocomotionEnv(task, num_envs, SimWorld, seed=0, autoreset=autoreset, threads=1)


def test_the_checker_passes_on_one_robot():
    check_env(gymnasium.make("surefoot/Gallop-v0").unwrapped, warn=True)


def train(env) -> PPO:
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    before = parameters_to_vector(model.policy.parameters()).detach().clone()
    model.learn(2 * 16 * env.num_envs)
    after = parameters_to_vector(model.policy.parameters())
    assert bool(after.isfinite().all())
    assert not before.equal(after)
    assert model.num_timesteps == 2 * 16 * env.num_envs
    return model


def test_ppo_trains_on_single_robots():
    train(make_vec_env(surefoot.envs.IDS[0], n_envs=2, seed=0))


def test_ppo_trains_on_a_batch_and_sees_its_episodes():
    model = train(SB3VecEnv(batch(3, max_steps=10)))
    # Two updates of 16 steps: each of three robots ended 3 episodes of 10 steps.
    assert [episode["l"] for episode in model.ep_info_buffer] == [10] * 9


def test_the_end_of_an_episode_has_the_infos_of_stable_baselines():
    venv, plain = SB3VecEnv(batch(2, max_steps=3)), batch(2, max_steps=3, autoreset=False)
    venv.seed(7)
    first = venv.reset()
    assert np.array_equal(first, plain.reset(seed=7)[0])
    action, total = np.zeros((2, 8), np.float32), 0.0
    for k in range(3):
        observation, reward, done, infos = venv.step(action)
        last, expected, *_ = plain.step(action)
        np.testing.assert_allclose(reward, expected, rtol=1e-6)
        assert reward.dtype == np.float32
        assert done.tolist() == [k == 2] * 2
        total += expected[0]
    assert np.array_equal([info["terminal_observation"] for info in infos], last)
    assert not np.array_equal(observation, last)
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert infos[0]["episode"]["r"] == pytest.approx(total)
    assert infos[0]["episode"]["l"] == 3
    *_, infos = venv.step(action)
    assert infos == [{"TimeLimit.truncated": False}] * 2


def test_a_fall_is_no_truncation():
    venv = SB3VecEnv(batch(2, fall_height=0.5))
    venv.reset()
    *_, done, infos = venv.step(np.ones((2, 8), np.float32))
    assert done.all()
    assert not any(info["TimeLimit.truncated"] for info in infos)
    assert all("terminal_observation" in info for info in infos)


def test_attributes_belong_to_the_batch():
    venv = SB3VecEnv(batch(2))
    assert venv.get_attr("render_mode") == [None, None]
    assert venv.get_attr("num_envs", indices=[1]) == [2]
    assert venv.env_is_wrapped(gymnasium.Wrapper) == [False, False]
    assert len(venv.env_method("privileged", indices=0)) == 1
    venv.set_attr("mark", 3)
    assert venv.env.mark == 3
    with pytest.raises(SurefootError, match="mark belongs to the whole batch"):
        venv.set_attr("mark", 4, indices=[0])


def test_a_batch_without_autoreset_is_refused():
    with pytest.raises(SurefootError, match="autoreset is off"):
        SB3VecEnv(batch(autoreset=False))
