"""Parameters of individual robots: encoder offsets, shifted centres of mass, foot shear and sticking actuators."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.actuator.motor import presliding_kernel
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.actuation import compute_torque, new_actuation, record_sample, set_actuation_params
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

ENGINES = ("mujoco", "bullet")


@pytest.fixture(scope="module")
def pupper() -> RobotDescription:
    return RobotDescription.load("pupper_v2")


def world(robot: RobotDescription, engine: str, rack: bool = False, **values: object) -> SimWorld:
    if engine == "bullet":
        pytest.importorskip("pybullet")
    params = PhysicalParams.nominal(robot).with_values(robot, **values)
    return SimWorld(robot, 1, params, config=WorldConfig(rack=rack, threads=1), engine=engine)


@pytest.mark.parametrize("engine", ENGINES)
def test_an_encoder_offset_moves_the_joint_and_not_its_reading(pupper: RobotDescription, engine: str):
    offset = np.zeros((1, 12))
    offset[0, 4] = 0.1
    straight, off = (world(pupper, engine, True, motor_friction=0.0, motor_offset=o) for o in (0 * offset, offset))
    for one in (straight, off):
        for _ in range(100):
            one.step(pupper.resting_angles)
    turned = off.truth().motor_angle[0] - straight.truth().motor_angle[0]
    assert turned[4] == pytest.approx(-0.1, abs=0.01)
    assert np.abs(off.readings().motor_angle[0] - straight.readings().motor_angle[0]).max() < 0.01


@pytest.mark.parametrize("engine", ENGINES)
def test_a_centre_of_mass_to_the_left_loads_the_left_legs(pupper: RobotDescription, engine: str):
    rolls, places = [], []
    for side in (0.0, 0.02):
        one = world(pupper, engine, base_offset=[[0.0, side, 0.0]])
        places.append(one.truth().base_position_world[0])
        for _ in range(60):
            one.step(pupper.resting_angles)
        rolls.append(one.truth().roll_pitch_yaw[0, 0])
    # The base link starts at the same place, is heavier on the left, and rolls to the left.
    np.testing.assert_allclose(places[0], places[1], atol=1e-9)
    assert rolls[1] < rolls[0] - 0.003
    # Moment of 0.02 m times the base's weight on the springs of feet (0.17 m apart) and legs: some 0.01 rad.
    assert rolls[1] > rolls[0] - 0.1


def test_the_engines_agree_on_a_shifted_centre_of_mass(pupper: RobotDescription):
    rolls = []
    for engine in ENGINES:
        one = world(pupper, engine, base_offset=[[0.01, 0.02, 0.0]])
        for _ in range(60):
            one.step(pupper.resting_angles)
        rolls.append(one.truth().roll_pitch_yaw[0, :2])
    np.testing.assert_allclose(rolls[0], rolls[1], atol=0.004)


def test_a_state_of_a_shifted_robot_is_restored_exactly(pupper: RobotDescription):
    one = world(pupper, "bullet", base_offset=[[0.01, 0.0, 0.0]])
    one.step(pupper.resting_angles)
    state = one.get_state()
    first = [one.step(pupper.resting_angles + 0.05).motor_angle for _ in range(5)]
    one.set_state(state)
    again = [one.step(pupper.resting_angles + 0.05).motor_angle for _ in range(5)]
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("engine", ENGINES)
def test_feet_yield_along_the_ground_by_their_shear_stiffness(pupper: RobotDescription, engine: str):
    one = world(pupper, engine, contact_shear_ratio=0.1)
    for _ in range(100):
        one.step(pupper.resting_angles)
    before = one.foot_positions()
    one.push([[2.0, -1.0, 0.0]])
    for _ in range(100):
        one.step(pupper.resting_angles)
    moved = (one.foot_positions() - before)[0].mean(axis=0)
    # Four feet of 1600 N/m, a tenth of it along the ground: 2 N move them by 2 / (4 x 160) m.
    np.testing.assert_allclose(moved[:2], [0.003125, -0.0015625], rtol=0.1)


def test_bullets_own_friction_is_rigid(pupper: RobotDescription):
    feet = []
    for force in (0.0, 2.0):
        one = world(pupper, "bullet")
        one.push([[force, 0.0, 0.0]])
        for _ in range(50):
            one.step(pupper.resting_angles)
        feet.append(one.foot_positions()[0, :, 0].mean())
    assert abs(feet[1] - feet[0]) < 0.001


def test_soft_soles_in_bullet_slide_at_the_limit_of_friction(pupper: RobotDescription):
    # 2.1 kg with a coefficient of 0.2 hold 4.1 N: 3 N are held, 6 N are not.
    moved = []
    for force in (3.0, 6.0):
        one = world(pupper, "bullet", contact_shear_ratio=0.5, contact_friction=0.2)
        one.push([[force, 0.0, 0.0]])
        for _ in range(50):
            one.step(pupper.resting_angles)
        moved.append(one.truth().base_position_world[0, 0])
    assert moved[0] < 0.03
    assert moved[1] > 0.1


@pytest.mark.parametrize("ratio", [0.1, 1.0])
def test_a_state_of_a_robot_on_soft_soles_is_restored_exactly(pupper: RobotDescription, ratio: float):
    one = world(pupper, "bullet", contact_shear_ratio=ratio)
    for k in range(10):
        one.step(pupper.resting_angles + 0.01 * k)
    state = one.get_state()
    first = [one.step(pupper.resting_angles + 0.05).motor_angle for _ in range(5)]
    one.set_state(state)
    again = [one.step(pupper.resting_angles + 0.05).motor_angle for _ in range(5)]
    np.testing.assert_array_equal(first, again)


def test_a_sticking_actuator_holds_a_load_below_its_friction(pupper: RobotDescription):
    # Without gains, gravity turns a hip whose leg is held out; friction above its moment holds it.
    drifts = []
    for angle in (0.0, 0.005):
        values = {"servo_kp": 0.0, "servo_kd": 0.0, "motor_friction": 0.3, "load_friction": 0.0, "presliding": angle}
        one = world(pupper, "mujoco", True, **values)
        start = one.truth().motor_angle[0].copy()
        for _ in range(100):
            one.step(pupper.resting_angles)
        drifts.append(np.abs(one.truth().motor_angle[0] - start).max())
    assert drifts[0] > 0.02
    assert drifts[1] < 0.005


@pytest.mark.parametrize("lag", [0.0, 0.01])
def test_torques_lag_behind_the_servos(pupper: RobotDescription, lag: float):
    values = {"servo_kp": 1.0, "servo_kd": 0.0, "motor_strength": 1.0, "servo_latency": 0.0, "torque_lag": lag}
    params = PhysicalParams.nominal(pupper, 1).with_values(pupper, **values)
    state = new_actuation(pupper, 1, 100, WorldConfig())
    set_actuation_params(state, np.arange(1), params)
    state.target[:] = 0.3
    state.ticks[:] = -1
    torques = []
    for _ in range(4):
        state.ticks[:] += 1
        record_sample(state, 0)
        compute_torque(state, 0)
        torques.append(state.motor_torque[0].copy())
    share = pupper.timing.servo_step / (lag + pupper.timing.servo_step)
    expected = 0.3 * (1.0 - (1.0 - share) ** np.arange(1, 5))
    np.testing.assert_allclose(torques, np.repeat(expected[:, None], 12, axis=1), rtol=1e-12)


@pytest.mark.parametrize(("stretch", "cut"), [(0.02, 0.01), (-0.02, -0.01), (0.004, 0.004)])
def test_presliding_friction_slides_at_its_maximum_deflection(stretch: float, cut: float):
    assert presliding_kernel(stretch, 0.01) == cut
