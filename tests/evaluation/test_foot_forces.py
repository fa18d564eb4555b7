"""Ground reaction forces from motor torques: by hand, by the principle of virtual work, and of standing robots."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.evaluation.foot_forces import foot_forces
from surefoot.robot import RobotDescription
from surefoot.rotations import quat_matrix
from surefoot.world.sim_world import SimWorld

ROBOTS = RobotDescription.available()


def feet(robot: RobotDescription, angles: np.ndarray) -> np.ndarray:
    """Return the feet (..., L, 3) [m] from the legs' mounts for the angles of all motors (..., M)."""
    return robot.leg_geometry.foot_position(angles[..., robot.leg_motor_index])


@pytest.mark.parametrize("name", ROBOTS)
def test_motor_torques_balance_a_force_by_virtual_work(name: str):
    """Torques for a force are computed from the power of slow movements, without the legs' Jacobians."""
    robot = RobotDescription.load(name)
    angles = robot.resting_angles + np.array([[0.0], [0.05], [-0.1]])
    forces = np.tile([3.0, 0.0 if len(robot.coordinates) == 2 else -2.0, 11.0], (3, len(robot.legs), 1))
    torques = np.zeros_like(angles)
    for motor in range(robot.num_motors):
        moved = np.zeros(robot.num_motors)
        moved[motor] = 1e-5
        shift = (feet(robot, angles + moved) - feet(robot, angles - moved)) / 2e-5
        torques[:, motor] = -np.einsum("tli,tli->t", shift, forces)
    np.testing.assert_allclose(foot_forces(robot, angles, torques), forces, atol=1e-5)


def test_a_leg_without_readings_has_no_force():
    robot = RobotDescription.load("go2")
    angles, torques = np.tile(robot.resting_angles, (2, 1)), np.ones((2, robot.num_motors))
    angles[0, robot.leg_motor_index[1, 0]] = torques[1, robot.leg_motor_index[2, 2]] = np.nan
    finite = np.isfinite(foot_forces(robot, angles, torques)).all(axis=-1)
    assert finite.tolist() == [[True, False, True, True], [True, True, False, True]]


def test_a_straight_leg_has_no_force_along_itself():
    robot = RobotDescription.load("solo8")
    straight = robot.pose_angles(0.0, 1.0)
    force = foot_forces(robot, straight, np.full(robot.num_motors, 0.1))
    assert np.isfinite(force).all()
    assert np.abs(force).max() < 10.0


@pytest.mark.parametrize(("name", "share"), [("minitaur", 0.90), ("go2", 0.94), ("pupper_v2", 0.81), ("solo8", 0.89)])
def test_feet_of_a_standing_robot_carry_its_weight_without_the_legs(name: str, share: float):
    robot = RobotDescription.load(name)
    world = SimWorld(robot, 1)
    for _ in range(350):
        world.step(world.resting_angles)
    truth = world.truth()
    force = foot_forces(robot, truth.motor_angle[0], truth.motor_torque[0])
    upward = (force @ quat_matrix(truth.base_quat_world[0])[2]).sum()
    assert upward / robot.weight == pytest.approx(share, abs=0.02)
