from __future__ import annotations

import mujoco
import numpy as np
import pytest

from surefoot.actuator.motor import constraint_speed_kernel, constraint_torque_kernel
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld


def make(robot: RobotDescription, rack: bool = True, **values: float) -> SimWorld:
    """Return one robot with constraint motors, a control step of one servo step, and no latency."""
    values = {"control_step": 0.001, "control_latency": 0.0, "servo_latency": 0.0, **values}
    params = PhysicalParams.nominal(robot).with_values(robot, **values)
    return SimWorld(robot, 1, params, config=WorldConfig(actuator="constraint", rack=rack, threads=1))


def test_target_speed_worked_by_hand() -> None:
    # Error 0.032 rad, gains 1 and 0.015, step 1 ms: 0.032 / (0.001 + 0.015).
    speed = constraint_speed_kernel(1.032, 1.0, 1.0, 0.015, 0.001)
    assert speed == pytest.approx(2.0)
    # The error at the end of the step is zero.
    assert 1.0 * (1.032 - (1.0 + 0.001 * speed)) - 0.015 * speed == pytest.approx(0.0, abs=1e-15)
    # Without damping the motor is at its target one step later; without stiffness it stands.
    assert constraint_speed_kernel(1.02, 1.0, 0.5, 0.0, 0.001) == pytest.approx(20.0)
    assert constraint_speed_kernel(1.02, 1.0, 0.0, 0.015, 0.001) == 0.0


def test_torque_limit_worked_by_hand() -> None:
    # An ideal motor of 0.0954 N m/A and 0.186 Ohm on 16 V: 86.0 A, 8.21 N m.
    assert constraint_torque_kernel(16.0, 0.0954, 0.186, 1.0) == pytest.approx(8.2065, abs=1e-4)
    assert constraint_torque_kernel(16.0, 0.0954, 0.186, 0.5) == pytest.approx(4.1032, abs=1e-4)


@pytest.mark.parametrize("kd", [0.0, 0.015])
def test_the_error_is_zero_at_the_end_of_every_step(robot: RobotDescription, kd: float) -> None:
    world = make(robot, servo_kd=kd)
    target = world.resting_angles + 1e-4 * np.arange(1, 9) * (0.1 if kd == 0 else 1)
    for _ in range(5):
        world.step(target[None])
        truth = world.truth()
        assert np.abs(truth.motor_torque).max() < 8.2
        error = (target - truth.motor_angle[0]) - kd * truth.motor_velocity[0]
        np.testing.assert_allclose(error, 0.0, atol=1e-6)
    assert np.abs(target - truth.motor_angle[0]).max() < np.abs(target - world.resting_angles).max()


def test_torque_has_its_limit_and_strength_scales_it(robot: RobotDescription) -> None:
    for strength in (1.0, 0.5):
        world = make(robot, motor_strength=strength)
        world.step(world.resting_angles[None] + 1.5)
        np.testing.assert_allclose(world.truth().motor_torque, 8.2065 * strength, rtol=1e-4)
        world.step(world.resting_angles[None] - 1.5)
        np.testing.assert_allclose(world.truth().motor_torque, -8.2065 * strength, rtol=1e-4)


def test_a_standing_robot_does_not_sink(robot: RobotDescription) -> None:
    world = make(robot, rack=False)
    for _ in range(300):
        world.step(world.resting_angles[None])
    truth = world.truth()
    assert np.abs(truth.motor_angle[0] - world.resting_angles).max() < 2e-3
    # Nothing moves, so no work is done, although every motor carries part of the 7.5 kg.
    assert np.abs(truth.motor_torque).min() > 0.3
    assert truth.energy[0] < 1e-6


def test_work_done_on_the_rack_is_the_energy_gained(robot: RobotDescription) -> None:
    # Legs that start to move have the kinetic energy that the motors gave them; over 2 ms the work of gravity is
    # negligible.
    world = make(robot)
    world.step(world.resting_angles[None] + 0.03)
    truth = world.truth()
    data, model = world.engine.datas[0], world.engine.models[0]
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    kinetic = 0.5 * data.qvel @ mass @ data.qvel
    # Torque is constant over the step: its work is half of torque times final speed times step.
    assert truth.energy[0] / 2 == pytest.approx(kinetic, rel=0.05)


def test_servo_latency_does_not_matter_to_it(robot: RobotDescription) -> None:
    one, other = make(robot, False, servo_latency=0.0), make(robot, False, servo_latency=0.02)
    for world in (one, other):
        for _ in range(10):
            world.step(world.resting_angles[None] + 0.1)
    np.testing.assert_array_equal(one.truth().motor_angle, other.truth().motor_angle)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"actuator": "constraint", "thermal_protection": True}, "thermal_protection"),
        ({"actuator": "servo"}, "dc, constraint"),
        ({"threads": -1}, "threads is -1; it must be 0"),
    ],
)
def test_invalid_world_configurations_are_rejected(config, message):
    with pytest.raises(SurefootError, match=message):
        WorldConfig(**config)
