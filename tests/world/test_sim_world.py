"""`SimWorld` with MuJoCo: effects of parameters, readings, clocks, resets, energy and heat."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.rotations import quat_matrix
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

WEIGHT = 7.473 * 9.81


def stand(world: SimWorld, steps: int = 150) -> None:
    for _ in range(steps):
        world.step(world.resting_angles)


# --- standing ---------------------------------------------------------------------------------------------


def test_standing_height_is_the_geometric_height_minus_the_penetration(make_world, robot):
    world = make_world()
    stand(world)
    truth = world.truth()
    feet = robot.leg_geometry.foot_in_plane(truth.motor_angle[0, robot.leg_motor_index])
    # Motor axes are 0.0185 m below the base's origin; F / K = 73.3 N / 4 / 3000 N/m = 6.1 mm.
    expected = 0.0185 - feet[:, 1].mean() - WEIGHT / 4 / 3000
    assert truth.base_position_world[0, 2] == pytest.approx(expected, abs=0.003)
    assert np.all(truth.foot_contact == 1.0)


def test_standing_feet_do_not_creep(make_world):
    world = make_world()
    stand(world, 300)
    before = world.foot_positions()
    stand(world, 200)
    np.testing.assert_allclose(world.foot_positions(), before, atol=2e-4)


def test_legs_stay_closed_while_the_robot_trots(make_world, trot, robot):
    world = make_world()
    bars, pair, worst = robot.five_bar, robot.leg_motor_index, 0.0
    axes = np.array([[0.2375 * (1 if "front" in name else -1), -0.0185] for name in robot.leg_names])
    for k in range(150):
        world.step(trot(k))
        truth = world.truth()
        theta = truth.motor_angle[0, pair]
        _, knee = bars.knees(theta)
        centre = knee + (bars.foot_in_plane(theta) - knee) * (1 - bars.foot_radius / bars.foot)
        in_base = (world.foot_positions()[0] - truth.base_position_world[0]) @ quat_matrix(truth.base_quat_world[0])
        worst = max(worst, float(np.abs(in_base[:, [0, 2]] - axes - centre).max()))
    assert worst < 1e-3


def test_foot_positions_are_current(make_world, trot):
    world = make_world()
    start = world.foot_positions()
    for k in range(60):
        world.step(trot(k))
    before = world.foot_positions()
    mujoco.mj_kinematics(world.engine.models[0], world.engine.datas[0])
    np.testing.assert_allclose(before, world.foot_positions(), atol=1e-9)
    world.reset()
    np.testing.assert_allclose(world.foot_positions(), start, atol=1e-9)


# --- parameters -------------------------------------------------------------------------------------------


def test_viscous_friction_slows_each_leg_with_its_time_constant(make_world, robot):
    # Both motors of a leg turn the same way, so that it swings as one body about their axis with J = 0.00468 kg m^2.
    # Without gravity and torque, its speed decays as exp(-2 b t / J), by 2 b dt / J per step: for b = 0.1 to 1 / e in
    # 23.4 ms.
    leg_friction = np.array([0.0, 0.02, 0.05, 0.1])
    friction = np.empty(8)
    friction[robot.leg_motor_index] = leg_friction[:, None]
    world = make_world(
        config={"rack": True, "threads": 1}, control_step=0.001, motor_strength=0.0, motor_viscous_friction=friction
    )
    model, data = world.engine.models[0], world.engine.datas[0]
    model.opt.gravity[:] = 0.0
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    dofs = [[model.joint(name).dofadr[0] for name in leg.motors] for leg in robot.legs]
    inertia = np.array([mass[np.ix_(pair, pair)].sum() for pair in dofs])
    data.qvel[np.ravel(dofs)] = 2.0
    world.engine.observe(np.array([0]))
    steps = 20
    for _ in range(steps):
        world.step(world.resting_angles)
    speed = (world.truth().motor_velocity[0] * robot.motor_sign)[robot.leg_motor_index].mean(axis=1)
    np.testing.assert_allclose(inertia, 0.00468, rtol=1e-3)
    np.testing.assert_allclose(speed, 2.0 * (1 - 2 * leg_friction * 0.001 / inertia) ** steps, rtol=2e-3)
    np.testing.assert_allclose(speed, 2.0 * np.exp(-0.020 / np.array([np.inf, 0.117, 0.0468, 0.0234])), rtol=0.03)


def test_motors_may_have_different_viscous_friction(make_world, trot):
    # The shaft torque is the motor torque minus b times the speed at the start of the servo step.
    friction = 0.01 * np.arange(8)
    world = make_world(config={"rack": True}, control_step=0.001, motor_viscous_friction=friction)
    for k in range(60):
        speed = world.truth().motor_velocity[0]
        world.step(trot(k))
        lost = world.actuation.motor_torque[0] - world.actuation.torque[0]
        np.testing.assert_allclose(lost, friction * speed, rtol=1e-9, atol=1e-12)
    assert np.abs(lost[1:]).min() > 1e-3


def test_maximum_viscous_friction_is_stable_for_the_lightest_legs(make_world, robot):
    # Folded, with a fifth of the mass, a motor drives 0.00013 kg m^2: 0.1 N m s/rad removes 3/4 of its speed per step.
    greatest = robot.allowed["motor_viscous_friction"][1]
    light = {"leg_mass_ratio": 0.2, "leg_inertia_ratio": 0.2, "control_step": 0.001, "motor_strength": 0.0}
    config = {"rack": True, "threads": 1, "rest": (0.0, 0.7)}
    world = make_world(config=config, motor_viscous_friction=greatest, **light)
    world.engine.models[0].opt.gravity[:] = 0.0
    for joint in robot.motor_names:
        world.engine.datas[0].qvel[world.engine.models[0].joint(joint).dofadr[0]] = 5.0
    world.engine.observe(np.array([0]))
    before = np.abs(world.truth().motor_velocity[0]).max()
    for _ in range(100):
        world.step(world.resting_angles)
        now = np.abs(world.truth().motor_velocity[0]).max()
        # The remaining motion is the settling of the loops without gravity.
        assert now < max(before, 1e-3)
        before = now
    assert before < 1e-3


def test_params_out_of_bounds_are_rejected(robot):
    params = PhysicalParams.nominal(robot, 1)
    params.voltage[0] = 100.0
    with pytest.raises(SurefootError, match=r"voltage is 100; minitaur allows 5 to 30"):
        SimWorld(robot, 1, params)


@pytest.mark.parametrize(
    ("num_envs", "message"),
    [(3, "params are for 2 robots; the world has 3"), (0, "num_envs is 0; a world needs 1 robot")],
)
def test_a_wrong_number_of_robots_is_rejected(robot, num_envs, message):
    with pytest.raises(SurefootError, match=message):
        SimWorld(robot, num_envs, PhysicalParams.nominal(robot, 2))


# --- readings ---------------------------------------------------------------------------------------------


def test_bias_is_added_exactly_to_roll_and_pitch(make_world, trot):
    world = make_world(2, imu_bias=[[0.0, 0.0], [0.03, -0.02]])
    for k in range(20):
        angles = world.step(trot(k)).roll_pitch_yaw
        np.testing.assert_allclose(angles[1] - angles[0], (0.03, -0.02, 0.0), atol=1e-15)
    assert np.array_equal(*world.truth().motor_angle)


def test_noise_has_its_standard_deviation(make_world):
    noisy, clean = make_world(32, imu_noise=0.05), make_world(1)
    errors = []
    for _ in range(300):
        target = clean.resting_angles
        errors.append(noisy.step(target).roll_pitch_yaw - clean.step(target).roll_pitch_yaw)
    errors = np.array(errors)
    assert np.all(errors[..., 2] == 0.0)
    tilt = errors[..., :2]
    assert tilt.std() == pytest.approx(0.05, rel=0.03)
    assert abs(tilt.mean()) < 0.002
    # White: from step to step, from robot to robot and from roll to pitch.
    assert abs(np.mean(tilt[1:] * tilt[:-1])) < 0.05 * 0.05**2
    assert abs(np.mean(tilt[:, 1:] * tilt[:, :-1])) < 0.05 * 0.05**2
    assert abs(np.mean(tilt[..., 0] * tilt[..., 1])) < 0.05 * 0.05**2


def test_readings_are_as_old_as_the_control_latency(make_world, trot):
    # A control step of one servo step, so that the true state of every servo step is available.
    world = make_world(3, control_step=0.001, control_latency=[0.0, 0.020, 0.0025])
    angle, tilt = [world.truth().motor_angle], [world.truth().roll_pitch_yaw]
    for k in range(100):
        readings = world.step(trot(k // 6))
        angle.append(world.truth().motor_angle)
        tilt.append(world.truth().roll_pitch_yaw)
        old = max(0, len(angle) - 21)
        assert np.array_equal(readings.motor_angle[0], angle[-1][0])
        np.testing.assert_allclose(readings.motor_angle[1], angle[old][1], atol=1e-12)
        np.testing.assert_allclose(readings.roll_pitch_yaw[1], tilt[old][1], atol=1e-12)
        if k >= 3:
            between = (angle[-3][2] + angle[-4][2]) / 2
            np.testing.assert_allclose(readings.motor_angle[2], between, atol=1e-12)


def test_torques_are_as_old_as_the_other_readings(make_world, trot):
    latency = [0.0, 0.020, 0.0025]
    world = make_world(3, config={"torque_readings": True}, control_step=0.001, control_latency=latency)
    standing = world.readings().motor_torque[0]
    np.testing.assert_array_equal(world.readings().motor_torque, [standing] * 3)
    assert np.abs(standing).min() > 0.05  # the motors carry the robot
    torque = [np.array([standing] * 3)]
    for k in range(100):
        readings = world.step(trot(k // 6))
        torque.append(world.truth().motor_torque)
        assert np.array_equal(readings.motor_torque[0], torque[-1][0])
        np.testing.assert_allclose(readings.motor_torque[1], torque[max(0, len(torque) - 21)][1], atol=1e-12)
        if k >= 3:
            between = (torque[-3][2] + torque[-4][2]) / 2
            np.testing.assert_allclose(readings.motor_torque[2], between, atol=1e-12)


def test_torque_readings_change_nothing_else(make_world, trot, engine):
    without, measuring = make_world(2, engine=engine), make_world(2, engine=engine, config={"torque_readings": True})
    for k in range(30):
        one, other = without.step(trot(k)), measuring.step(trot(k))
        assert one.motor_torque is None
        assert other.motor_torque is not None
        for name in ("time", "roll_pitch_yaw", "angular_velocity_base", "motor_angle", "motor_velocity"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert "torque_history" not in without.get_state()["actuation"]


def test_a_state_from_before_a_parameter_was_added_can_be_restored(make_world, trot, assert_same):
    world, other = make_world(2), make_world(2)
    for k in range(10):
        world.step(trot(k))
    state = world.get_state()
    for part in ("params", "actuation"):
        del state[part]["voltage_clip"]
    state["actuation"]["constants"] = np.zeros(4)  # as earlier versions had it
    other.set_state(state)
    for k in range(10, 20):
        assert_same(world.step(trot(k)), other.step(trot(k)))


def test_a_restored_state_has_its_torques(make_world, trot):
    world = make_world(2, config={"torque_readings": True})
    for k in range(10):
        world.step(trot(k))
    state, torque = world.get_state(), world.readings().motor_torque
    for k in range(10):
        world.step(trot(k))
    assert (world.readings().motor_torque != torque).any()
    world.set_state(state)
    np.testing.assert_array_equal(world.readings().motor_torque, torque)


def test_reading_twice_reads_the_same(make_world, trot, assert_same):
    world = make_world(2, imu_noise=0.05)
    assert_same(world.step(trot(0)), world.readings())


def test_truth_may_be_modified_by_the_caller(make_world, trot, assert_same):
    world, other = make_world(), make_world()
    for value in vars(world.truth()).values():
        if value is not None:
            value[...] = 0
    assert_same(world.truth(), other.truth())
    assert_same(world.step(trot(10)), other.step(trot(10)))
    assert_same(world.truth(), other.truth())


def test_a_kept_truth_does_not_change_with_later_steps(make_world, trot):
    world = make_world()
    kept = world.truth()
    before = {name: value.copy() for name, value in vars(kept).items()}
    world.step(trot(10))
    for name, value in vars(kept).items():
        assert np.array_equal(value, before[name]), name


# --- clocks -----------------------------------------------------------------------------------------------


def test_each_robot_has_its_own_clock(make_world, trot):
    periods = np.array([0.003, 0.020, 0.0045])
    world = make_world(3, control_step=periods)
    for k in range(1, 41):
        time = world.step(trot(k)).time
        # Control steps end at the nearest servo step, without drift.
        np.testing.assert_allclose(time, k * periods, atol=0.0005 + 1e-12)
    np.testing.assert_allclose(time, [0.120, 0.800, 0.180])


# --- one robot and many -----------------------------------------------------------------------------------


def test_the_number_of_threads_does_not_matter(make_world, trot, assert_same, varied):
    worlds = [make_world(40, config={"threads": threads}, **varied(40)) for threads in (1, 2, 5)]
    for k in range(20):
        one, *others = [world.step(trot(k)) for world in worlds]
        for other in others:
            assert_same(one, other)


def test_initial_speeds_are_within_their_bounds(make_world):
    world = make_world(40, config={"start_linear_speed": 0.05})
    speeds = world.truth().base_velocity_world
    assert np.abs(speeds).max() <= 0.05
    assert np.abs(speeds).max() > 0.04
    assert abs(speeds.mean()) < 0.015


# --- reset ------------------------------------------------------------------------------------------------


def test_a_reset_restores_the_start(make_world, trot, assert_same):
    world = make_world(2)
    first = world.readings()
    truth = world.truth()
    for k in range(20):
        world.step(trot(k))
    assert_same(world.reset(), first)
    assert_same(world.truth(), truth)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_target_that_is_not_finite_resets_only_that_robot(make_world, trot, assert_same, bad):
    world, other = make_world(3), make_world(3)
    for k in range(10):
        world.step(trot(k))
        other.step(trot(k))
    target = np.tile(trot(10), (3, 1))
    other.step(target)
    target[1, 4] = bad
    readings = world.step(target)
    assert world.divergences == 1
    assert world.truth().diverged.tolist() == [False, True, False]
    assert readings.time[1] == 0.0
    assert np.isfinite(readings.motor_angle).all()
    for k in range(10):
        assert_same(world.step(trot(k)), other.step(trot(k)), [0, 2], [0, 2])
    assert world.divergences == 1
    assert not world.truth().diverged.any()


def test_a_restored_state_repeats_noise_over_many_blocks(make_world, assert_same):
    world = make_world(2, imu_noise=0.05, control_step=0.001)
    stand(world, 200)
    state = world.get_state()
    stand(world, 200)
    first = world.readings()
    world.set_state(state)
    stand(world, 200)
    assert_same(world.readings(), first)


@pytest.mark.parametrize(
    ("values", "rule"), [({"knee_friction": 0.01}, "world mujoco does not model"), ({}, "imu_noise is 9")]
)
def test_rejected_parameters_do_not_change_any_robot(make_world, values, rule):
    world = make_world(2)
    new_params = world.params.rows([0]).with_values(world.robot, voltage=14.0, **values)
    if not values:
        new_params.imu_noise[0] = 9.0
    with pytest.raises(SurefootError, match=rule):
        world.set_params([1], new_params)
    assert world.params.voltage.tolist() == world.actuation.voltage.tolist() == [16.0, 16.0]


# --- energy and heat --------------------------------------------------------------------------------------


def test_energy_integrates_torque_times_speed_at_servo_rate(make_world, trot):
    world = make_world(1, control_step=0.001)
    total = 0.0
    for k in range(50):
        speed = world.truth().motor_velocity
        world.step(trot(k // 6))
        truth = world.truth()
        np.testing.assert_allclose(truth.energy, 0.001 * abs(np.sum(truth.motor_torque * speed)), rtol=1e-12)
        total += truth.energy[0]
    assert total > 0


def test_energy_of_a_control_step_sums_its_servo_steps(make_world, trot):
    fine, coarse = make_world(1, control_step=0.001), make_world(1, control_step=0.006)
    for k in range(10):
        coarse.step(trot(k))
        total = 0.0
        for _ in range(6):
            fine.step(trot(k))
            total += fine.truth().energy[0]
        assert coarse.truth().energy[0] == pytest.approx(total, rel=1e-12)


def test_a_control_step_need_not_be_a_multiple_of_the_servo_step():
    go2 = RobotDescription.load("go2")
    sums = []
    for ratio in (1.0, 0.5):
        params = PhysicalParams.nominal(go2).with_values(go2, control_step=ratio * go2.timing.servo_step)
        world, energy = SimWorld(go2, 1, params), 0.0
        for k in range(round(200 / ratio)):
            world.step(world.resting_angles + 0.2 * np.sin(0.1 * np.floor(k * ratio)))
            energy += float(world.truth().energy[0])
        sums.append(energy)
    assert sums[1] == pytest.approx(sums[0], rel=0.02)
    params = PhysicalParams.nominal(go2).with_values(go2, control_step=1.5 * go2.timing.servo_step)
    world = SimWorld(go2, 1, params)
    stand(world, 200)
    for _ in range(4):
        world.step(world.resting_angles)
        assert np.all(world.truth().foot_contact == 1.0)


def test_heat_integrates_currents_at_servo_rate(make_world, trot):
    # Up to 20 A, the torque table is increasing, so that the current follows from the torque; R = 0.186 Ohm.
    world = make_world(1, control_step=0.001, motor_strength=0.5)
    table = world.robot.torque_table
    for k in range(50):
        world.step(trot(k // 6))
        truth = world.truth()
        current = np.interp(np.abs(truth.motor_torque) / 0.5, table[1], table[0])
        below = current < table[0][-1] - 1e-9
        assert below.any()
        np.testing.assert_allclose(truth.heat[below], 0.001 * 0.186 * current[below] ** 2, rtol=1e-9)


def test_heat_of_a_joint_actuator_grows_with_the_square_of_its_torque():
    # Pupper's actuators have 1.1 N m up to 10 rad/s; half of this power of 11 W is heat at full torque.
    robot = RobotDescription.load("pupper_v2")
    world = SimWorld(robot, 1, PhysicalParams.nominal(robot, 1).with_values(robot, control_step=0.001))
    world.step(np.zeros((1, 12)))
    truth = world.truth()
    assert (truth.motor_torque != 0.0).any()
    np.testing.assert_allclose(truth.heat, 0.001 * 5.5 * (truth.motor_torque / 1.1) ** 2, rtol=1e-12)


def test_heat_of_a_control_step_sums_its_servo_steps(make_world, trot):
    fine, coarse = make_world(1, control_step=0.001), make_world(1, control_step=0.006)
    for k in range(10):
        coarse.step(trot(k))
        total = 0.0
        for _ in range(6):
            fine.step(trot(k))
            total = total + fine.truth().heat
        np.testing.assert_allclose(coarse.truth().heat, total, rtol=1e-12)


@pytest.mark.parametrize("protected", [True, False])
def test_thermal_protection_switches_off(make_world, protected):
    world = make_world(1, config={"thermal_protection": protected})
    world.push([[0.0, 0.0, -300.0]])  # more than the motors can support
    hot = []
    for _ in range(200):
        world.step(world.resting_angles)
        hot.append(np.abs(world.truth().motor_torque).max())
    assert hot[150] > 2.45
    assert (hot[-1] < 2.45) == protected
    world.push([[0.0, 0.0, 0.0]])
    world.reset()
    stand(world, 10)
    assert np.all(world.truth().motor_torque != 0)


def test_a_world_keeps_its_config(robot):
    world = SimWorld(robot, 1, config=WorldConfig(rest=(0.1, 1.8)))
    np.testing.assert_allclose(world.resting_angles, robot.pose_angles([0.1] * 4, [1.8] * 4))
