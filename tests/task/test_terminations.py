"""Terminations: each condition, and their precedence."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from scripted_world import ScriptedWorld

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.state import EnvState
from surefoot.task.terminations import TERMINATIONS, end_episodes, is_low, is_tilted
from surefoot.world.ground import FLAT


def state(num_envs: int) -> EnvState:
    robot = RobotDescription.load("minitaur")
    world = ScriptedWorld(robot, num_envs, PhysicalParams.nominal(robot, num_envs))
    return EnvState.of_world(world, load_task("trot")[0].gait(robot), FLAT)


def test_every_termination_is_a_field_of_the_task() -> None:
    assert all(hasattr(TaskConfig(), name) for name in TERMINATIONS)


def test_falls_divergence_and_length_end_episodes_and_a_fall_wins() -> None:
    now = state(6)
    tilt, height = np.zeros((6, 3)), np.tile([0.0, 0.0, 0.2], (6, 1))
    tilt[1, 0], tilt[4, 1], height[2, 2] = 0.6, 0.6, 0.09
    diverged = np.array([False, False, False, True, False, False])
    now.truth = replace(now.truth, roll_pitch_yaw=tilt, base_position_world=height, diverged=diverged)
    now.steps[:] = [9, 9, 9, 9, 10, 10]
    task = replace(load_task("trot")[0], fall_height=0.1, max_steps=10)
    end_episodes(now, task)
    assert now.terminated.tolist() == [False, True, True, True, True, False]
    assert now.truncated.tolist() == [False] * 5 + [True]
    # A limit of 0 disables a condition, and robots that wait for a reset do not end again.
    now.over[1] = True
    end_episodes(now, replace(task, fall_height=0.0))
    assert now.terminated.tolist() == [False, False, False, True, True, False]


def at(angles: list[tuple[float, float, float]], height: float = 0.2) -> SimpleNamespace:
    """Return the state of robots on flat ground with roll, pitch and yaw [rad] and a base height [m]."""
    robot = RobotDescription.load("minitaur")
    world = ScriptedWorld(robot, len(angles), PhysicalParams.nominal(robot))
    position = np.tile([0.0, 0.0, height], (len(angles), 1))
    truth = replace(world.truth(), roll_pitch_yaw=np.array(angles), base_position_world=position)
    return SimpleNamespace(truth=truth, ground=FLAT)


def test_a_fall_is_a_tilt_or_a_low_base():
    upright = [(0.0, 0.0, 0.0), (0.499, -0.499, 0.0), (0.5, 0.5, 0.0), (0.0, 0.0, 3.0)]
    fallen = [(0.501, 0.0, 0.0), (0.0, 0.501, 0.0), (-0.501, 0.0, 0.0), (0.0, -0.501, 0.0)]
    assert is_tilted(at(upright + fallen), 0.5).tolist() == [False] * 4 + [True] * 4
    assert is_tilted(at(upright), 0.4).tolist() == [False, True, True, False]
    assert is_low(at(upright, 0.081), 0.08).tolist() == [False] * 4
    assert is_low(at(upright, 0.079), 0.08).tolist() == [True] * 4
