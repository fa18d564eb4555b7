"""Gait over holes: blended poses and frequency, and its observation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_resume import assert_resumes_exactly

from surefoot.configuration import from_mapping, to_mapping
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.foothold_error import FootholdError
from surefoot.task.reference import FollowingReference
from surefoot.world.sim_world import SimWorld

GO2 = RobotDescription.load("go2")


def two_gaits(height: float = 0.7, frequency: float = 2.8) -> TaskConfig:
    """Return the task `terrain` of Go2 with a gait over holes of another height and frequency, in relative units."""
    task = load_task("terrain", "go2")[0]
    foot = {**to_mapping(task.reference.foot), "height": height, "frequency": frequency}
    over = {"foot": foot, "stride_gain": task.reference.stride_gain, "frequency_rise": 0.5}
    data = {
        "reference": {"foothold_radius": 0.5, "over_holes": over},
        "observations": [*task.observations, "footholds", "over_holes"],
    }
    return from_mapping(TaskConfig, data, base=task)


def walking(share: float) -> CommandState:
    """Return the state of a robot that walks forward, with a blend weight of the gait over holes."""
    command = np.array([[0.4, 0.0, 0.0]])
    return CommandState(command, np.ones(1), np.array([0.3]), over_holes=np.array([share]))


def test_poses_are_blended_between_the_gaits():
    low, same = (two_gaits(height).gait(GO2).reference for height in (0.6, 0.7))
    assert isinstance(low, FollowingReference)
    assert low.over_holes is not None
    own, half, over = (low.pose(0.0, walking(share)) for share in (0.0, 0.5, 1.0))
    np.testing.assert_array_equal(own, same.pose(0.0, walking(0.0)))
    np.testing.assert_allclose(half, (own + over) / 2, atol=1e-12)
    np.testing.assert_array_equal(over, low.over_holes.pose(0.0, walking(0.0)))
    assert np.all(over[:, 2] < own[:, 2])  # shorter legs


def test_feedback_acts_in_both_gaits():
    gait, feedback = two_gaits(0.6).gait(GO2), np.full((1, 12), 0.01)
    for share in (0.0, 1.0):
        with_it, without = (gait.motor_targets(np.zeros(1), part, walking(share)) for part in (feedback, 0 * feedback))
        np.testing.assert_allclose(GO2.to_pose(with_it) - GO2.to_pose(without), 0.01, atol=1e-9)


def test_frequency_is_blended_between_the_gaits():
    reference = two_gaits(frequency=1.4).gait(GO2).reference
    assert isinstance(reference, FollowingReference)
    frequency = reference.frequency(np.zeros((3, 3)), np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(frequency, reference.feet.frequency * np.array([1.0, 0.75, 0.5]))


def test_a_robot_observes_the_blend_weight_and_resumes_exactly():
    task = two_gaits()
    terrain = replace(task.terrain, sizes={}, shares={}, ground="gaps:0.1")
    commands = replace(task.commands, each=((0.5, 0.0, 0.0),))
    reward = {**task.reward, "foothold_error": -1.0}
    task = replace(task, terrain=terrain, commands=commands, reward=reward)
    env = LocomotionEnv(task, 2, SimWorld, seed=3, threads=1)
    action, column = np.zeros((2, len(env.gait.action_names))), env.observer.columns.index("over_holes")
    seen = []
    for _ in range(190):  # the first gap is 1 m away
        observation = env.step(action)[0]
        seen.append(observation[:, column])
    assert_resumes_exactly(env, [action] * 30)
    assert np.min(seen) == 0.0
    assert np.max(seen) == 1.0
    assert np.isfinite(env.component(FootholdError).places).any()


def test_a_gait_over_holes_is_rejected_without_footholds_and_without_its_observation():
    task = two_gaits()
    with pytest.raises(SurefootError, match=r"over_holes is given, but foothold_radius is 0; holes are detected"):
        replace(task, reference=replace(task.reference, foothold_radius=0.0))
    with pytest.raises(SurefootError, match=r"over_holes is given, but observations lack over_holes; the policy needs"):
        replace(task, observations=task.observations[:-1])
