from __future__ import annotations

import numpy as np
import pytest

from surefoot.actuator import constraint_speed
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return RobotDescription.load("minitaur")


def make(robot: RobotDescription, rack: bool = True, **values: float) -> SimWorld:
    """One robot with constraint motors, a control step of one servo step, no latency."""
    values = {"control_step": 0.001, "control_latency": 0.0, "servo_latency": 0.0, **values}
    params = PhysicalParams.nominal(robot).with_values(robot, **values)
    return SimWorld(robot, 1, params, config=WorldConfig(actuator="constraint", rack=rack, threads=1))


def test_speed_sought_by_hand() -> None:
    # .02 rad away, turning at 5 rad/s, gains .5 and .1, step 1 ms: 5 + .5 * 20 - .1 * 5.
    assert constraint_speed(1.02, 1.0, 5.0, 0.5, 0.1, 0.001) == pytest.approx(14.5)
    # With both gains 1 the speed of now does not matter: the motor is at its target after one step.
    assert constraint_speed(1.02, 1.0, 5.0, 1.0, 1.0, 0.001) == pytest.approx(20.0)


def test_a_motor_is_at_its_target_one_step_later(robot: RobotDescription) -> None:
    world = make(robot)
    target = world.resting_angles + 2e-5 * np.arange(1, 9)
    for _ in range(5):
        world.step(target[None])
        truth = world.truth()
        assert np.abs(truth.motor_torque).max() < robot.constraint_motor.max_torque
        np.testing.assert_allclose(truth.motor_angle[0], target, atol=1e-6)


def test_torque_has_its_limit_and_strength_scales_it(robot: RobotDescription) -> None:
    for strength in (1.0, 0.5):
        world = make(robot, motor_strength=strength)
        world.step(world.resting_angles[None] + 0.5)
        np.testing.assert_allclose(world.truth().motor_torque, 3.5 * strength, rtol=1e-6)
        world.step(world.resting_angles[None] - 0.5)
        np.testing.assert_allclose(world.truth().motor_torque, -3.5 * strength, rtol=1e-6)


def test_a_standing_robot_does_not_sink(robot: RobotDescription) -> None:
    world = make(robot, rack=False)
    for _ in range(300):
        world.step(world.resting_angles[None])
    truth = world.truth()
    assert np.abs(truth.motor_angle[0] - world.resting_angles).max() < 1e-4
    # Nothing moves, so no work is done, though every motor holds its share of 7.5 kg.
    assert np.abs(truth.motor_torque).min() > 0.3
    assert truth.energy[0] < 1e-6


def test_work_done_on_the_rack_is_the_energy_gained(robot: RobotDescription) -> None:
    # Legs that start to move have the kinetic energy that the motors gave them; over 2 ms gravity adds next to nothing.
    world = make(robot)
    world.step(world.resting_angles[None] + 0.05)
    truth = world.truth()
    data, model = world.engine.datas[0], world.engine.models[0]
    import mujoco

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


def test_thermal_protection_is_of_dc_motors_only() -> None:
    with pytest.raises(SurefootError, match="thermal_protection"):
        WorldConfig(actuator="constraint", thermal_protection=True)


def test_an_unknown_actuator_is_refused() -> None:
    with pytest.raises(SurefootError, match="dc, constraint"):
        WorldConfig(actuator="servo")  # type: ignore[arg-type]
