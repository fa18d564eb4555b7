"""`LocomotionEnv` in a scripted world with known answers, and in MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from scripted_world import ScriptedWorld

from surefoot.errors import SurefootError
from surefoot.task.config import FeedbackConfig, TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.leg_config import WaveConfig
from surefoot.task.pushes import PushConfig
from surefoot.task.reference_config import SineReferenceConfig
from surefoot.world.sim_world import SimWorld

FEEDBACK = FeedbackConfig(swing=(-0.5, 0.5), extension=(1.0, 2.0))


@pytest.fixture
def make_env():
    """Make an environment in the scripted world; keywords are fields of the task or, with `env_`, arguments."""

    def make(num_envs: int = 2, **values) -> LocomotionEnv:
        options = {key.removeprefix("env_"): values.pop(key) for key in list(values) if key.startswith("env_")}
        return LocomotionEnv(TaskConfig(**{"feedback": FEEDBACK, **values}), num_envs, ScriptedWorld, **options)

    return make


def rest(env: LocomotionEnv) -> np.ndarray:
    return np.zeros((env.num_envs, 8))


# --- interface --------------------------------------------------------------------------------------------


def test_reset_and_step_return_what_gymnasium_specifies(make_env):
    env = make_env(3)
    assert isinstance(env, gymnasium.vector.VectorEnv)
    assert env.single_action_space == gymnasium.spaces.Box(-1, 1, (8,), np.float32)
    assert (env.single_observation_space.shape, env.observation_space.shape) == ((12,), (3, 12))
    assert env.action_space.shape == (3, 8)
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert info == {}
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert observation.dtype == np.float32
    assert (reward.shape, reward.dtype) == ((3,), np.float64)
    assert (terminated.shape, terminated.dtype) == ((3,), np.bool_)
    assert (truncated.shape, truncated.dtype) == ((3,), np.bool_)
    assert info == {}


def test_a_returned_observation_does_not_change(make_env):
    env = make_env()
    first, _ = env.reset()
    kept = first.copy()
    env.step(np.ones((2, 8)))
    assert np.array_equal(first, kept)


# --- reward and ends --------------------------------------------------------------------------------------


def test_an_episode_is_truncated_after_its_steps_and_has_metrics(make_env):
    env = make_env(2, max_steps=3, reward={"progress": 1.0, "energy": -0.01})
    env.reset()
    for k, speed in enumerate((0.0, 1.0, 2.0)):
        env.world.speed[:], env.world.power[:] = (speed, 0.0), 100.0
        _, reward, terminated, truncated, info = env.step(rest(env))
        np.testing.assert_allclose(reward, (0.006 * speed - 0.006, -0.006), atol=1e-15)
        assert not terminated.any()
        assert truncated.tolist() == [k == 2] * 2
        assert bool(info) == (k == 2)
    # Steps of 6 ms at 0, 1 and 2 m/s with 100 W and 0.01 m/J.
    np.testing.assert_allclose(info["figures"]["return"], (0.0, -0.018), atol=1e-15)
    np.testing.assert_allclose(info["figures"]["distance"], (0.018, 0.0))
    np.testing.assert_allclose(info["figures"]["steps"], 3)
    np.testing.assert_allclose(info["figures"]["duration"], 0.018)
    assert info["_figures"].tolist() == [True, True]


def test_a_fall_terminates_and_resets_only_that_robot(make_env):
    env = make_env(3)
    env.reset()
    env.step(np.ones((3, 8)))
    env.world.tilt[1, 0] = 0.6
    observation, _, terminated, truncated, info = env.step(np.ones((3, 8)))
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()
    assert info["_figures"].tolist() == info["_final_obs"].tolist() == [False, True, False]
    assert info["figures"]["steps"].tolist() == [0, 2, 0]
    # The last observation of the old episode: motors at the upper bound of the feedback, theta = 2 +- 0.5.
    assert sorted(set(info["final_obs"][1, 4:].tolist())) == [1.5, 2.5]
    # The first observation of the new episode: motors at their angles after a reset of this world.
    assert not observation[1, 4:].any()
    assert env.state.steps.tolist() == [2, 0, 2]


def test_a_fall_in_the_last_step_is_no_truncation(make_env):
    env = make_env(2, max_steps=1)
    env.reset()
    env.world.tilt[0, 1] = -0.6
    *_, terminated, truncated, _ = env.step(rest(env))
    assert terminated.tolist() == [True, False]
    assert truncated.tolist() == [False, True]


def test_a_diverged_robot_ends_without_reward(make_env):
    env = make_env(2)
    env.reset()
    env.world.speed[:] = 1.0
    env.world.diverged[0] = True
    _, reward, terminated, _, info = env.step(rest(env))
    np.testing.assert_allclose(reward, (0.0, 0.006))
    assert terminated.tolist() == [True, False]
    assert info["diverged"].tolist() == [True, False]


def test_without_autoreset_a_robot_waits(make_env):
    env = make_env(2, max_steps=2, env_autoreset=False)
    env.reset()
    env.step(rest(env))
    *_, truncated, info = env.step(rest(env))
    assert truncated.all()
    assert "final_obs" not in info
    assert env.state.steps.tolist() == [2, 2]
    env.reset(options={"reset_mask": np.array([True, False])})
    assert env.state.steps.tolist() == [0, 2]


# --- observation and action -------------------------------------------------------------------------------


def test_history_stacks_the_newest_first(make_env):
    env = make_env(1, history=3, observations=("last_action",))
    observation, _ = env.reset()
    assert observation.shape == (1, 24)
    for action in (-1.0, 0.0, 1.0):
        observation, *_ = env.step(np.full((1, 8), action))
    # Swing of the front left leg, then its extension, in the last three control steps.
    assert observation.reshape(3, 8)[:, 0].tolist() == [0.5, 0.0, -0.5]
    assert observation.reshape(3, 8)[:, 4].tolist() == [2.0, 1.5, 1.0]


def test_a_new_episodes_history_is_its_first_observation(make_env):
    env = make_env(2, history=3, max_steps=5)
    env.reset()
    for _ in range(5):
        observation, *_ = env.step(np.ones((2, 8)))
    stacked = observation.reshape(2, 3, 12)
    assert np.array_equal(stacked[:, 0], stacked[:, 1])
    assert np.array_equal(stacked[:, 0], stacked[:, 2])


def test_actions_become_motor_angles_at_the_robots_own_time(make_env):
    wave = WaveConfig(amplitude=0.3, frequency=2.0)
    reference = SineReferenceConfig(swing=wave, extension=WaveConfig(offset=2.0))
    env = make_env(1, reference=reference, feedback=FeedbackConfig((0.0, 0.0), (0.0, 0.0)))
    env.reset()
    for k in range(5):
        env.step(rest(env))
        # The command of step k is the reference at the start of the step.
        swing = 0.3 * np.sin(4 * np.pi * k * 0.006)
        assert env.world.angles[0, 1] == pytest.approx(2.0 + swing)
        assert env.world.angles[0, 0] == pytest.approx(2.0 - swing)


def test_robots_settle_in_the_middle_of_their_range(make_env):
    assert make_env().world.config.rest == pytest.approx((0.0, 1.5))
    assert make_env(rest=(0.1, 1.8)).world.config.rest == (0.1, 1.8)


def test_params_of_the_task_are_set_in_the_world(make_env):
    env = make_env(3, params={"voltage": 15.0})
    assert env.world.params.voltage.tolist() == [15.0] * 3
    with pytest.raises(SurefootError, match="'volts' is not a physical parameter"):
        make_env(params={"volts": 15.0})


@pytest.mark.parametrize("num_envs", [1, 2, 3, 8])
def test_params_by_motor_apply_to_every_robot(make_env, num_envs: int):
    # Even with as many robots as motors or axes, a list has the values of one robot.
    strength = tuple(np.linspace(0.9, 1.04, 8))
    env = make_env(num_envs, params={"motor_strength": strength, "imu_bias": (0.1, -0.2), "voltage": (15.0,)})
    np.testing.assert_array_equal(env.world.params.motor_strength, np.tile(strength, (num_envs, 1)))
    np.testing.assert_array_equal(env.world.params.imu_bias, np.tile((0.1, -0.2), (num_envs, 1)))
    assert env.world.params.voltage.tolist() == [15.0] * num_envs
    for name, values in (("voltage", (15.0,) * 2), ("motor_strength", (1.0,) * 3)):
        with pytest.raises(SurefootError, match=f"{name} has shape"):
            make_env(num_envs, params={name: values})


# --- pushes -----------------------------------------------------------------------------------------------


PUSHES = PushConfig(enabled=True, period=0.12)


def test_pushes_reach_the_world_when_they_are_due(make_env):
    env = make_env(2, pushes=PUSHES)
    env.reset()
    for _ in range(52):
        env.step(rest(env))
    pushed = np.linalg.norm(env.world.forces, axis=2)
    for robot in range(2):
        due = np.flatnonzero(pushed[:, robot])
        assert due.tolist() == [*range(20, 30), *range(40, 50)]
    assert np.all((pushed[pushed > 0] >= 130) & (pushed[pushed > 0] <= 220))


@pytest.mark.parametrize("pushes", [PUSHES, PushConfig(period=0.12)])
def test_a_reset_ends_a_push(make_env, pushes):
    env = make_env(2, pushes=pushes)
    env.reset()
    for _ in range(25):
        env.step(rest(env))
    assert env.world.force.any(axis=1).tolist() == [pushes.enabled] * 2
    env.world.tilt[0, 0] = 0.6
    env.step(rest(env))
    assert env.world.force.any(axis=1).tolist() == [False, pushes.enabled]


def test_the_first_observation_is_of_a_standing_robot():
    env = LocomotionEnv(load_task("gallop")[0], 4, SimWorld, threads=1)
    observation, _ = env.reset(seed=0)
    assert np.abs(observation[:, :2]).max() < 0.05
    np.testing.assert_allclose(observation[:, 4:], np.pi / 2, atol=0.3)


# --- ends of an episode ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("height", "fallen"), [(0.0, False), (0.19, False), (0.21, True)])
def test_a_base_below_the_fall_height_ends_the_episode(height, fallen):
    # The scripted base is 0.2 m high.
    env = LocomotionEnv(replace(load_task("trot")[0], fall_height=height), 2, ScriptedWorld, autoreset=False)
    env.reset()
    assert env.step(np.zeros((2, 8)))[2].tolist() == [fallen] * 2


# --- commands ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "commands",
    [{"hold": (0.1, 0.3), "ramp": 3}, {"schedule": ((0.1, 0.3, 0.0, 0.0), (0.4, 0.0, 0.0, 0.5))}],
    ids=["drawn", "scheduled"],
)
def test_robots_with_commands_resume_exactly(commands):
    task = load_task("steer", "go2")[0]
    task = replace(task, max_steps=25, commands=replace(task.commands, **commands))
    env, other = (LocomotionEnv(task, 2, SimWorld, seed, threads=1) for seed in (1, 2))

    def run(one: LocomotionEnv) -> list[np.ndarray]:
        """Take 30 steps, beyond the end of an episode; return observations, rewards and commands."""
        path = []
        for _ in range(30):
            observation, reward, *_ = one.step(np.zeros((2, 12)))
            now = one.state.gait_state
            path += [observation.copy(), reward, one.state.command.copy(), now.command, now.activity, now.phase]
        return path

    run(env)
    state = env.get_state()
    path = run(env)
    # The gait was active, and commands changed.
    assert np.ptp(np.stack(path[2::6]), axis=0).max() > 0.1
    for one in (other, env):
        one.set_state(state)
        assert all(np.array_equal(*pair) for pair in zip(path, run(one), strict=True))
