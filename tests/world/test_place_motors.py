"""Initial motor readings of robots without closed loops, in every engine."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld


@pytest.mark.parametrize("engine", ["mujoco", "bullet"])
@pytest.mark.parametrize("name", ["go2", "pupper_v2"])
def test_initial_readings_are_as_set_and_motion_continues(engine: str, name: str):
    if engine == "bullet":
        pytest.importorskip("pybullet")
    robot = RobotDescription.load(name)
    params = PhysicalParams.nominal(robot, 2).with_values(robot, control_latency=0.0, motor_offset=0.03)
    world = SimWorld(robot, 2, params, config=WorldConfig(rack=True), engine=engine)
    angle = robot.resting_angles + np.linspace(-0.1, 0.1, robot.num_motors) * np.array([[1.0], [0.5]])
    speed = np.array([[0.5], [-0.5]]) * np.ones(robot.num_motors)
    world.place_motors(angle, speed)
    readings = world.readings()
    np.testing.assert_allclose(readings.motor_angle, angle, atol=1e-12)
    np.testing.assert_allclose(readings.motor_velocity, speed, atol=1e-12)
    # True angles are readings minus encoder offsets, and speeds move the joints.
    np.testing.assert_allclose(world.truth().motor_angle, angle - 0.03, atol=1e-12)
    world.actuation.kp[:] = world.actuation.kd[:] = 0.0
    world.actuation.friction[:] = world.actuation.viscous[:] = 0.0
    world.engine.advance(np.ones(2, np.int64))
    moved = world.actuation.sample[:, : robot.num_motors] - angle
    step = robot.timing.servo_step
    assert np.all(np.abs(moved - speed * step) < 200 * step**2)
