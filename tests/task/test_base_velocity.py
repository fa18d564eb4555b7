"""The observation `base_velocity`: an estimate from delayed readings, the same in simulation and on the robot."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")

from exact_resume import assert_resumes_exactly

from surefoot.deploy.controller import Controller
from surefoot.errors import SurefootError
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.policy.contract import Contract
from surefoot.rotations import in_heading_frame
from surefoot.task.base_velocity import motion_readings
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.contract_mapping import contract_from_task, task_from_contract
from surefoot.task.env import LocomotionEnv
from surefoot.task.observation import PARTS
from surefoot.task.pushes import PushConfig
from surefoot.world.sim_world import SimWorld

SLOW = (0.15, 0.0, 0.0)


@pytest.fixture
def task() -> TaskConfig:
    """A Go2 that follows a command, and observes its velocity first."""
    task = load_task("steer", "go2")[0]
    commands = replace(task.commands, each=(SLOW,))
    return replace(task, observations=("base_velocity", *task.observations), history=1, commands=commands)


def velocity_of(observation: np.ndarray) -> np.ndarray:
    return observation[:, :3]


def step(env: LocomotionEnv) -> np.ndarray:
    """Take a step of the reference gait without feedback; return the observation."""
    return env.step(env.gait.action(np.zeros((env.num_envs, len(env.gait.action_names)))))[0]


def test_the_estimate_of_the_readings_is_observed(task):
    env = LocomotionEnv(task, 2, SimWorld, threads=1)
    estimator = LeggedOdometry(env.robot, 2)
    observation, _ = env.reset()
    np.testing.assert_array_equal(velocity_of(observation), np.zeros((2, 3)))
    estimator.start(np.arange(2), motion_readings(env.state.readings, env.state.duration))
    for _ in range(40):
        observation = step(env)
        estimate = estimator.update(motion_readings(env.state.readings, env.state.duration))
        np.testing.assert_allclose(velocity_of(observation), estimate.velocity_base, atol=1e-6)


def test_the_estimate_has_an_error_and_is_close_to_the_true_velocity(task):
    env = LocomotionEnv(task, 2, SimWorld, threads=1)
    env.reset()
    estimates, truths = [], []
    for _ in range(70):
        estimates.append(velocity_of(step(env)))
        truth = env.state.truth
        truths.append(in_heading_frame(truth.base_velocity_world, truth.roll_pitch_yaw[:, 2]))
    estimated, true = (np.array(rows)[20:, :, 0] for rows in (estimates, truths))
    assert np.abs(true).mean() > 0.03  # the robot moves
    assert estimated.mean() == pytest.approx(true.mean(), abs=0.02)
    assert 0.002 < np.abs(estimated - true).mean() < 0.05


def test_robots_that_start_again_do_not_disturb_the_others(task):
    env, undisturbed = (LocomotionEnv(task, 3, SimWorld, threads=1) for _ in range(2))
    for one in (env, undisturbed):
        one.reset()
        for _ in range(30):
            step(one)
    first = velocity_of(undisturbed.reset()[0])[1]
    observation, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_allclose(velocity_of(observation)[1], first, atol=0.02)  # it stands
    assert np.abs(velocity_of(observation)[0, 0]) > 0.05
    alone = LocomotionEnv(task, 3, SimWorld, threads=1)
    alone.reset()
    for _ in range(30):
        step(alone)
    for _ in range(20):
        rows = velocity_of(step(env))
        np.testing.assert_array_equal(rows[[0, 2]], velocity_of(step(alone))[[0, 2]])


def test_a_restart_does_not_change_readings_that_others_keep(task):
    env = LocomotionEnv(task, 3, SimWorld, threads=1)
    for _ in range(5):
        step(env)
    kept = env.state.readings
    rates = kept.angular_velocity_base.copy()
    env.reset(options={"reset_mask": np.array([False, True, False])})
    assert env.state.readings is not kept
    np.testing.assert_array_equal(kept.angular_velocity_base, rates)


def test_a_restarted_robot_is_estimated_as_at_its_first_start(task):
    task = replace(task, start_linear_speed=0.0, start_angular_speed=0.0)
    env = LocomotionEnv(task, 2, SimWorld, threads=1)
    first = [velocity_of(env.reset()[0])[1], *(velocity_of(step(env))[1] for _ in range(20))]
    again = [velocity_of(env.reset(options={"reset_mask": np.array([False, True])})[0])[1]]
    again += [velocity_of(step(env))[1] for _ in range(20)]
    np.testing.assert_array_equal(again, first)


def test_the_estimate_resumes_exactly(task):
    env = LocomotionEnv(replace(task, max_steps=20), 3, SimWorld, threads=1)
    for _ in range(15):
        step(env)
    assert_resumes_exactly(env, [np.zeros((3, 12))] * 10)


class Still:
    """A policy without feedback."""

    def __init__(self, contract: Contract) -> None:
        self.contract = contract

    def feedback(self, observation: np.ndarray) -> np.ndarray:
        return np.zeros((1, len(self.contract.action_names)))


def run_on_robot(env: LocomotionEnv, controller: Controller, lead: float, torque_of: str, steps: int) -> np.ndarray:
    """Return the velocities (steps, 2, 3) that a robot and the simulation observe in the same episode.

    Args:
        env: one robot.
        controller: the robot's.
        lead: see `Controller.reset`.
        torque_of: whether the robot sends torques as old as the other readings ("readings") or the newest ("truth").
        steps: control steps.
    """
    observation, _ = env.reset()
    controller.reset(lead)
    has_commands, velocities = env.task.commands.enabled, []
    for k in range(steps):
        readings, time = env.state.readings, k * controller.contract.control_step
        names = ("roll_pitch_yaw", "angular_velocity_base", "motor_angle", "motor_velocity")
        torque = getattr(env.state, torque_of).motor_torque[0]
        state = SimpleNamespace(**{name: getattr(readings, name)[0] for name in names}, motor_torque=torque)
        if has_commands:
            controller.set_command(env.state.command[0])
        seen = controller.observe(time, state)
        velocities.append([seen[0, :3].copy(), velocity_of(observation)[0].copy()])
        controller.compute_target(time, seen)
        observation = step(env)
    return np.array(velocities)


def test_the_robot_computes_the_same_observation(task):
    env = LocomotionEnv(task, 1, SimWorld, threads=1, autoreset=False)
    contract = contract_from_task(task, env.robot)
    assert contract.columns[:3] == ("base_velocity_x", "base_velocity_y", "base_velocity_z")
    assert task_from_contract(contract).needs_base_velocity
    controller, latency = Controller(Still(contract), env.robot), env.robot.nominal_params()["control_latency"]
    for _ in range(2):  # a second episode forgets the first one
        robot, simulation = run_on_robot(env, controller, latency, "readings", 20).swapaxes(0, 1)
        np.testing.assert_allclose(robot, simulation, atol=1e-6)


def test_the_newest_torques_of_a_robot_are_delayed_like_its_other_readings():
    trot = load_task("trot")[0]
    task = replace(
        trot, observations=("base_velocity", *trot.observations), history=1, pushes=PushConfig(enabled=False)
    )
    env = LocomotionEnv(task, 1, SimWorld, threads=1, autoreset=False)
    controller = Controller(Still(contract_from_task(task, env.robot)), env.robot)
    errors = []
    for lead in (0.0, env.robot.nominal_params()["control_latency"]):
        robot, simulation = run_on_robot(env, controller, lead, "truth", 80).swapaxes(0, 1)
        errors.append(np.sqrt(np.mean((robot - simulation)[20:] ** 2)))
    assert errors[0] < 0.5 * errors[1]


def test_a_task_without_the_observation_measures_no_torques():
    env = LocomotionEnv(load_task("steer", "go2")[0], 1, SimWorld, threads=1)
    assert env.state.readings.motor_torque is None
    assert env.state.base_velocity is None
    with pytest.raises(SurefootError, match="needs an estimate of the velocity"):
        PARTS["base_velocity"].read(env.state)
    with pytest.raises(SurefootError, match="needs motor torques among the readings"):
        motion_readings(env.state.readings, env.state.duration)
