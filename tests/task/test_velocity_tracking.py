"""Tracking errors, worked by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scripted_world import ScriptedWorld

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.task.config import load_task
from surefoot.task.state import EnvState
from surefoot.task.velocity_tracking import VelocityTracking
from surefoot.world.ground import FLAT


def walking(speed: float) -> EnvState:
    """Return the state of two robots, of which the first has gone forward at a speed [m/s] for 0.1 s."""
    robot = RobotDescription.load("minitaur")
    world = ScriptedWorld(robot, 2, PhysicalParams.nominal(robot, 2))
    state = EnvState.of_world(world, load_task("trot")[0].gait(robot), FLAT)
    position = state.truth.base_position_world + np.array([[0.1 * speed, 0.0, 0.0], [0.0, 0.0, 0.0]])
    truth = replace(state.truth, base_position_world=position)
    command = np.array([[0.5, 0.0, 0.0], [0.0, 0.2, 0.1]])
    return replace(state, truth=truth, filtered_command=command, duration=np.full(2, 0.1))


def test_the_error_is_velocity_minus_command_and_is_averaged_over_a_stride() -> None:
    state, tracking = walking(0.8), VelocityTracking(0.4)
    tracking.measure(state)
    np.testing.assert_allclose(state.command_error, [[0.3, 0.0, 0.0], [0.0, -0.2, -0.1]], atol=1e-12)
    # A step of 0.1 s is a quarter of the stride of 0.4 s.
    np.testing.assert_allclose(state.stride_error, 0.25 * state.command_error, atol=1e-12)
    tracking.measure(state)
    np.testing.assert_allclose(state.stride_error[0, 0], 0.25 * 0.3 + 0.75 * 0.25 * 0.3)
    tracking.reset(np.array([0]), state)
    assert state.stride_error.any(axis=1).tolist() == [False, True]


@pytest.mark.parametrize("why", ["over", "diverged"])
def test_ignored_steps_leave_no_error(why: str) -> None:
    state, tracking = walking(0.8), VelocityTracking(None)
    tracking.measure(state)
    (state.over if why == "over" else state.truth.diverged)[0] = True
    tracking.after_step(state)
    assert state.command_error.any(axis=1).tolist() == [False, True]
    assert state.stride_error.any(axis=1).tolist() == [False, True]
