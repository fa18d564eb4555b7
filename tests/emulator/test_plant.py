"""The simulated body: motion as in a simulation, and sensors, battery and heat worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.deploy.board.signals import MotorCommand
from surefoot.deploy.messages import Mode
from surefoot.emulator.hardware import PowerConfig, SensorConfig, power_tick
from surefoot.emulator.plant import Plant
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.actuation import new_actuation, set_actuation_params
from surefoot.world.ground import Ground
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

DAMPED = MotorCommand(Mode.DISARMED, np.zeros(8))


def ideal(robot, **more) -> Plant:
    return Plant(robot, sensors=SensorConfig.ideal(), power=PowerConfig.ideal(), **more)


def test_a_plant_sits_on_its_ground(robot):
    flat, raised = (ideal(robot, ground=Ground(np.full((4, 4, 2, 2), z), 1.0)) for z in (0.0, 0.3))
    assert raised.capture().position[2] == pytest.approx(flat.capture().position[2] + 0.3, abs=1e-3)
    raised.step(DAMPED)
    assert raised.capture().contact_ticks.sum() > 0


def position(values) -> MotorCommand:
    return MotorCommand(Mode.POSITION, np.asarray(values, float))


def test_motion_and_readings_are_identical_to_a_simulation(robot):
    plant = ideal(robot)
    plant.step(DAMPED)
    # A simulation that continues from the same state, with its servo on.
    world = SimWorld(robot, 1, config=WorldConfig(rest=(0.0, 0.9)))
    world.set_state(plant.world.get_state())
    set_actuation_params(world.actuation, np.arange(1), world.params)
    rng = np.random.default_rng(1)
    target = robot.pose_angles(0.0, 1.5)
    for _ in range(80):
        target = np.clip(target + rng.uniform(-0.05, 0.05, 8), 1.0, 2.2)
        readings = world.step(target)
        order = position(target)
        for _ in range(6):
            plant.step(order)
        seen = plant.read(0.0, 0.0)
        np.testing.assert_array_equal(seen.motor_angle, readings.motor_angle[0])
        np.testing.assert_array_equal(seen.motor_velocity, readings.motor_velocity[0])
        np.testing.assert_array_equal(seen.roll_pitch_yaw, readings.roll_pitch_yaw[0])
        np.testing.assert_array_equal(seen.angular_velocity_base, readings.angular_velocity_base[0])
        np.testing.assert_array_equal(seen.motor_torque, plant.world.actuation.motor_torque[0])
        np.testing.assert_array_equal(plant.capture().position, world.truth().base_position_world[0])


@pytest.mark.parametrize("axis", [0, 1])
def test_nan_in_tilt_or_temperature_is_detected(robot, axis):
    plant = ideal(robot)
    plant.params.imu_bias[0, axis] = np.nan
    plant.temperature[axis] = np.nan
    assert np.isnan([plant.vitals().tilt, plant.vitals().temperature]).all()


def test_it_sits_when_switched_on_and_lies_down_damped(robot):
    plant = ideal(robot)
    swing, extension = robot.to_pose(plant.vitals().motor_angle)
    np.testing.assert_allclose(swing, 0.0, atol=0.05)
    np.testing.assert_allclose(extension, 0.9, atol=0.1)
    for _ in range(1000):
        plant.step(DAMPED)
    # The box of the belly is 0.087 m high.
    assert plant.capture().position[2] == pytest.approx(0.0435, abs=0.002)
    assert np.abs(plant.world.actuation.sample[0, 8:16]).max() < 1.0


@pytest.mark.parametrize("servo_latency", [0.001, 0.005])
def test_damped_motors_come_to_rest_whatever_the_servos_latency(robot, servo_latency):
    params = PhysicalParams.nominal(robot).with_values(robot, servo_latency=servo_latency)
    plant = Plant(robot, params, rack=True)
    for _ in range(800):  # the legs sink until they hang
        plant.step(DAMPED, 10)
    assert np.abs(plant.world.actuation.sample[0, 8:16]).max() < 0.05


def test_readings_have_the_control_latency_at_their_use(robot):
    plant = ideal(robot)
    seen = []
    for step in range(100):
        plant.step(position(robot.pose_angles(0.0, 0.9 + 0.01 * step)))
        seen.append(plant.vitals().motor_angle.copy())
    # 20 ms without a lead, 17 ms for a host that uses the readings in 3 ms, and times between steps.
    np.testing.assert_array_equal(plant.read(0.0, 0.0).motor_angle, seen[-21])
    np.testing.assert_allclose(plant.read(0.0, 0.003).motor_angle, seen[-18], atol=1e-12)
    halfway = (seen[-20] + seen[-21]) / 2
    np.testing.assert_allclose(plant.read(0.0005, 0.0).motor_angle, halfway, atol=1e-9)
    np.testing.assert_array_equal(plant.read(0.0, 1.0).motor_angle, seen[-1])
    plant.extra_latency = 0.010
    np.testing.assert_array_equal(plant.read(0.0, 0.0).motor_angle, seen[-31])


def test_encoders_are_quantized_and_sensors_have_noise_and_bias(robot):
    params = PhysicalParams.nominal(robot).with_values(robot, imu_bias=[[0.02, -0.03]], imu_noise=0.01)
    config = SensorConfig()
    plant = Plant(robot, params, sensors=config, rack=True)
    truth = ideal(robot, rack=True)
    read = [plant.read(0.0, 0.0) for _ in range(4000)]
    angle = read[0].motor_angle
    np.testing.assert_allclose(angle / config.encoder_step, np.round(angle / config.encoder_step), atol=1e-9)
    assert np.abs(angle - truth.read(0.0, 0.0).motor_angle).max() <= config.encoder_step / 2
    speeds = np.array([seen.motor_velocity for seen in read])
    np.testing.assert_allclose(speeds.std(0), config.speed_noise, rtol=0.1)
    tilts = np.array([seen.roll_pitch_yaw for seen in read])
    np.testing.assert_allclose(tilts.mean(0), [0.02, -0.03, 0.0], atol=0.001)
    np.testing.assert_allclose(tilts.std(0), [0.01, 0.01, 0.0], rtol=0.1)
    rates = np.array([seen.angular_velocity_base for seen in read])
    np.testing.assert_allclose(rates.std(0), config.gyro_noise, rtol=0.1)
    bias = rates.mean(0)
    assert 0 < np.abs(bias).max() < 4 * config.gyro_bias
    # The same seed gives the same robot; the true state is not affected.
    again = Plant(robot, params, sensors=config, rack=True)
    np.testing.assert_array_equal(again.read(0.0, 0.0).motor_velocity, read[0].motor_velocity)
    assert not truth.read(0.0, 0.0).angular_velocity_base.any()


def test_torques_have_noise_and_a_constant_error_of_each_motor(robot):
    config, gains = SensorConfig(), []
    plant = Plant(robot, sensors=config, rack=True)
    constant = Plant(robot, sensors=replace(config, torque_noise=0.0), rack=True)
    for each in (plant, constant):
        each.world.actuation.motor_torque[0] = np.linspace(-3.5, 3.5, 8)
    read = np.array([plant.read(0.0, 0.0).motor_torque for _ in range(4000)])
    np.testing.assert_allclose(read.std(0), config.torque_noise, rtol=0.1)
    # The standard error of the mean of 4000 is 0.02 / sqrt(4000) = 0.0003 N m.
    np.testing.assert_allclose(read.mean(0), constant.read(0.0, 0.0).motor_torque, atol=0.0015)
    for seed in range(12):
        plant = Plant(robot, seed=seed, sensors=replace(config, torque_noise=0.0), rack=True)
        for torque in (0.5, -2.0):
            plant.world.actuation.motor_torque[0] = torque
            gains.append(plant.read(0.0, 0.0).motor_torque / torque)
        np.testing.assert_allclose(gains[-1], gains[-2], rtol=1e-12)
    # With 96 motors, the standard error of the standard deviation is 7 %.
    assert np.mean(gains) == pytest.approx(1.0, abs=4 * config.torque_gain / np.sqrt(96))
    assert np.std(gains) == pytest.approx(config.torque_gain, rel=0.2)
    assert len(np.unique(gains[0])) == 8


def test_an_accelerometer_measures_the_specific_force_in_the_base_frame(robot):
    assert ideal(robot).read(0.0, 0.0).accelerometer is None
    # At rest it is gravity, in the frame of an IMU that is mounted with a roll of 0.2 rad.
    leaning = PhysicalParams.nominal(robot).with_values(robot, imu_mount=[[0.2, 0.0, 0.0]])
    plant = ideal(robot, params=leaning, accelerometer=True)
    rest = 9.81 * np.array([0.0, np.sin(0.2), np.cos(0.2)])
    np.testing.assert_allclose(plant.read(0.0, 0.0).accelerometer, rest, atol=0.05)  # at the start
    for _ in range(1500):
        plant.step(DAMPED)
    np.testing.assert_allclose(plant.read(0.0, 0.0).accelerometer, rest, atol=0.01)  # when it has lain down


def test_the_accelerometer_is_the_change_of_the_velocity_and_as_old_as_the_other_readings(robot):
    params = PhysicalParams.nominal(robot).with_values(robot, control_latency=0.02)
    plant = ideal(robot, params=params, accelerometer=True)
    speeds, seen = [], []
    for step in range(60):
        plant.push(np.array([80.0, 0.0, 120.0]) * (step >= 30))
        plant.step(DAMPED)
        speeds.append(plant.world.truth().base_velocity_world[0].copy())
        seen.append((plant.read(0.0, 0.0).accelerometer, plant.read(0.0, 0.005).accelerometer))
    force = np.diff(speeds, axis=0) * 1000.0 + [0.0, 0.0, 9.81]
    assert np.linalg.norm(force[40] - force[20]) > 10.0
    old, younger = np.swapaxes(seen, 0, 1)
    # It is turned with the base, which hardly turns here.
    np.testing.assert_allclose(old[21:], force[:-20], atol=0.5)
    np.testing.assert_array_equal(younger[21:45], old[26:50])


def test_the_noise_of_the_accelerometer_changes_no_other_reading(robot):
    plant, without = (Plant(robot, rack=True, accelerometer=one) for one in (True, False))
    read, noise = [plant.read(0.0, 0.0) for _ in range(4000)], SensorConfig().accelerometer_noise
    force = np.array([seen.accelerometer for seen in read])
    np.testing.assert_allclose(force.std(0), noise, rtol=0.1)
    np.testing.assert_allclose(force.mean(0), [0.0, 0.0, 9.81], atol=5 * noise / np.sqrt(4000))
    for name, value in vars(without.read(0.0, 0.0)).items():
        assert name == "accelerometer" or np.array_equal(getattr(read[0], name), value), name


def test_the_error_of_torques_changes_no_other_reading(robot):
    exact = replace(SensorConfig(), torque_noise=0.0, torque_gain=0.0)
    plant, truth = Plant(robot, seed=3), Plant(robot, seed=3, sensors=exact)
    for step in range(200):
        order = position(robot.pose_angles(0.0, 0.9 + 0.004 * step))
        plant.step(order)
        truth.step(order)
        read, true = vars(plant.read(0.0, 0.0)), vars(truth.read(0.0, 0.0))
        for name in read:
            assert np.array_equal(read[name], true[name]) == (name != "motor_torque"), name
        np.testing.assert_array_equal(true["motor_torque"], truth.world.actuation.motor_torque[0])
    np.testing.assert_array_equal(plant.capture().position, truth.capture().position)


def test_a_motor_with_a_duty_turns_like_a_dc_motor(robot):
    plant = ideal(robot, rack=True)
    duty = np.zeros(8)
    duty[0] = 0.05
    plant.step(MotorCommand(Mode.PWM, duty))
    # At rest: I = duty V / R = 0.05 * 16 / 0.186 = 4.30 A, and the table has 0.1 N m/A.
    torque = plant.world.actuation.motor_torque[0]
    speed = plant.world.actuation.sample[0, 8:16]
    assert torque[0] == pytest.approx(0.05 * 16 / 0.186 * 0.1, rel=0.02)
    assert np.abs(torque[1:]).max() < 0.02
    assert speed[0] > 0
    plant.step(position(plant.vitals().motor_angle))
    assert not plant.world.actuation.duty.any()


def test_viscous_friction_slows_a_motor_that_a_duty_turns(robot):
    # Only one motor has friction: its shaft gets b qdot less than the motor's torque.
    params = PhysicalParams.nominal(robot).with_values(robot, motor_viscous_friction=[0.1] + [0.0] * 7)
    plant, free = ideal(robot, rack=True, params=params), ideal(robot, rack=True)
    duty = np.zeros(8)
    duty[0] = 0.05
    for _ in range(20):
        speed = plant.world.actuation.sample[0, 8:16].copy()
        for each in (plant, free):
            each.step(MotorCommand(Mode.PWM, duty))
    actuation = plant.world.actuation
    assert 0.1 < actuation.sample[0, 8] < 0.8 * free.world.actuation.sample[0, 8]
    np.testing.assert_allclose(actuation.motor_torque[0, 0] - actuation.torque[0, 0], 0.1 * speed[0], rtol=1e-9)
    np.testing.assert_array_equal(actuation.motor_torque[0, 1:], actuation.torque[0, 1:])


def test_a_duty_is_part_of_the_world_state_and_cleared_by_a_reset(robot):
    plant, other = ideal(robot, rack=True), ideal(robot, rack=True)
    turning = MotorCommand(Mode.PWM, np.full(8, 0.03))
    plant.step(turning)
    other.world.set_state(plant.world.get_state())
    for world in (plant.world, other.world):
        world.engine.advance(np.array([20]))
    np.testing.assert_array_equal(plant.vitals().motor_angle, other.vitals().motor_angle)
    plant.world.reset()
    assert not plant.world.actuation.duty.any()


def test_battery_and_heat_agree_with_a_calculation_by_hand(robot):
    temperature = np.array([25.0, 65.0])
    # 1.45 N m is 15 A of the nominal motor; with half the strength 0.725 N m is. Speed 10 rad/s, K_t 0.1, R 0.2.
    actuation = new_actuation(robot, 1, 1, WorldConfig())._replace(
        motor_torque=np.array([[0.725, -0.5]]),
        sample=np.array([[0.0, 0.0, 10.0, 0.0]]),
        strength=np.array([[0.5, 0.5]]),
        table_current=np.array([0.0, 10.0, 20.0]),
        table_torque=np.array([0.0, 1.0, 1.9]),
        torque_constant=np.array([0.1]),
        resistance=np.array([0.2]),
        voltage=np.array([16.0]),
    )
    power = PowerConfig(ambient=25.0, heat_capacity=80.0, heat_resistance=2.0)
    current = power_tick(actuation, power, 0.001, temperature)
    # Motor 1: R I^2 = 45 W and K_t w I = 15 W. Motor 2 is at rest: -10 A, 20 W of heat. 80 W from 16 V.
    assert current == pytest.approx(5.0)
    # 45 W into 80 J/K; 20 W in and (65 - 25) / 2 W out.
    np.testing.assert_allclose(temperature, [25.0 + 45 / 80 * 0.001, 65.0])


def test_heat_of_joint_actuators_agrees_with_a_calculation_by_hand():
    go2, temperature = RobotDescription.load("go2"), np.array([25.0, 65.0])
    actuation = new_actuation(go2, 1, 1, WorldConfig())
    assert actuation.joint[0]
    actuation = actuation._replace(
        motor_torque=np.array([[10.0, -10.0]]),
        sample=np.array([[0.0, 0.0, 4.0, 4.0]]),
        max_torque=np.array([[20.0, 20.0]]),
        joint_limits=np.array([[30.0, 30.0]]),
        voltage=np.array([20.0]),
    )
    power = PowerConfig(ambient=25.0, heat_capacity=80.0, heat_resistance=2.0)
    current = power_tick(actuation, power, 0.001, temperature)
    # At full torque half of 20 N m times 30 rad/s is heat, 300 W; at half torque a quarter of that. Motor 1 does 40 W
    # of work and motor 2 is driven by as much: 150 W in all, from 20 V.
    assert current == pytest.approx(7.5)
    np.testing.assert_allclose(temperature, [25.0 + 75 / 80 * 0.001, 65.0 + 55 / 80 * 0.001])


def test_the_battery_sags_under_load_and_empties(robot):
    plant = Plant(robot, power=PowerConfig(battery_capacity=100.0))
    assert plant.voltage == 16.0
    for step in range(1000):
        plant.step(position(robot.pose_angles(0.0, min(0.9 + 0.002 * step, 2.0))))
    used = plant._used
    assert used > 0.5
    rested = 16.0 - plant.power.battery_drop * used / 100.0
    assert rested - 1.0 < plant.voltage < rested
    assert plant.temperature.max() > 25.0
    plant.voltage_drop = 2.0
    plant.step(DAMPED)
    plant.step(DAMPED)
    assert plant.voltage == pytest.approx(rested - 2.0, abs=0.3)


def test_a_slow_servo_holds_its_duty_between_two_steps(robot):
    target = position(robot.pose_angles(0.0, 1.2))
    slow, one = ideal(robot, rack=True, servo_every=5), ideal(robot, rack=True)
    duties = []
    for _ in range(50):
        slow.step(target)
        duties.append(slow.world.actuation.duty[0].copy())
        one.step(target)
    rows = np.array(duties).reshape(10, 5, 8)
    np.testing.assert_array_equal(rows, np.repeat(rows[:, :1], 5, axis=1))
    # kp (q_target - q) at rest, before anything moved.
    np.testing.assert_allclose(rows[0, 0], np.clip(target.values - ideal(robot, rack=True).vitals().motor_angle, -1, 1))
    assert not np.array_equal(slow.vitals().motor_angle, one.vitals().motor_angle)


def test_feet_on_the_ground_are_counted(robot):
    plant = ideal(robot)
    for step in range(2000):
        plant.step(position(robot.pose_angles(0.0, min(0.9 + 0.001 * step, 2.0))))
    before = plant.capture().contact_ticks
    for _ in range(50):
        plant.step(position(robot.pose_angles(0.0, 2.0)))
    np.testing.assert_array_equal(plant.capture().contact_ticks - before, 50.0)
    assert plant.capture().position[2] > 0.2
