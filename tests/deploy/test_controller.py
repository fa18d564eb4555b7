"""The controller on a robot computes the same observations, feedback and targets as in training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surefoot.deploy.controller import Controller
from surefoot.deploy.safety import NotFiniteError
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription

ROOT = Path(__file__).resolve().parents[2]
POLICIES = sorted((ROOT / "policies").glob("*.onnx"))
GROUNDS = {"go2-terrain-seeing": "gaps:0.15", "go2-terrain": "stairs:0.1"}
"""Terrain of policies whose reference gait reacts to it."""


class Echo:
    """A policy that records its inputs and returns constant feedback."""

    def __init__(self, contract, feedback=0.0):
        self.contract = contract
        self.value = feedback
        self.seen: list[np.ndarray] = []

    def feedback(self, observation):
        self.seen.append(observation.copy())
        return np.full((1, len(self.contract.action_names)), self.value)


@pytest.fixture(scope="session")
def contract():
    return PolicyRuntime.load(next(path for path in POLICIES if path.stem == "trot")).contract


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.stem)
def test_a_simulated_episode_gets_the_same_targets(path, a_state):
    """Pass readings of a simulated episode to the controller, step by step."""
    pytest.importorskip("mujoco")
    pytest.importorskip("gymnasium")
    from surefoot.task.contract_mapping import task_from_contract
    from surefoot.task.env import LocomotionEnv
    from surefoot.world.sim_world import SimWorld

    policy = PolicyRuntime.load(path)
    task = task_from_contract(policy.contract)
    task = replace(task, pushes=replace(task.pushes, enabled=False), randomize={})
    if path.stem in GROUNDS:
        task = replace(task, terrain=replace(task.terrain, sizes={}, shares={}, ground=GROUNDS[path.stem]))
    env = LocomotionEnv(task, 1, SimWorld, 5, autoreset=False, threads=1)
    controller = Controller(policy, RobotDescription.load(policy.contract.robot))
    observation, _ = env.reset()
    adapted = False
    for k in range(200 if path.stem in GROUNDS else 50):  # the first step of the terrain is a metre away
        readings = env.state.readings
        state = replace(
            a_state,
            roll_pitch_yaw=readings.roll_pitch_yaw[0],
            angular_velocity_base=readings.angular_velocity_base[0],
            motor_angle=readings.motor_angle[0],
            motor_velocity=readings.motor_velocity[0],
        )
        moment = k * policy.contract.control_step
        assert readings.time[0] == pytest.approx(moment, abs=1e-12)
        if task.commands.enabled:
            assert controller.set_command(env.state.command[0]) == ""
        if env.state.heights is not None:
            controller.heights = env.state.heights[0]
        feet = env.state.gait_state
        if feet is not None:
            adapted |= feet.landing is not None and feet.landing.any()
            adapted |= feet.lift is not None and feet.lift.any()
        observed = controller.observe(moment, state)
        assert observed == pytest.approx(observation, abs=1e-6)
        target = controller.compute_target(moment, observed)
        observation, *_ = env.step(env.gait.action(policy.feedback(observation)))
        assert target == pytest.approx(env.state.target[0], abs=1e-6)
    assert adapted == (path.stem in GROUNDS)


def test_history_is_the_newest_first_and_starts_full(contract, robot, a_state):
    policy = Echo(replace(contract, history=3))
    controller = Controller(policy, robot)
    for k in range(1, 5):
        state = replace(a_state, roll_pitch_yaw=np.array([k / 10, 0.0, 0.0]))
        controller.compute_target(0.0, controller.observe(0.0, state))
    rolls = [seen.reshape(3, -1)[:, 0].tolist() for seen in policy.seen]
    assert rolls[0] == pytest.approx([0.1, 0.1, 0.1])
    assert rolls[1] == pytest.approx([0.2, 0.1, 0.1])
    assert rolls[3] == pytest.approx([0.4, 0.3, 0.2])
    controller.reset()
    assert controller.observe(0.0, a_state).reshape(3, -1)[:, 0].tolist() == [0.0, 0.0, 0.0]


def test_missed_steps_count_in_the_history(contract, robot, a_state):
    policy = Echo(replace(contract, history=3))
    controller = Controller(policy, robot)
    for roll, missed in ((0.1, 0), (0.2, 0), (0.3, 1), (0.4, 7)):
        state = replace(a_state, roll_pitch_yaw=np.array([roll, 0.0, 0.0]))
        controller.compute_target(0.0, controller.observe(0.0, state, missed))
    rolls = [seen.reshape(3, -1)[:, 0].tolist() for seen in policy.seen]
    assert rolls[2] == pytest.approx([0.3, 0.2, 0.2])
    assert rolls[3] == pytest.approx([0.4, 0.3, 0.3])


def test_readings_that_are_not_finite_are_named(contract, robot, a_state):
    controller = Controller(Echo(contract), robot)
    with pytest.raises(NotFiniteError, match="observation 'pitch' is nan"):
        controller.observe(0.0, replace(a_state, roll_pitch_yaw=np.array([0.0, np.nan, 0.0])))


def test_feedback_that_is_not_finite_is_named(contract, robot, a_state):
    controller = Controller(Echo(contract, np.inf), robot)
    with pytest.raises(NotFiniteError, match=r"feedback 'swing.front_left' is inf"):
        controller.compute_target(0.0, controller.observe(0.0, a_state))


def test_a_gait_beyond_the_limits_of_the_legs_is_rejected(contract, robot):
    with pytest.raises(SurefootError, match="a leg of minitaur allows"):
        Controller(Echo(replace(contract, high=(0.9,) * 8)), robot)
