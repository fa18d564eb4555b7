"""Properties of `SimWorld` with every engine: independent robots, exact states, divergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.ground import FLAT, Ground
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld
from surefoot.world.terrain import make_terrain

ROUGH = Ground.from_points(np.random.default_rng(2).uniform(-0.02, 0.02, (30, 30)), 0.1)
START = {"start_linear_speed": 0.05, "start_angular_speed": 0.1}


@pytest.mark.parametrize("place", [0, 3])
def test_a_robot_moves_the_same_in_any_batch(make_world, trot, assert_same, varied, engine, place):
    num_envs = 64 if engine == "mujoco" else 4
    values = varied(num_envs, bullet=engine != "mujoco")
    if place:
        values["imu_noise"][:] = 0.0  # its random stream depends on the index
    crowd = make_world(num_envs, config={"threads": 2}, engine=engine, **values)
    single = make_world(1, engine=engine, **{name: value[place : place + 1] for name, value in values.items()})
    for k in range(40):
        assert_same(crowd.step(trot(k)), single.step(trot(k)), slice(place, place + 1))
    assert_same(crowd.truth(), single.truth(), slice(place, place + 1))


def test_the_same_seed_gives_the_same_world(make_world, trot, assert_same, engine):
    paths = []
    for seed in (4, 4, 5):
        world = make_world(2, seed=seed, config=START, engine=engine, imu_noise=0.05)
        path = [world.step(trot(k)) for k in range(20)]
        paths.append([*path, world.reset(), *(world.step(trot(k)) for k in range(10)), world.truth()])
    one, same, other = paths
    for a, b in zip(one, same, strict=True):
        assert_same(a, b)
    for name in ("motor_angle", "roll_pitch_yaw"):
        assert not np.array_equal(getattr(one[-2], name), getattr(other[-2], name))


@pytest.mark.parametrize(("actuator", "ground"), [("dc", FLAT), ("constraint", FLAT), ("dc", ROUGH)])
def test_a_state_continues_exactly_in_another_world(make_world, trot, assert_same, varied, engine, actuator, ground):
    config = {"actuator": actuator, "thermal_protection": actuator == "dc", "ground": ground, **START}
    values = varied(2, bullet=engine != "mujoco")
    world = make_world(2, seed=1, config=config, engine=engine, **values)
    other = make_world(2, seed=2, config=config, engine=engine)
    for k in range(20):
        world.step(trot(k))
        other.step(trot(3 * k))
    world.push(np.tile([0, 50.0, 0], (2, 1)))
    state, readings = world.get_state(), world.readings()
    paths = []
    for again in (world, other):
        if again is other:
            again.set_state(state)
        assert_same(again.readings(), readings)
        path = [again.step(trot(k)) for k in range(20, 60)]
        paths.append([*path, again.reset([1]), again.step(trot(0)), again.truth()])
    for one, another in zip(*paths, strict=True):
        assert_same(one, another)
    np.testing.assert_array_equal(world.get_state()["engine"], other.get_state()["engine"])


@pytest.mark.parametrize("terrain", ["flat", "rough:0.1", "blocks:0.1"])
def test_skipped_shapes_have_no_contacts(make_world, terrain):
    ground = make_terrain(terrain) if terrain == "flat" else replace(make_terrain(terrain), center=(4.1, 4.1))
    config, paths = {"ground": ground, "start_linear_speed": 1.0, "start_angular_speed": 3.0}, []
    for search_all in (False, True):
        world, rng = make_world(8, seed=1, config=config), np.random.default_rng(0)
        if search_all:
            world.engine._native.shape_part[:, 2] = 1e9  # as if they could move that far
        for k in range(80):
            if k % 5 == 0:
                target = world.resting_angles + rng.uniform(-1.0, 1.0, world.resting_angles.shape)
            world.step(target)
        paths.append(world.get_state()["engine"])
        assert search_all or any(data.ncon for data in world.engine.datas)
    np.testing.assert_array_equal(*paths)


@pytest.mark.parametrize("force", [1e12, np.nan])
def test_a_diverged_robot_is_reset_without_output(
    make_world, trot, assert_same, engine, force, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)  # MuJoCo's own warnings go to stderr and to a file here.
    values = {"base_mass_ratio": [1.0, 1.2], "contact_friction": [1.0, 0.6], "contact_stiffness": [3000.0, 2000.0]}
    world, other = (make_world(2, engine=engine, **values) for _ in range(2))
    world.push([[0.0, 0.0, 0.0], [force, 0.0, force]])
    world.step(trot(0))
    assert world.divergences == 1
    assert world.truth().diverged.tolist() == [False, True]
    assert capfd.readouterr().err == ""
    assert not list(tmp_path.iterdir())
    world.push(np.zeros((2, 3)))
    world.reset()
    for k in range(20):
        assert_same(world.step(trot(k)), other.step(trot(k)))
    assert_same(world.truth(), other.truth())


def test_a_push_persists_until_the_next(make_world, engine):
    world, speeds = make_world(engine=engine), []
    for force in (40.0 + 7.473 * 9.81, None, 0.0):
        if force is not None:
            world.push([[0.0, 0.0, force]])
        for _ in range(6):
            world.step(world.resting_angles)
        speeds.append(world.truth().base_velocity_world[0, 2])
    assert speeds[1] > speeds[0] + 0.1  # it still acts
    assert speeds[2] < speeds[1] - 0.2


def test_on_the_rack_the_base_is_still_and_its_readings_zero(make_world, trot, engine):
    world = make_world(config={"rack": True}, engine=engine)
    for k in range(20):
        readings = world.step(trot(k))
    truth = world.truth()
    assert not readings.roll_pitch_yaw.any()
    assert not readings.angular_velocity_base.any()
    assert truth.base_position_world.tolist() == [[0.0, 0.0, 1.0]]
    assert truth.base_quat_world.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert not truth.foot_contact.any()
    assert np.abs(truth.motor_velocity).max() > 0.5


@pytest.mark.parametrize("actuator", ["dc", "constraint"])
def test_only_a_motor_with_more_than_its_torque_commanded_is_saturated(make_world, engine, actuator):
    world = make_world(1, config={"rack": True, "actuator": actuator}, engine=engine)
    target = world.resting_angles.copy()
    for _ in range(20):
        world.step(target)
    assert not world.truth().motor_saturation.any()
    target[1] += 1.5
    world.step(target)
    (first,) = world.truth().motor_saturation
    assert first[1] == 1.0
    assert first[4:].max() == 0.0  # other legs
    world.reset()
    assert not world.truth().motor_saturation.any()


@pytest.mark.parametrize(("share", "at_limit"), [(0.5, False), (20.0, True)])
def test_a_joint_actuator_is_saturated_if_its_controller_commands_more(engine, share, at_limit):
    robot = RobotDescription.load("solo8")
    world = SimWorld(robot, 1, config=WorldConfig(rack=True), engine=engine)
    target = world.resting_angles.copy()
    target[1] += share * robot.actuator.torque_limit / robot.actuator.kp
    world.step(target)
    (saturation,) = world.truth().motor_saturation
    assert saturation[1] == at_limit
    assert saturation[2:].max() == 0.0


def test_skipping_shapes_does_not_change_contacts():
    robot, tops = RobotDescription.load("go2"), np.random.default_rng(0).uniform(0.0, 0.1, (30, 30, 1, 1))
    ground = Ground(np.broadcast_to(tops, (30, 30, 2, 2)).copy(), 0.1)
    step = robot.timing.servo_step
    params = PhysicalParams.nominal(robot, 2).with_values(robot, control_step=step)
    config = WorldConfig(ground=ground, threads=1, start_linear_speed=1.5, start_angular_speed=4.0)
    worlds = [SimWorld(robot, 2, params, 1, config) for _ in range(2)]
    rng, contacts = np.random.default_rng(0), 0
    for k in range(400):
        if k % 25 == 0:
            target = worlds[0].resting_angles + rng.uniform(-1.0, 1.0, (2, robot.num_motors))
        worlds[1].engine._native.moved[:] = True  # all shapes take part
        for world in worlds:
            world.step(target)
        contacts += sum(data.ncon for data in worlds[0].engine.datas)
    assert contacts > 100
    np.testing.assert_array_equal(*(world.engine.base() for world in worlds))
