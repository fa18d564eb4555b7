"""Command filter: rate limits, gait phase and heading control."""

from __future__ import annotations

import numpy as np
import pytest
from scripted_world import COMMAND_LIMITS as LIMITS

from surefoot.robot import RobotDescription
from surefoot.task.command_follower import CommandFilter
from surefoot.task.config import load_task

STEP = np.array([0.1])


def make_filter(frequency: float = 2.0) -> CommandFilter:
    """Return the filter of one standing robot with a natural time of 0.2 s, so that a start takes 0.3 s."""
    command_filter = CommandFilter(LIMITS, 0.2, 1, lambda command, over_holes: np.full(len(command), frequency))
    command_filter.reset(np.arange(1), np.zeros(1))
    return command_filter


def test_the_filtered_command_changes_within_its_acceleration() -> None:
    command_filter = make_filter()
    for _ in range(3):
        command_filter.advance(np.array([[2.0, 0.0, -1.0]]), STEP, np.zeros(1))
    assert command_filter.filtered_command[0] == pytest.approx([0.6, 0.0, -1.0])  # 2 m/s^2 and 4 rad/s^2 for 0.3 s


def test_steps_start_and_stop_gradually_while_the_phase_continues() -> None:
    command_filter, go, stand = make_filter(), np.array([[0.2, 0.0, 0.0]]), np.zeros((1, 3))
    activity = []
    for command in (go, go, go, go, stand, stand, stand, stand, stand):
        command_filter.advance(command, STEP, np.zeros(1))
        activity.append(float(command_filter.activity[0]))
    # The filtered command reaches zero in the first step of standing, which still counts as a step.
    assert activity == pytest.approx([1 / 3, 2 / 3, 1, 1, 2 / 3, 1 / 3, 0, 0, 0])
    assert command_filter.phase[0] == pytest.approx(0.8)  # 9 steps of 0.1 s at 2 Hz


def test_heading_control_follows_the_imu() -> None:
    command_filter, go = make_filter(), np.array([[1.0, 0.0, 0.5]])
    for _ in range(4):
        command_filter.advance(go, STEP, np.array([0.1]))
    # Turned by 0.04, 0.09 and so on at 4 rad/s^2 up to 0.5 rad/s: 0.4 + 0.5 + 0.5 + 0.5 rad/s for 0.1 s each, minus
    # 0.1.
    assert command_filter.heading_error[0] == pytest.approx(0.09)
    assert command_filter.state.command[0, 2] == pytest.approx(0.5 + 2.0 * 0.09)


def test_the_desired_heading_wraps_and_its_error_is_bounded() -> None:
    command_filter, go = make_filter(), np.array([[1.0, 0.0, 0.0]])
    command_filter.reset(np.arange(1), np.array([3.1]))
    command_filter.advance(go, STEP, np.array([-3.1]))
    assert command_filter.heading_error[0] == pytest.approx(6.2 - 2 * np.pi)
    command_filter.advance(go, STEP, np.array([0.0]))  # the robot was turned by hand by half a turn
    assert abs(command_filter.heading_error[0]) == pytest.approx(0.5)
    command_filter.advance(go, STEP, np.array([0.0]))
    assert abs(command_filter.heading_error[0]) <= 0.5 + 1e-12


def test_a_standing_robot_does_not_correct_its_heading() -> None:
    command_filter = make_filter()
    command_filter.advance(np.zeros((1, 3)), STEP, np.array([0.3]))
    assert command_filter.state.command.tolist() == [[0.0, 0.0, 0.0]]
    assert command_filter.activity[0] == 0.0


def test_a_small_heading_error_is_corrected_after_standing() -> None:
    command_filter, stand = make_filter(), np.zeros((1, 3))
    command_filter.heading[:] = 0.4
    for _ in range(500):  # stopped 0.1 rad before the desired heading
        command_filter.advance(stand, STEP, np.array([0.3]))
    assert command_filter.correction[0] == 0.0
    command_filter.advance(np.array([[0.5, 0.0, 0.0]]), STEP, np.array([0.3]))
    assert command_filter.heading_error[0] == pytest.approx(0.1)
    command_filter.advance(stand, STEP, np.array([1.3]))
    for _ in range(500):  # the robot was turned by hand
        command_filter.advance(stand, STEP, np.array([1.3]))
    assert command_filter.heading_error[0] == pytest.approx(-0.15)


def test_a_gait_that_follows_no_commands_keeps_its_own_frequency() -> None:
    go2 = RobotDescription.load("go2")
    trot, none = (load_task(name, "go2")[0].gait(go2).reference for name in ("trot", "scratch"))
    for reference, cycles in ((trot, 0.1 / trot.period), (none, 0.0)):
        command_filter = CommandFilter(LIMITS, go2.natural_time, 1, reference.frequency)
        command_filter.reset(np.arange(1), np.zeros(1))
        command_filter.advance(np.array([[0.5, 0.0, 0.0]]), STEP, np.zeros(1))
        assert command_filter.state.phase == pytest.approx(cycles % 1.0)
