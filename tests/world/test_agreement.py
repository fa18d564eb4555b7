"""Agreement of the same robot in MuJoCo and in Bullet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.rotations import matrix_quat, quat_matrix, xyzw_matrix
from surefoot.world.bullet_engine import BulletEngine
from surefoot.world.ground import FLAT, Ground
from surefoot.world.interface import WorldConfig
from surefoot.world.mujoco_engine import MujocoEngine
from surefoot.world.sim_world import SimWorld

pytest.importorskip("pybullet")

WEIGHT = 7.473 * 9.81
ENGINES = ("mujoco", "bullet")


def both(
    robot: RobotDescription, num_envs: int = 1, config: WorldConfig | None = None, **values: object
) -> list[SimWorld]:
    """Return the same robots in MuJoCo and in Bullet."""
    params = PhysicalParams.nominal(robot, num_envs).with_values(robot, **values)
    return [SimWorld(robot, num_envs, params, config=config, engine=engine) for engine in ENGINES]


def follow(world: SimWorld, path: Callable[[int], np.ndarray], steps: int) -> np.ndarray:
    """Return the true motor angles (steps, N, M) while the world follows commanded motor angles."""
    angles = []
    for k in range(steps):
        world.step(path(k))
        angles.append(world.truth().motor_angle)
    return np.array(angles)


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(difference**2)))


def lift(world: SimWorld, height: float) -> None:
    """Raise all robots by a height [m]."""
    every = np.arange(world.num_envs)
    world.engine.move_base(every, np.array([[0.0, 0.0, height]] * len(every)))
    world.engine.observe(every)


def bullet_mass_matrix(engine: BulletEngine) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass in the world and inertia about it (3, 3) of the first robot."""
    p, model = engine._p, engine.models[0]
    parts = []
    for link in model.links.values():
        info = p.getDynamicsInfo(model.body, link, physicsClientId=model.client)
        if link < 0:
            place, quat = p.getBasePositionAndOrientation(model.body, model.client)
        else:
            place, quat = p.getLinkState(model.body, link, 0, 1, model.client)[:2]
        turn = xyzw_matrix(np.array(quat))
        parts.append((info[0], np.array(place), turn @ np.diag(info[2]) @ turn.T))
    return whole(parts)


def mujoco_mass_matrix(engine: MujocoEngine) -> tuple[float, np.ndarray, np.ndarray]:
    model, data = engine.models[0], engine.datas[0]
    mujoco.mj_forward(model, data)
    turns, places = data.ximat.reshape(-1, 3, 3), data.xipos
    moments = model.body_inertia
    return whole([(model.body_mass[b], places[b], turns[b] * moments[b] @ turns[b].T) for b in range(1, model.nbody)])


def whole(parts: list[tuple[float, np.ndarray, np.ndarray]]) -> tuple[float, np.ndarray, np.ndarray]:
    mass = sum(part[0] for part in parts)
    centre = sum(m * at for m, at, _ in parts) / mass
    away = [at - centre for _, at, _ in parts]
    inertia = sum(i + m * (d @ d * np.eye(3) - np.outer(d, d)) for (m, _, i), d in zip(parts, away, strict=True))
    return mass, centre, inertia


def test_masses_and_total_inertia_agree(robot: RobotDescription):
    mujoco_world, bullet_world = both(robot)
    for world in (mujoco_world, bullet_world):
        world.engine.set_state(np.array([0]), world.engine.initial_state)
    one, other = mujoco_mass_matrix(mujoco_world.engine), bullet_mass_matrix(bullet_world.engine)
    assert one[0] == pytest.approx(7.473, abs=1e-9)
    assert other[0] == pytest.approx(one[0], rel=1e-12)
    np.testing.assert_allclose(other[1], one[1], atol=1e-7)
    np.testing.assert_allclose(other[2], one[2], atol=1e-7)


def test_resting_poses_agree(robot: RobotDescription):
    worlds = both(robot)
    for world in worlds:
        world.engine.set_state(np.array([0]), world.engine.initial_state)
    bases, feet = zip(*((world.engine.base()[0], world.foot_positions()[0]) for world in worlds), strict=True)
    np.testing.assert_allclose(*bases, atol=1e-7)
    np.testing.assert_allclose(*feet, atol=1e-7)


def test_foot_penetration_is_weight_over_stiffness(robot: RobotDescription):
    # 73.3 N on four feet of 1500, 3000 and 12000 N/m: 12.2, 6.1 and 1.5 mm each, in one batch.
    stiffness, heights = np.array([1500.0, 3000.0, 12_000.0]), []
    for world in both(robot, 3, contact_stiffness=stiffness):
        for _ in range(350):
            world.step(world.resting_angles)
        heights.append(world.truth().base_position_world[:, 2])
        depth = robot.five_bar.foot_radius - world.foot_positions()[:, :, 2]
        np.testing.assert_allclose(depth.sum(axis=1), WEIGHT / stiffness, rtol=0.01)
        np.testing.assert_allclose(depth.mean(axis=1), [12.2e-3, 6.1e-3, 1.5e-3], atol=0.1e-3)
    np.testing.assert_allclose(*heights, atol=1e-4)


def test_a_robot_in_the_air_responds_equally_to_a_push(robot: RobotDescription):
    # Without contact, this compares masses, inertias, loops, motors and the frames of base, force and rates.
    results = []
    for world in both(robot, control_latency=0.0):
        lift(world, 1.0)
        world.push([[60.0, 130.0, -40.0]])
        for _ in range(10):
            world.step(world.resting_angles)
        world.push([[0.0, 0.0, 0.0]])
        for _ in range(10):
            readings = world.step(world.resting_angles)
        results.append((world.truth(), readings))
    (one, seen_one), (other, seen_other) = results
    assert np.abs(one.base_velocity_world).max() > 0.9
    assert np.abs(seen_one.angular_velocity_base).max() > 0.5
    np.testing.assert_allclose(other.base_velocity_world, one.base_velocity_world, atol=0.01)
    np.testing.assert_allclose(other.base_position_world, one.base_position_world, atol=0.001)
    np.testing.assert_allclose(seen_other.roll_pitch_yaw, seen_one.roll_pitch_yaw, atol=0.002)
    np.testing.assert_allclose(seen_other.angular_velocity_base, seen_one.angular_velocity_base, atol=0.02)


# --- legs on the rack -------------------------------------------------------------------------------------


def sines(robot: RobotDescription) -> Callable[[int], np.ndarray]:
    """Return a path with a different sine for each leg, in swing and extension."""

    def path(k: int) -> np.ndarray:
        phase = 2 * np.pi * np.array([1.0, 2.0, 3.0, 4.0]) * 0.006 * k
        return robot.pose_angles(0.3 * np.sin(phase), 2.0 + 0.3 * np.sin(0.7 * phase))

    return path


def steps(robot: RobotDescription) -> Callable[[int], np.ndarray]:
    """Return a path with different steps for each leg, after 20 and after 60 control steps."""

    def path(k: int) -> np.ndarray:
        size = np.array([0.1, 0.2, 0.3, 0.4]) * ((k >= 20) - 2.0 * (k >= 60))
        return robot.pose_angles(size, 2.0 - 0.3 * size)

    return path


@pytest.mark.parametrize("path", [sines, steps])
@pytest.mark.parametrize("actuator", ["dc", "constraint"])
def test_legs_on_the_rack_move_equally(robot: RobotDescription, path, actuator):
    config = WorldConfig(rack=True, actuator=actuator, threads=1)
    one, other = (follow(world, path(robot), 100) for world in both(robot, config=config))
    assert np.ptp(one, axis=0).min() > 0.1
    # 0.02 rad would suffice; without contact the engines agree far better.
    assert rms(other - one) < 0.001


CHANGED = {
    "leg_mass_ratio": 3.0,
    "leg_inertia_ratio": 4.0,
    "motor_strength": 0.3,
    "motor_friction": 0.4,
    "motor_viscous_friction": 0.1,
    "torque_constant": 0.14,
    "resistance": 0.6,
    "voltage": 8.0,
    "servo_kp": 0.3,
    "servo_kd": 0.05,
    "servo_latency": 0.010,
    "control_step": 0.008,
}


def test_each_parameter_of_legs_and_motors_has_the_same_effect(robot: RobotDescription):
    # Robot 0 is nominal, robot k has one parameter changed.
    count = len(CHANGED) + 1
    values = {name: np.full(count, robot.nominal_params()[name]) for name in CHANGED}
    for k, (name, value) in enumerate(CHANGED.items(), start=1):
        values[name][k] = value
    config = WorldConfig(rack=True, threads=1)
    one, other = (follow(world, steps(robot), 100) for world in both(robot, count, config, **values))
    for k, name in enumerate(CHANGED, start=1):
        effect, apart = rms(other[:, k] - other[:, 0]), rms(other[:, k] - one[:, k])
        assert effect > 0.004, name
        assert apart < max(0.3 * effect, 0.002), name


# --- feet -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.1, 0.2])
def test_a_robot_slides_equally(robot: RobotDescription, friction):
    # Twice the friction bound: the robot slides with the rest of the push.
    slid = []
    for world in both(robot, contact_friction=friction):
        for _ in range(40):
            world.step(world.resting_angles)
        start = world.foot_positions()[0, :, 0].mean()
        world.push([[2 * friction * WEIGHT, 0.0, 0.0]])
        for _ in range(50):
            world.step(world.resting_angles)
        slid.append(world.foot_positions()[0, :, 0].mean() - start)
    # mu g t^2 / 2 with t = 0.3 s: 44 mm at mu 0.1.
    assert slid[0] == pytest.approx(friction * 9.81 * 0.3**2 / 2, rel=0.2)
    assert slid[1] == pytest.approx(slid[0], rel=0.1)


def test_spinning_friction_stops_a_turning_robot_equally(robot: RobotDescription):
    # On slippery feet the robot spins; feet that resist with c f_n reduce its speed by c m g t / I_zz.
    turned = []
    for world in both(robot, 2, contact_friction=0.05, contact_spinning_friction=[0.0, 0.1]):
        for _ in range(20):
            world.step(world.resting_angles)
        world.engine.set_base_velocity(np.arange(2), np.zeros((2, 3)), np.array([[0.0, 0.0, 5.0]] * 2))
        for _ in range(10):
            world.step(world.resting_angles)
        rates = world.readings().angular_velocity_base[:, 2]
        turned.append(rates[0] - rates[1])
    # Readings are 20 ms old, so that 40 ms are significant; 0.27 kg m2 and the legs.
    assert turned[0] == pytest.approx(0.1 * WEIGHT * 0.04 / 0.27, rel=0.25)
    assert turned[1] == pytest.approx(turned[0], rel=0.15)


@pytest.mark.parametrize(("name", "value"), [("base_mass_ratio", 1.5), ("base_inertia_ratio", 3.0)])
def test_mass_and_inertia_of_the_base_have_the_same_effect(robot: RobotDescription, name, value):
    # A lateral push in the air: mass affects the speed, inertia affects the rates.
    results = []
    for world in both(robot, 2, control_latency=0.0, **{name: [1.0, value]}):
        lift(world, 1.0)
        world.push(np.tile([60.0, 130.0, 0.0], (2, 1)))
        for _ in range(10):
            readings = world.step(world.resting_angles)
        results.append(np.hstack([world.truth().base_velocity_world, readings.angular_velocity_base]))
    (one_nominal, one), (other_nominal, other) = results
    effect = np.abs(one - one_nominal).max()
    assert effect > 0.05
    assert np.abs((other - other_nominal) - (one - one_nominal)).max() < 0.1 * effect


def test_a_dropped_robot_lands_equally(robot: RobotDescription):
    # Contact is a spring and a damper, which explicit and implicit steps of 1 ms both approximate well.
    heights, depths = [], []
    for world in both(robot, control_step=0.001):
        lift(world, 0.3)
        path = []
        for _ in range(400):
            world.step(world.resting_angles)
            base = world.truth().base_position_world[0, 2]
            path.append([base, *(robot.five_bar.foot_radius - world.foot_positions()[0, :, 2])])
        heights.append(np.array(path)[:, 0])
        depths.append(np.max(np.array(path)[:, 1:], axis=0))
    assert np.min(depths) > 0.02
    np.testing.assert_allclose(depths[1], depths[0], rtol=0.05)
    assert rms(heights[1] - heights[0]) < 0.003


@pytest.mark.parametrize("name", ["go2", "pupper_v2"])
def test_rotors_resist_only_rotations_of_their_joints(name: str):
    """Hips swing legs on a rack while knees are free; inertia added to the calves would change their motion."""
    robot = RobotDescription.load(name)
    values = {"servo_kp": np.tile([40.0, 40.0, 0.0], 4), "servo_kd": np.tile([2.0, 2.0, 0.0], 4)}
    free = {"motor_friction": 0.0, "motor_viscous_friction": 0.0, "load_friction": 0.0, "torque_limit": 100.0}
    rest = robot.resting_angles

    def path(k: int) -> np.ndarray:
        return (rest + np.tile([0.0, 0.3 * np.sin(0.2 * k), 0.0], 4))[None]

    swung = [follow(world, path, 40) for world in both(robot, config=WorldConfig(rack=True), **values, **free)]
    knees = [angles[:, 0, 2::3] - rest[2::3] for angles in swung]
    assert np.abs(knees[0]).max() > 0.2
    assert rms(knees[0] - knees[1]) < 0.02 * np.abs(knees[0]).max()


# --- ground with cells ------------------------------------------------------------------------------------

LEAN, CELL, CELLS = np.radians(10.0), 0.1, 20
TILTS = {
    "slope along x": np.array([[np.cos(LEAN), 0, -np.sin(LEAN)], [0, 1, 0], [np.sin(LEAN), 0, np.cos(LEAN)]]),
    "slope along y": np.array([[1, 0, 0], [0, np.cos(LEAN), -np.sin(LEAN)], [0, np.sin(LEAN), np.cos(LEAN)]]),
}
"""Rotations with which a robot stands on a slope."""


def cells(kind: str, wall: float = 0.0, height: float = 0.04) -> Ground:
    """Return a ground of 2 m around the origin: a slope through it, a step up at x = `wall`, or rough ground."""
    at = CELL * (np.arange(CELLS + 1) - CELLS / 2)
    x, y = np.meshgrid(at, at, indexing="ij")
    if kind in TILTS:
        return Ground.from_points(np.tan(LEAN) * (x if kind.endswith("x") else y), CELL)
    if kind == "rough":
        return Ground.from_points(np.random.default_rng(0).uniform(0.0, 0.04, x.shape), CELL)
    corners = np.broadcast_to(np.where(x > CELL / 10, height, 0.0)[1:, 1:, None, None], (CELLS, CELLS, 2, 2)).copy()
    return Ground(corners, CELL, (wall, 0.0))


def stand(world: SimWorld, flat: SimWorld, turn: np.ndarray, rise: float) -> None:
    """Place a robot as it rests on flat ground, rotated with the ground about the origin and raised by a height."""
    only, engine = np.array([0]), world.engine
    engine.set_state(only, flat.engine.get_state(only))
    if isinstance(engine, MujocoEngine):
        pose = engine.datas[0].qpos[:7]
        pose[3:] = matrix_quat(turn @ quat_matrix(pose[3:]))
    else:
        pose = engine._rows[0, :7]
        pose[3:] = matrix_quat(turn @ xyzw_matrix(pose[3:]))[[1, 2, 3, 0]]
    pose[:3] = turn @ pose[:3]
    engine.move_base(only, np.array([[0.0, 0.0, rise]]))
    engine.observe(only)


@pytest.mark.parametrize(
    ("name", "kind", "rise"),
    [
        ("go2", "slope along x", 0.0),
        ("minitaur", "slope along y", 0.0),
        ("minitaur", "step", 0.04),
        ("go2", "step", 0.04),
        ("go2", "rough", 0.02),
        ("minitaur", "rough", 0.02),
    ],
)
def test_feet_stand_at_the_same_positions_on_uneven_ground(name: str, kind: str, rise: float):
    robot = RobotDescription.load(name)
    ground, places = cells(kind), []
    # Bullet's own friction would hold feet at their first contact; a shear ratio of 0.999 selects our model in both.
    worlds = both(robot, config=WorldConfig(ground=ground, threads=1), contact_shear_ratio=0.999)
    for world, flat in zip(worlds, both(robot), strict=True):
        stand(world, flat, TILTS.get(kind, np.eye(3)), rise)
        for _ in range(200):
            world.step(world.resting_angles)
        places.append(world.foot_positions()[0])
        assert world.truth().foot_contact.min() == 1.0
    np.testing.assert_allclose(*places, atol=1e-3)


def test_a_rotated_robot_walks_like_one_that_is_not(robot: RobotDescription):
    # Equal except for friction, whose bound is a circle.
    at, turn = np.array([0.3, -0.2]), 2.0
    for world in both(robot, num_envs=2, config=WorldConfig(ground=Ground(np.zeros((40, 40, 2, 2)), CELL), threads=1)):
        world.place([0, 1], np.array([np.zeros(2), at]), np.array([0.0, turn]))
        world.reset()
        for k in range(40):
            world.step(np.tile(world.resting_angles + 0.1 * np.sin(0.2 * k + np.arange(robot.num_motors)), (2, 1)))
        truth = world.truth()
        (x, y, z), turned = truth.base_position_world
        assert np.hypot(x, y) > 0.002
        around = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        np.testing.assert_allclose(turned, [*(around @ np.array([x, y]) + at), z], atol=2e-4)
        np.testing.assert_allclose(np.diff(truth.roll_pitch_yaw, axis=0)[0], [0.0, 0.0, turn], atol=1e-3)


@pytest.mark.parametrize("shear", [1.0, 0.999])
@pytest.mark.parametrize("ground", [FLAT, Ground(np.zeros((40, 40, 2, 2)), CELL)], ids=["plane", "cells"])
def test_feet_slide_on_slippery_patches_and_stick_on_others_equally(
    robot: RobotDescription, ground: Ground, shear: float
):
    # 20 N forward: friction of 0.09 of a robot's weight gives way, at (20 - 6.6) N / 7.5 kg, 5 cm in 0.24 s; 0.9 of it
    # holds. Patches lie side by side: the first robot stands on both of them, the second one on the left, slippery one.
    ground = replace(ground, friction=np.array([[1.0, 0.1]]), patch=1.0)
    config, moved = WorldConfig(ground=ground, threads=1), []
    for world in both(robot, 2, config, contact_shear_ratio=shear, contact_friction=0.9):
        world.place([0, 1], np.array([[0.0, 0.0], [0.0, 0.7]]), np.zeros(2))
        world.reset()
        for _ in range(60):
            world.step(world.resting_angles)
        before = world.foot_positions()[..., 0]
        world.push(np.tile([20.0, 0.0, 0.0], (2, 1)))
        for _ in range(40):
            world.step(world.resting_angles)
        moved.append(world.foot_positions()[..., 0] - before)
    left = robot.leg_mounts[:, 1] > 0
    for way in moved:
        assert way[1].min() > 0.04
        assert np.abs(way[0, ~left]).max() < 0.005 < way[0, left].min()
    np.testing.assert_allclose(*moved, atol=3e-3)  # with compliance and without


def test_a_wall_stops_feet_equally(robot: RobotDescription):
    # 12 N press two feet of 3000 N/m into a wall 5 mm ahead of them, by 2 mm each.
    places, front = [], robot.leg_mounts[:, 0] > 0
    (flat,) = both(robot)[:1]
    wall = flat.foot_positions()[0, front, 0].max() + robot.five_bar.foot_radius + 0.005
    ground = cells("step", wall)
    for world in both(robot, config=WorldConfig(ground=ground, threads=1), contact_friction=0.05):
        world.push([[12.0, 0.0, 0.0]])
        for _ in range(250):
            world.step(world.resting_angles)
        places.append(world.foot_positions()[0])
        depth = places[-1][front, 0] + robot.five_bar.foot_radius - wall
        np.testing.assert_allclose(depth, 0.002, atol=7e-4)
    np.testing.assert_allclose(*places, atol=1e-3)


def test_wall_friction_slows_sliding_feet_equally(robot: RobotDescription):
    # A push presses two feet of a falling robot into a wall: with more friction they fall less.
    fallen, front = [], robot.leg_mounts[:, 0] > 0
    (flat,) = both(robot)[:1]
    wall = flat.foot_positions()[0, front, 0].max() + robot.five_bar.foot_radius
    config = WorldConfig(ground=cells("step", wall, 0.26), threads=1)
    for friction in (0.05, 1.0):
        for world, start in zip(both(robot, config=config, contact_friction=friction), both(robot), strict=True):
            stand(world, start, np.eye(3), 0.2)
            world.push([[40.0, 0.0, 0.0]])
            before = world.foot_positions()[0, front, 2]
            for _ in range(20):
                world.step(world.resting_angles)
            fallen.append(before - world.foot_positions()[0, front, 2])
    np.testing.assert_allclose(fallen[0], fallen[1], atol=1e-3)
    np.testing.assert_allclose(fallen[2], fallen[3], atol=1e-3)
    assert np.all(fallen[0] > fallen[2] + 0.01)


def test_a_robot_on_its_back_lies_on_a_slope_equally():
    robot, heights = RobotDescription.load("go2"), []
    ground = cells("slope along x")
    for world, flat in zip(both(robot, config=WorldConfig(ground=ground, threads=1)), both(robot), strict=True):
        stand(world, flat, TILTS["slope along x"] @ np.diag([1.0, -1.0, -1.0]), 0.7)
        for _ in range(100):
            world.step(world.resting_angles)
        truth = world.truth()
        heights.append(truth.base_position_world[0, 2] - ground.height(truth.base_position_world[0, :2]))
    assert heights[1] == pytest.approx(heights[0], abs=0.003)
