"""`SimWorld` with Bullet: its model, parameters, contacts and clients."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.rotations import xyzw_matrix
from surefoot.world import bullet_model
from surefoot.world.bullet_kernels import CONTACT_RANGE, pin_kernel, sole_kernel
from surefoot.world.bullet_model import BulletModel, BulletSettings
from surefoot.world.ground import FLAT, Ground, uneven_floor
from surefoot.world.ground_contact import sphere_contacts
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

pybullet = pytest.importorskip("pybullet")


@pytest.fixture
def make_world(make_world) -> Callable[..., SimWorld]:
    return partial(make_world, engine="bullet")


def loop_gap(world: SimWorld) -> float:
    """Return the maximum distance between the two ends of a loop's pin [m]."""
    model, worst = world.engine.models[0], 0.0
    for loop in world.robot.loops:
        ends = []
        for link, point in zip(loop.links, loop.points, strict=True):
            state = pybullet.getLinkState(
                model.body, model.links[link], computeForwardKinematics=1, physicsClientId=model.client
            )
            ends.append(xyzw_matrix(np.array(state[5])) @ point + state[4])
        worst = max(worst, float(np.linalg.norm(ends[0] - ends[1])))
    return worst


# --- the model --------------------------------------------------------------------------------------------


def test_masses_that_differ_from_the_file_are_rejected(robot):
    model = BulletModel(robot, WorldConfig(), BulletSettings())
    link = model.links["front_left_2_lower"]
    # Given only a mass, Bullet uses the inertia of the foot's small sphere.
    pybullet.changeDynamics(model.body, link, mass=model.mass["front_left_2_lower"][0], physicsClientId=model.client)
    with pytest.raises(SurefootError, match=r"link 'front_left_2_lower': Bullet has mass 0\.086 kg and moments"):
        model.check_masses(model.mass)


@pytest.mark.parametrize(("i", "friction", "stiffness", "spin"), [(0, 0.7, 3000.0, 0.004), (1, 1.0, 5000.0, 0.01)])
def test_feet_have_the_robots_contact_parameters_and_no_damping(make_world, i, friction, stiffness, spin):
    contact = {"friction": [0.7, 1.0], "stiffness": [3000.0, 5000.0], "spinning_friction": [0.004, 0.01]}
    world = make_world(2, **{f"contact_{name}": values for name, values in contact.items()})
    model = world.engine.models[i]
    for link in model.links.values():
        info = pybullet.getDynamicsInfo(model.body, link, model.client)
        foot = link in model.feet
        touches = bool(pybullet.getCollisionShapeData(model.body, link, model.client))
        assert touches == (foot or link == -1)
        if touches:
            assert info[1] == (friction if foot else 1.0)
        assert info[5] == 0.0
        if foot:
            assert info[6:10] == (0.0, spin, 100.0, stiffness)
    assert pybullet.getDynamicsInfo(model.ground, -1, model.client)[1] == 1.0


def test_a_loop_stays_closed_while_the_robot_trots(make_world, trot):
    world, worst = make_world(), 0.0
    for k in range(120):
        world.step(trot(k))
        worst = max(worst, loop_gap(world))
    assert worst < 1e-4


def test_motors_may_exceed_bullets_default_speed_limit(make_world):
    world = make_world(config={"rack": True}, voltage=30.0, servo_kp=10.0, servo_kd=0.0, leg_mass_ratio=0.2)
    fastest = 0.0
    for k in range(60):
        world.step(world.resting_angles + (1.0 if k % 20 < 10 else -0.5))
        fastest = max(fastest, float(np.abs(world.truth().motor_velocity).max()))
    assert fastest > 100.0


# --- frames -----------------------------------------------------------------------------------------------


def test_base_velocity_is_that_of_the_link_origin_of_a_rotated_robot(make_world, trot):
    world = make_world(config={"start_angular_speed": 3.0}, control_step=0.001, control_latency=0.0)
    for k in range(60):
        world.step(trot(k))
    engine = world.engine
    linear, angular = np.array([0.3, -0.2, 0.5]), np.array([1.0, -2.0, 3.0])
    engine.set_base_velocity(np.array([0]), linear[None], angular[None])
    engine.observe(np.array([0]))
    np.testing.assert_allclose(world.actuation.sample[0, -3:], angular, atol=1e-12)
    before = world.truth()
    assert np.abs(before.roll_pitch_yaw).max() > 0.01
    np.testing.assert_allclose(before.base_velocity_world[0], linear, atol=1e-12)
    world.step(trot(60))
    after = world.truth()
    # Positions change by the velocities at the end of a step.
    moved = after.base_position_world - before.base_position_world
    np.testing.assert_allclose(moved, 0.001 * after.base_velocity_world, atol=2e-6)


# --- parameters, forces -----------------------------------------------------------------------------------


def test_knee_friction_is_the_torque_that_knees_resist(make_world):
    # Horizontal lower links hang on knees with 0.2 N m of friction; each weighs 0.07 to 0.09 kg, some 0.1 N m about its
    # knee.
    for friction, fell in ((0.2, False), (0.0, True)):
        world = make_world(config={"rack": True}, knee_friction=friction)
        model = world.engine.models[0]
        client = model.client
        for number in model.pins:
            pybullet.removeConstraint(number, client)
        for joint in model.joints.values():
            pybullet.resetJointState(model.body, joint, np.pi / 4, 0.0, client)
        for _ in range(300):
            pybullet.setJointMotorControlArray(
                model.body, model.motors, pybullet.VELOCITY_CONTROL, forces=[50.0] * 8, physicsClientId=client
            )
            pybullet.stepSimulation(client)
        angles = np.array([state[0] for state in pybullet.getJointStates(model.body, model.knees, client)])
        assert np.all(np.abs(angles - np.pi / 4) < 0.05) != fell


def test_a_pin_moves_to_the_side_of_its_load():
    # 3 N along x and 4 N along the pin: the pin goes to x, by the clearance times 3 / (3 + 1), a fifth of it a step.
    quats, axes = np.array([[0.0, 0.0, 0.0, 1.0]]), np.array([[0.0, 1.0, 0.0]])
    forces, shift = np.array([[3.0, 4.0, 0.0]]), np.zeros((1, 3))
    pin_kernel(quats, forces, axes, 0.001, shift)
    np.testing.assert_allclose(shift, [[0.2 * 0.00075, 0.0, 0.0]], atol=1e-12)
    for _ in range(100):
        pin_kernel(quats, forces, axes, 0.001, shift)
    np.testing.assert_allclose(shift, [[0.00075, 0.0, 0.0]], atol=1e-9)
    # In a link that is turned a quarter about z, the world's x is its -y, and y its x.
    quats = np.array([[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]])
    turned = np.zeros((1, 3))
    for _ in range(100):
        pin_kernel(quats, forces, np.array([[0.0, 0.0, 1.0]]), 0.001, turned)
    np.testing.assert_allclose(turned, 0.001 / 6 * np.array([[4.0, -3.0, 0.0]]), atol=1e-9)


def soles(load, velocity, omega=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0, 1.0), stretch=(0.0, 0.0, 0.0)):
    """Return force, point of application and new shear, (3,) each, of a sphere of 0.02 m 0.1 m below its link."""
    links = np.array([[1.0, 2.0, 3.0, *turn, *velocity, *omega]])
    after, force, place = np.array([stretch], float), np.zeros((1, 3)), np.zeros((1, 3))
    centres, radii, law = np.array([[0.0, 0.0, -0.1]]), np.array([0.02]), (np.array([0.5]), (300.0, 100.0, 0.001))
    sole_kernel(links, np.array([load], float), centres, radii, *law, after, force, place)
    return force[0], place[0], after[0]


def test_a_sole_shears_with_a_rotating_foot():
    # 0.02 m/s and 0.25 rad/s at 0.12 m give 0.05 m/s along x: 300 x 0.00005 + 50 x 0.05 = 2.515 N against it.
    force, place, stretch = soles((0, 0, 10), (0.02, 0, -1.0), (0, -0.25, 0))
    np.testing.assert_allclose(force, [-2.515, 0, 0], atol=1e-12)
    np.testing.assert_allclose(place, [1, 2, 2.88], atol=1e-12)
    np.testing.assert_allclose(stretch, [0.00005, 0, 0], atol=1e-15)


def test_a_sole_rotates_with_its_link():
    # Half a turn about x: the foot is above the link's centre.
    _, place, _ = soles((0, 0, 10), (0, 0, 0), turn=(1.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(place, [1, 2, 3.08], atol=1e-12)


def test_a_sole_slides_at_the_limit_and_resets_in_the_air():
    force, _, stretch = soles((0, 0, 10), (0, 0, 0), stretch=(0.03, 0.04, 0.0))
    np.testing.assert_allclose(force, [-3, -4, 0], atol=1e-12)  # 15 N of 50 mm, bounded by 0.5 x 10 N
    np.testing.assert_allclose(stretch, [0.01, 0.04 / 3, 0], atol=1e-12)
    force, _, stretch = soles((0, 0, 0), (1, 0, 0), stretch=(0.03, 0.04, 0.0))
    assert not force.any()
    assert not stretch.any()


def test_the_tangential_force_on_a_slope_is_along_it():
    normal = np.array([0.6, 0.0, 0.8])
    force, place, _ = soles(10 * normal, (0.01, 0.02, -0.03))
    assert force[0] != 0
    assert force @ normal == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(place, [1 - 0.012, 2, 2.9 - 0.016], atol=1e-12)


def test_feet_with_soft_soles_have_no_friction_of_bullets_own(make_world):
    world = make_world(2, contact_shear_ratio=[0.5, 1.0])
    for model, friction in zip(world.engine.models, (0.0, world.robot.contact.friction), strict=True):
        for link in model.feet:
            assert pybullet.getDynamicsInfo(model.body, link, model.client)[1] == friction


def test_legs_with_knee_play_sag_under_the_robots_weight(make_world):
    world = make_world(3, knee_play=[0.0, 0.0005, 0.001])
    for _ in range(80):
        world.step(world.resting_angles)
    heights = world.truth().base_position_world[:, 2]
    assert 0.0001 < heights[0] - heights[1] < 0.001
    assert heights[0] - heights[2] == pytest.approx(2 * (heights[0] - heights[1]), rel=0.05)


def test_soft_feet_that_sink_in_deep_come_out_of_an_uneven_floor(make_world):
    world = make_world(1, floor_unevenness=0.002)
    world.engine.move_base(np.array([0]), np.array([[0.0, 0.0, 0.1]]))
    heights = []
    for _ in range(60):
        world.step(world.resting_angles)
        heights.append(world.foot_positions()[0, :, 2])
    assert np.min(heights) < 0.0  # the centres
    assert 0.0 < np.min(heights[-1]) < np.max(heights[-1]) < 0.02


def test_a_robot_on_its_back_lies_on_the_plane_under_an_uneven_floor(make_world):
    world, heights = make_world(2, floor_unevenness=[0.0, 0.002]), []
    for model in world.engine.models:
        pybullet.resetBasePositionAndOrientation(model.body, [0, 0, 0.1], [1, 0, 0, 0], model.client)
        for _ in range(500):
            pybullet.stepSimulation(model.client)
        heights.append(pybullet.getBasePositionAndOrientation(model.body, model.client)[0][2])
    assert 0.02 < heights[0] < 0.1
    assert heights[1] == pytest.approx(heights[0], abs=1e-3)


def blocks() -> Ground:
    """Return a ground with blocks of up to 6 cm around the origin."""
    tops = np.random.default_rng(1).uniform(-0.06, 0.0, (20, 20, 1, 1))
    return Ground(np.broadcast_to(tops, (20, 20, 2, 2)).copy(), 0.1)


def test_planes_touch_the_ground_where_feet_do(make_world):
    ground = blocks()
    world = make_world(1, config={"ground": ground}, floor_unevenness=0.004)
    (model,) = world.engine.models
    for x, y, z in np.random.default_rng(1).uniform([-0.7, -0.7, 0.12], [0.7, 0.7, 0.26], (20, 3)):
        pybullet.resetBasePositionAndOrientation(model.body, [x, y, z], [0, 0, 0, 1], model.client)
        model.place_planes()
        for k, foot in enumerate(model.foot_positions()):
            lift, radius = uneven_floor(0.004).height(foot[:2]), model.foot_radius[k]
            both = sphere_contacts(
                ground.corners, ground.grid, foot[0], foot[1], foot[2] - lift, radius + CONTACT_RANGE
            )
            for (depth, *normal), plane in zip(both, model.planes[k :: len(model.feet)], strict=True):
                place, quat = pybullet.getBasePositionAndOrientation(plane, model.client)
                facing = np.array(pybullet.getMatrixFromQuaternion(quat))[2::3]
                distance = facing @ (foot - place)
                if depth > 0:
                    np.testing.assert_allclose(facing, normal, atol=1e-9)
                    assert distance == pytest.approx(radius + CONTACT_RANGE - depth, abs=1e-9)
                else:
                    assert distance > 100.0


def test_shanks_collide_with_cells_and_feet_only_with_planes():
    robot, ground = RobotDescription.load("go2"), blocks()
    params = PhysicalParams.nominal(robot, 1)
    worlds = [SimWorld(robot, 1, params, config=WorldConfig(ground=one), engine="bullet") for one in (ground, FLAT)]
    for world in worlds:
        world.engine.set_state(np.array([0]), worlds[1].engine.initial_state)
    (model,), (flat,) = (world.engine.models for world in worlds)
    for leg, foot in zip(robot.legs, model.feet, strict=True):
        (sphere,) = pybullet.getCollisionShapeData(model.body, foot, model.client)
        shank = robot.urdf.fused_frames[leg.foot][0]
        shapes, both = (pybullet.getCollisionShapeData(one.body, one.links[shank], one.client) for one in (model, flat))
        assert sphere[2] == pybullet.GEOM_SPHERE
        assert len(shapes) == len(both) - 1 > 0
    np.testing.assert_allclose(model.foot_positions(), flat.foot_positions(), atol=1e-9)
    # On its side, the robot's body and shanks touch the mesh; its feet do not.
    pybullet.resetBasePositionAndOrientation(model.body, [0, 0, 0.15], [0.7071, 0, 0, 0.7071], model.client)
    touching = set()
    for _ in range(300):
        model.place_planes()
        pybullet.stepSimulation(model.client)
        touching |= {point[3] for point in pybullet.getContactPoints(model.body, model.ground, -2, -2, model.client)}
    assert touching
    assert not touching & set(model.feet)


def test_too_large_grounds_and_boxes_as_feet_on_terrain_are_rejected(robot, monkeypatch):
    config = WorldConfig(ground=blocks())
    with pytest.raises(SurefootError, match="world bullet-published has boxes for feet"):
        SimWorld(robot, 1, config=config, engine="bullet-published")
    monkeypatch.setattr(bullet_model, "_MAX_INDICES", 300)
    with pytest.raises(SurefootError, match=r"triangles with .* Bullet allows at most 100 with"):
        SimWorld(robot, 1, config=config, engine="bullet")


def test_robots_stand_on_feet_of_any_stiffness_from_the_start(make_world):
    world = make_world(3, contact_stiffness=[3000.0, 1500.0, 30_000.0])
    highest = np.zeros(3)
    for _ in range(30):
        world.step(world.resting_angles)
        highest = np.maximum(highest, np.abs(world.truth().base_velocity_world[:, 2]))
    # With the 6 mm penetration of soft feet, stiff feet would throw the robot up at some 0.8 m/s.
    assert highest.max() < 0.05


def test_the_published_settings_reach_bullet(robot):
    world = SimWorld(robot, 1, engine="bullet-published")
    model = world.engine.models[0]
    parameters = pybullet.getPhysicsEngineParameters(model.client)
    assert parameters["gravityAccelerationZ"] == -10.0
    (ground,) = pybullet.getCollisionShapeData(model.ground, -1, model.client)
    assert (ground[2], ground[3]) == (pybullet.GEOM_BOX, (200.0, 200.0, 10.0))
    for leg, link in zip(robot.legs, model.feet, strict=True):
        (shape,) = pybullet.getCollisionShapeData(model.body, link, model.client)
        assert shape[2] == pybullet.GEOM_BOX, leg
        np.testing.assert_allclose(shape[3], (0.017, 0.009, 0.24))
    for _ in range(40):
        world.step(world.resting_angles)
    assert 0.2 < world.truth().base_position_world[0, 2] < 0.3


@pytest.mark.parametrize(("coulomb", "viscous"), [(0.3, 0.0), (0.0, 0.1)])
def test_a_constraint_motor_overcomes_its_friction(make_world, trot, coulomb, viscous):
    # Both follow their targets; the torque of the second is larger by the friction at the speed of the step's start.
    friction = {"motor_friction": [0.0, coulomb], "motor_viscous_friction": [0.0, viscous]}
    world = make_world(2, config={"actuator": "constraint", "rack": True}, control_step=0.001, **friction)
    for k in range(60):
        speed = world.truth().motor_velocity[1]
        world.step(trot(k / 6))
    truth = world.truth()
    np.testing.assert_allclose(truth.motor_angle[0], truth.motor_angle[1], atol=1e-3)
    moving = np.abs(speed) > 1.0
    assert moving.sum() >= 4
    more = (truth.motor_torque[1] - truth.motor_torque[0])[moving]
    np.testing.assert_allclose(more, (coulomb * np.sign(speed) + viscous * speed)[moving], atol=0.01)


def test_a_constraint_motor_without_strength_gives_no_torque(make_world, trot):
    world = make_world(config={"actuator": "constraint"})
    for k in range(10):
        world.step(trot(k))
    assert np.abs(world.truth().motor_torque).max() > 0.1
    world.set_params([0], world.params.with_values(world.robot, motor_strength=0.0))
    world.step(trot(10))
    assert not world.truth().motor_torque.any()


# --- clients and output -----------------------------------------------------------------------------------


def test_clients_are_closed_with_the_world(make_world):
    world = make_world(2)
    clients = [model.client for model in world.engine.models]
    assert all(pybullet.isConnected(client) for client in clients)
    del world
    gc.collect()
    assert not any(pybullet.isConnected(client) for client in clients)


def test_bullet_reports_too_many_clients(robot, monkeypatch):
    def full(_mode: int) -> int:
        raise pybullet.error("Can not connect")

    monkeypatch.setattr(pybullet, "connect", full)
    with pytest.raises(SurefootError, match="Bullet can't hold another robot in this process"):
        BulletModel(robot, WorldConfig(), BulletSettings())


def test_bullet_prints_nothing():
    script = """
from surefoot.robot import RobotDescription
from surefoot.world.sim_world import SimWorld
SimWorld(RobotDescription.load("minitaur"), 1, engine="bullet")
print("mine")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=250, env=os.environ)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "mine\n"
    assert "pybullet build time" not in done.stderr
