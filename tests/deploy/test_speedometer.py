"""The estimated speed that the display shows."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from surefoot.deploy.messages import State
from surefoot.deploy.speedometer import Speedometer
from surefoot.robot import RobotDescription

DT, SPEED, HEIGHT = 0.01, 0.3, 0.2


def walking(robot: RobotDescription, state: State, steps: int) -> list[State]:
    """Return states of a robot whose feet all go backward on the ground, over and over: it never lifts one."""
    legs, index, states = robot.leg_geometry, robot.leg_motor_index, []
    weight = np.tile([0.0, 0.0, robot.weight / 4], (4, 1))
    for k in range(steps):
        foot = np.tile([0.05 - SPEED * DT * k, 0.0, -HEIGHT], (4, 1))
        angles, (angle, torque) = legs.to_motors(legs.foot_pose(foot)), np.zeros((2, robot.num_motors))
        angle[index], torque[index] = angles, -np.einsum("lim,li->lm", legs.foot_kinematics(angles).jacobian, weight)
        level = np.zeros(3)
        states.append(
            replace(
                state,
                motor_angle=angle,
                motor_velocity=np.zeros_like(angle),
                motor_torque=torque,
                roll_pitch_yaw=level,
                angular_velocity_base=level,
            )
        )
    return states


@pytest.mark.parametrize("missed", [0, 1])
def test_speed_and_distance_follow_the_feet_also_over_missed_steps(a_state: State, missed: int):
    robot = RobotDescription.load("minitaur")
    speedometer, states = Speedometer(robot, DT), walking(robot, a_state, 41)[:: missed + 1]
    for state in states:
        speedometer.update(state, missed + 1)
    shown = speedometer.velocity.copy()
    speedometer.update(replace(states[-1], roll_pitch_yaw=np.full(3, np.nan)))
    np.testing.assert_array_equal(speedometer.velocity, shown)
    # Rounded feet roll on by 4 percent; the shown speed follows with a time constant.
    reached = SPEED * (1.0 - np.exp(-0.4 / 0.5))
    assert speedometer.velocity[0] == pytest.approx(reached, rel=0.15)
    assert speedometer.velocity[1] == pytest.approx(0.0, abs=0.01)
    assert 0.3 * SPEED * 0.4 < speedometer.distance < SPEED * 0.4


def test_torques_are_delayed_like_the_other_readings(a_state: State):
    speedometer = Speedometer(RobotDescription.load("minitaur"), DT, lead=0.01)
    with mock.patch.object(speedometer, "_estimator") as estimator:
        estimator.update.return_value.velocity_base = np.zeros((1, 3))
        for k in range(4):
            speedometer.update(replace(a_state, motor_torque=np.full(8, float(k))))
    used = [call.args[0].motor_torque[0, 0] for call in estimator.update.call_args_list]
    np.testing.assert_allclose(used, [0.0, 0.0, 1.0, 2.0], atol=1e-9)
