"""Velocity and load that feet imply, against rigid-body kinematics of the URDF and statics."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.arrays import Array
from surefoot.estimation.foot_odometry import FootOdometry, foot_radii, up_direction
from surefoot.estimation.interface import MotionReadings
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.rotations import rpy_matrix
from surefoot.task.observation import gravity

ROBOTS = ("minitaur", "go2", "solo8")
STEP = 1e-4


def readings(robot: RobotDescription, angle: Array, attitude: Array, rate: Array, torque: Array) -> MotionReadings:
    """Return the readings of one robot."""
    return MotionReadings(
        duration=np.array([STEP]),
        roll_pitch_yaw=attitude[None],
        angular_velocity_base=rate[None],
        motor_angle=angle[None],
        motor_velocity=np.zeros((1, robot.num_motors)),
        motor_torque=torque[None],
    )


def turned(rate: Array, time: float) -> Array:
    """Return the rotation (3, 3) after turning at a rate (3,) [rad/s] for a time [s], to second order."""
    x, y, z = rate * time
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / 2


@pytest.mark.parametrize("name", ROBOTS)
def test_the_lowest_point_of_a_standing_foot_is_at_rest(name):
    robot, random = RobotDescription.load(name), np.random.default_rng(3)
    angle, speed = (
        robot.resting_angles + random.uniform(-0.1, 0.1, robot.num_motors),
        random.uniform(-3, 3, robot.num_motors),
    )
    attitude, rate = np.array([0.1, -0.2, 0.7]), np.array([0.5, -0.8, 0.3])
    odometry, still = FootOdometry(robot), np.zeros(robot.num_motors)
    before, after = angle - speed * STEP / 2, angle + speed * STEP / 2
    odometry.update(readings(robot, before, attitude, rate, still))
    feet = odometry.update(readings(robot, after, attitude, rate, still))
    up = rpy_matrix(*attitude).T @ [0.0, 0.0, 1.0]
    for k, leg in enumerate(robot.legs):
        frames = [robot.link_frames(one)[leg.foot] for one in (before, angle, after)]
        sphere = next(shape for shape in robot.urdf.links[leg.foot].collisions if shape.kind == "sphere")
        lowest = frames[1] @ [*sphere.position, 1.0] - sphere.size[0] * np.array([*up, 0.0])
        of_link = np.linalg.inv(frames[1]) @ lowest
        # The same point of the foot's link, half a step before and after, in the frame that the base has between them.
        places = [
            turned(rate, side * STEP / 2) @ (frame @ of_link)[:3] for side, frame in ((-1, frames[0]), (1, frames[2]))
        ]
        # The Minitaur's feet are 4.5 mm beside the planes of its legs, which kinematics leave out.
        tolerance = 4.5e-3 * np.linalg.norm(rate) if name == "minitaur" else 1e-5
        np.testing.assert_allclose(feet.velocity[0, k], -(places[1] - places[0]) / STEP, atol=tolerance)
        assert feet.height[0, k] == pytest.approx(lowest[:3] @ up, abs=1e-3 if name == "minitaur" else 5e-4)
        assert sphere.size[0] == pytest.approx(foot_radii(robot)[k])


@pytest.mark.parametrize("name", ROBOTS)
def test_standing_torques_carry_the_weight(name):
    robot, level = RobotDescription.load(name), np.zeros(3)
    angle, legs = robot.resting_angles + 0.05, robot.leg_geometry
    jacobian = legs.foot_kinematics(angle[robot.leg_motor_index]).jacobian
    force = np.array([3.0, 0.0, GRAVITY * robot.urdf.total_mass / 4]) * np.array([[0.5], [1.0], [1.5], [0.0]])
    torque = np.zeros(robot.num_motors)
    torque[robot.leg_motor_index] = -np.einsum("lim,li->lm", jacobian, force)
    feet = FootOdometry(robot).update(readings(robot, angle, level, level, torque))
    # Five-bar torques act through the sole in statics, the odometry through the sphere's centre: 4 percent.
    np.testing.assert_allclose(feet.load[0], [0.5, 1.0, 1.5, 0.0], atol=0.1)


def test_a_sole_gives_way_as_a_damped_spring():
    robot, level = RobotDescription.load("go2"), np.zeros(3)
    legs, index, odometry = robot.leg_geometry, robot.leg_motor_index, FootOdometry(robot)
    jacobian = legs.foot_kinematics(robot.resting_angles[index]).jacobian
    contact, growth, steps = robot.contact, 200.0, 400
    for k in range(steps):
        torque = np.zeros(robot.num_motors)
        torque[index] = -np.array([growth * STEP * k, 0.0, 40.0]) @ jacobian
        feet = odometry.update(readings(robot, robot.resting_angles, level, level, torque))
    # The ground pushes the feet forward ever more, so that the base goes backward over the sheared soles.
    settled = 1.0 - np.exp(-steps * STEP * contact.stiffness / (0.5 * contact.damping))
    np.testing.assert_allclose(feet.velocity[0, :, 0], -growth / contact.stiffness * settled, rtol=0.01)
    np.testing.assert_allclose(feet.velocity[0, :, 2], 0.0, atol=1e-9)


def test_readings_may_change_after_an_update():
    robot, still = RobotDescription.load("go2"), np.zeros(3)
    rows = [
        readings(robot, robot.resting_angles + 0.001 * k, still, np.full(3, 0.1 * k), np.ones(robot.num_motors))
        for k in range(2)
    ]
    expected = FootOdometry(robot)
    expected.update(rows[0])
    shared = readings(robot, robot.resting_angles, still, np.zeros(3), np.ones(robot.num_motors))
    odometry = FootOdometry(robot)
    odometry.update(shared)
    for name in ("angular_velocity_base", "motor_angle", "motor_velocity", "motor_torque"):
        getattr(shared, name)[:] = getattr(rows[1], name)
    np.testing.assert_array_equal(odometry.update(shared).velocity, expected.update(rows[1]).velocity)


def test_up_is_against_gravity():
    attitude = np.array([[0.3, -0.4, 1.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(up_direction(attitude), -gravity(attitude))
