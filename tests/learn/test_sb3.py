"""Stable-Baselines3 with a single robot and with a batch."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest

import surefoot
import surefoot.envs  # registers the ids
from surefoot.errors import SurefootError
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.world.sim_world import SimWorld

stable_baselines3 = pytest.importorskip("stable_baselines3")

import torch  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.vec_env import VecNormalize  # noqa: E402
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


def test_a_batch_without_autoreset_is_rejected():
    with pytest.raises(SurefootError, match="autoreset is off"):
        SB3VecEnv(batch(autoreset=False))


@pytest.mark.parametrize("name", ["PPO", "SAC", "TD3"])
@pytest.mark.parametrize("normalized", [True, False])
def test_an_exported_policy_acts_as_its_model(name: str, normalized: bool, tmp_path: Path, rng: np.random.Generator):
    robots = SB3VecEnv(batch(2))
    env = VecNormalize(robots, clip_obs=2.0) if normalized else robots
    model = getattr(stable_baselines3, name)("MlpPolicy", env, seed=0, device="cpu")
    (width,) = robots.observation_space.shape
    samples = rng.normal(scale=3.0, size=(100, width)).astype(np.float32)
    inputs = samples
    if normalized:
        env.obs_rms.update(rng.normal(0.5, np.linspace(0.1, 3.0, width), size=(1000, width)))
        inputs = env.normalize_obs(samples)
    policy = surefoot.export(model, tmp_path / "p.onnx", name="other")
    action, _ = model.predict(inputs, deterministic=True)
    assert np.ptp(action) > 0.01
    np.testing.assert_allclose(policy.feedback(samples), robots.env.gait.feedback(action), rtol=0, atol=2e-6)
    assert policy.name == "other"
    assert policy.task.feedback == FEEDBACK


def test_a_loaded_model_is_exported_with_the_normalizer_of_its_environment(tmp_path: Path, rng: np.random.Generator):
    env = VecNormalize(SB3VecEnv(batch(2)), clip_obs=2.0)
    width = env.observation_space.shape[0]
    env.obs_rms.update(rng.normal(0.5, np.linspace(0.1, 3.0, width), size=(1000, width)))
    PPO("MlpPolicy", env, seed=0, device="cpu").save(tmp_path / "model")
    model = PPO.load(tmp_path / "model", device="cpu")
    policy = surefoot.export(model, tmp_path / "p.onnx", env=env)
    samples = rng.normal(scale=3.0, size=(100, width)).astype(np.float32)
    action, _ = model.predict(env.normalize_obs(samples), deterministic=True)
    np.testing.assert_allclose(policy.feedback(samples), batch().gait.feedback(action), rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    "wrap",
    [
        gymnasium.wrappers.NormalizeObservation,
        lambda env: gymnasium.wrappers.RescaleAction(env, 0.0, 1.0),
        lambda env: gymnasium.wrappers.TimeLimit(gymnasium.wrappers.NormalizeObservation(env), 10),
    ],
)
def test_wrappers_that_a_policy_file_does_not_contain_are_rejected(wrap, tmp_path: Path):
    env = wrap(gymnasium.make("surefoot/Trot-v0"))
    module = torch.nn.Linear(env.observation_space.shape[0], 8)
    with pytest.raises(SurefootError, match=r"env has the wrapper (NormalizeObservation|RescaleAction), which changes"):
        surefoot.export(module, tmp_path / "p.onnx", env=env)
    clipped = gymnasium.wrappers.ClipAction(gymnasium.make("surefoot/Trot-v0"))
    assert surefoot.export(module, tmp_path / "p.onnx", env=clipped).robot.name == "minitaur"


@pytest.mark.parametrize("name", ["surefoot/Trot-v0", "batch", "monitored"])
def test_a_module_is_exported_for_any_form_of_its_environment(name: str, tmp_path: Path):
    env = {
        "batch": lambda: VecNormalize(SB3VecEnv(batch(2))),
        "monitored": lambda: make_vec_env("surefoot/Trot-v0", n_envs=1, seed=0),
    }.get(name, lambda: gymnasium.make(name))()
    space = getattr(env, "single_observation_space", env.observation_space)
    module = torch.nn.Linear(space.shape[0], 8)
    policy = surefoot.export(module, tmp_path / "p.onnx", env=env, output="feedback")
    assert policy.robot.name == "minitaur"


def test_an_environment_of_another_package_is_rejected(tmp_path: Path):
    module = torch.nn.Linear(4, 8)
    with pytest.raises(SurefootError, match="env is a TimeLimit; it must be an environment of surefoot"):
        surefoot.export(module, tmp_path / "p.onnx", env=gymnasium.make("CartPole-v1"))
    with pytest.raises(SurefootError, match="env is missing"):
        surefoot.export(module, tmp_path / "p.onnx")
