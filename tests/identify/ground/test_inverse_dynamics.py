"""Foot forces of simulated robots with known masses and motions."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.identify.ground.inverse_dynamics import Forces, InverseDynamics, Motion
from surefoot.identify.ground.motion import regress
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription
from surefoot.world.sim_world import SimWorld

STANCE = 1.7
STEP = 0.001


def params(robot: RobotDescription, **values: float) -> PhysicalParams:
    """Return parameters with a control step of 1 ms and no control latency, which keeps fast motions smooth."""
    return PhysicalParams.nominal(robot).with_values(robot, control_step=STEP, control_latency=0.0, **values)


def still(world: SimWorld) -> Motion:
    now, rest = world.truth(), np.zeros((1, 3))
    return Motion(
        motor_angle=now.motor_angle, motor_velocity=0 * now.motor_angle, motor_acceleration=0 * now.motor_angle,
        motor_torque=now.motor_torque, roll_pitch=now.roll_pitch_yaw[:, :2], angular_velocity=rest,
        angular_acceleration=rest,
    )  # fmt: skip


def standing(robot: RobotDescription, uneven: float = 0.0, **values: float) -> SimWorld:
    """Return a world with a robot at rest, whose front legs have `uneven` more extension [rad]."""
    world = SimWorld(robot, 1, params(robot, **values))
    front = np.where(robot.leg_mounts[:, 0] > 0, uneven, 0.0)
    target = robot.pose_angles(np.zeros(4), STANCE + front)
    begin = world.truth().motor_angle[0]
    for k in range(6000):
        world.step((begin + (target - begin) * min(k / 2000, 1.0))[None])
    assert np.abs(world.truth().motor_velocity).max() < 1e-3
    return world


def pressed(world: SimWorld) -> np.ndarray:
    """Return the vertical forces (4,) [N] of feet at rest: penetration depth times stiffness."""
    depth = world.robot.five_bar.foot_radius - world.foot_positions()[0, :, 2]
    return depth * world.params.contact_stiffness[0]


@pytest.mark.parametrize("uneven", [0.0, 0.15])
def test_feet_carry_the_weight_of_a_standing_robot(robot: RobotDescription, uneven: float):
    world = standing(robot, uneven)
    dynamics = InverseDynamics(robot, world.params)
    assert dynamics.mass == pytest.approx(robot.urdf.total_mass)
    result = dynamics.forces(still(world))
    pitch = world.truth().roll_pitch_yaw[0, 1]
    assert abs(pitch) == pytest.approx(0.0, abs=2e-3) if uneven == 0 else abs(pitch) > 0.02
    # The base frame is tilted: world up is (-sin, cos) in its x and z.
    upward = result.force[0] @ [-np.sin(pitch), np.cos(pitch)]
    along = result.force[0] @ [np.cos(pitch), np.sin(pitch)]
    assert upward.sum() == pytest.approx(robot.urdf.total_mass * GRAVITY, rel=1e-3)
    assert abs(along.sum()) < 0.05
    np.testing.assert_allclose(upward, pressed(world), rtol=5e-3)
    # At rest no residual force or moment is needed.
    np.testing.assert_allclose(result.required[0], 0.0, atol=0.05)
    assert abs(result.base_moment[0]) < 1e-9


@pytest.fixture(scope="module")
def nodding(robot: RobotDescription) -> dict[float, Motion]:
    """Motions of robots that nod and squat, by the inertia ratio of the base (1 and 2), in each servo step.

    The engine integrates from one speed to the next with the current forces, so the acceleration of a row belongs to
    the step that begins there.
    """
    motions = {}
    for ratio in (1.0, 2.0):
        world = SimWorld(robot, 1, params(robot, base_inertia_ratio=ratio, motor_friction=0.0))
        ends = np.where(robot.leg_mounts[:, 0] > 0, 1.0, -1.0)
        rows = []
        for k in range(2600):
            progress, time = min(k / 800, 1.0), max(k * STEP - 1.2, 0.0)
            swell = 0.1 * ends * np.sin(2 * np.pi * 3.5 * time) + 0.05 * np.sin(2 * np.pi * 1.5 * time)
            extension = 2.0 + (STANCE - 2.0) * progress + min(time / 0.3, 1.0) * swell
            target = robot.pose_angles(np.zeros(4), extension)
            before = world.truth()
            rate = world.actuation.sample[0, -3:].copy()
            world.step(target[None])
            after = world.truth()
            if time > 0.4:
                rows.append(
                    (
                        before.motor_angle[0], before.motor_velocity[0],
                        (after.motor_velocity[0] - before.motor_velocity[0]) / STEP, after.motor_torque[0],
                        before.roll_pitch_yaw[0, :2], rate, (world.actuation.sample[0, -3:] - rate) / STEP,
                    )
                )  # fmt: skip
        motions[ratio] = Motion(*(np.array(column)[::3] for column in zip(*rows, strict=True)))
    return motions


def forces(robot: RobotDescription, motion: Motion, **values: float) -> Forces:
    return InverseDynamics(robot, params(robot, **values)).forces(motion)


def test_residual_moment_vanishes_with_the_true_masses(robot: RobotDescription, nodding: dict[float, Motion]):
    for ratio, motion in nodding.items():
        result = forces(robot, motion, base_inertia_ratio=ratio)
        assert np.std(result.base_moment) > 0.2
        assert np.std(result.required[:, 2]) < 0.05 * np.std(result.base_moment)
        # Foot forces beyond the weight accelerate the robot up and down.
        carried = result.force[:, :, 1].sum(axis=1)
        assert np.mean(carried) == pytest.approx(robot.urdf.total_mass * GRAVITY, rel=0.03)
        weight = robot.urdf.total_mass * GRAVITY * np.cos(motion.roll_pitch).prod(axis=1)
        np.testing.assert_allclose(carried, weight + result.required[:, 1], atol=0.3)


def test_residual_moment_gives_the_inertia(robot: RobotDescription, nodding: dict[float, Motion]):
    for true, assumed in ((1.0, 1.0), (2.0, 1.0), (1.0, 2.0)):
        result = forces(robot, nodding[true], base_inertia_ratio=assumed)
        columns = np.stack([result.base_moment, np.ones_like(result.base_moment)], axis=1)
        values, _ = regress(columns, -result.required[:, 2], np.arange(len(columns)) // 50)
        # The excess is relative to the assumed inertia.
        assert assumed * (1 + values[0]) == pytest.approx(true, rel=0.03)


def test_mass_of_the_base_includes_fixed_links(robot: RobotDescription):
    one, other = InverseDynamics(robot, params(robot)), InverseDynamics(robot, params(robot, base_inertia_ratio=2.0))
    np.testing.assert_allclose(other.base_inertia, 2 * one.base_inertia)
    # About y through the common centre: the body, whose centre is 50 mm in front of its origin, and two rails 18.5 mm
    # below.
    masses, places = np.array([3.353, 1.32, 1.32]), np.array([[0.05, 0.0], [0.0, -0.0185], [0.0, -0.0185]])
    centre = masses @ places / masses.sum()
    about_y = 0.027262 + 2 * 0.040913 + masses @ np.sum((places - centre) ** 2, axis=1)
    assert one.base_inertia[1, 1] == pytest.approx(about_y, rel=1e-4)


def test_feet_positions_follow_from_leg_angles(robot: RobotDescription):
    motion = still(standing(robot))
    symmetric = Motion(
        **{**vars(motion), "motor_angle": robot.pose_angles(0.0, STANCE)[None], "roll_pitch": np.zeros((1, 2))}
    )
    foot = forces(robot, symmetric).foot[0]
    np.testing.assert_allclose(foot[:, 1], foot[0, 1], atol=1e-6)
    assert -0.3 < foot[0, 1] < -0.1
    # Feet are below the mounts of the legs, except for a few millimetres: the lower links differ in length.
    np.testing.assert_allclose(foot[:, 0], robot.leg_mounts[:, 0], atol=0.03)
