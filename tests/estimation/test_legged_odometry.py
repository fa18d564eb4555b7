"""Known answers of the velocity filter: Minitaurs with pointed feet whose motor angles follow from their motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.arrays import Array
from surefoot.estimation.interface import MotionReadings, VelocityEstimate
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.robot import GRAVITY, FiveBar, RobotDescription

DT = 0.01
HEIGHT = 0.2


def pointed_robot() -> RobotDescription:
    """Return a Minitaur whose feet do not roll."""
    robot = RobotDescription.load("minitaur")
    assert isinstance(robot.leg_geometry, FiveBar)
    return replace(robot, leg_geometry=replace(robot.leg_geometry, foot_radius=0.0))


ROBOT = pointed_robot()


def readings(
    foot: Array, carries: Array, torque_scale: float = 1.0, pitch: float = 0.0, rate: float = 0.0
) -> MotionReadings:
    """Return readings with feet (4, 3) [m] from the mounts, of which some (4,) share the weight."""
    legs, index = ROBOT.leg_geometry, ROBOT.leg_motor_index
    angles = legs.to_motors(legs.foot_pose(foot))
    up = np.array([-np.sin(pitch), 0.0, np.cos(pitch)])
    force = up * (carries / max(carries.sum(), 1.0))[:, None] * ROBOT.weight * torque_scale
    angle, torque = np.zeros((2, 1, ROBOT.num_motors))
    angle[0, index], torque[0, index] = angles, -np.einsum("lim,li->lm", legs.foot_kinematics(angles).jacobian, force)
    return MotionReadings(
        duration=np.array([DT]),
        roll_pitch_yaw=np.array([[0.0, pitch, 0.0]]),
        angular_velocity_base=np.array([[0.0, rate, 0.0]]),
        motor_angle=angle,
        motor_velocity=np.zeros_like(angle),
        motor_torque=torque,
    )


def feet_at(x: Array | float, height: float = HEIGHT) -> Array:
    """Return feet (4, 3) [m] at x (4,) forward of their mounts, below them by a height."""
    return np.stack([np.broadcast_to(x, 4), np.zeros(4), np.full(4, -height)], axis=-1)


ALL = np.ones(4)


def run(rows: list[MotionReadings]) -> VelocityEstimate:
    """Return the estimate after readings."""
    estimator = LeggedOdometry(ROBOT)
    for row in rows:
        estimate = estimator.update(row)
    return estimate


def test_a_standing_robot_does_not_move_and_knows_its_height():
    estimate = run([readings(feet_at(0.0), ALL)] * 50)
    np.testing.assert_allclose(estimate.velocity_base, 0.0, atol=1e-3)
    assert estimate.height[0] == pytest.approx(HEIGHT - ROBOT.leg_mounts[0, 2], abs=1e-3)
    assert estimate.contact.min() > 0.7
    # The covariance of a constant motion that four feet measure is below the noise of one of them.
    assert 0.0 < np.sqrt(estimate.covariance[0, 0, 0]) < 0.1
    np.testing.assert_array_equal(estimate.covariance[0] * (1 - np.eye(3)), 0.0)


@pytest.mark.parametrize("speed", [0.4, -0.2])
def test_standing_feet_give_the_speed_exactly(speed):
    rows = [readings(feet_at(0.04 - speed * DT * k, HEIGHT + 0.05 * DT * k), ALL) for k in range(30)]
    estimate = run(rows)
    np.testing.assert_allclose(estimate.velocity_base[0], [speed, 0.0, 0.05], atol=2e-3)


def test_swinging_feet_without_load_do_not_count():
    stands = np.array([1.0, 0.0, 0.0, 1.0])
    rows = [
        readings(feet_at(np.where(stands > 0, 0.03, -0.03) - np.where(stands > 0, 0.3, -0.6) * DT * k), stands)
        for k in range(20)
    ]
    estimate = run(rows)
    assert estimate.velocity_base[0, 0] == pytest.approx(0.3, abs=0.02)
    np.testing.assert_allclose(estimate.contact[0] > 0.5, stands > 0)


def test_a_slipping_foot_among_three_is_rejected():
    carries, start = np.array([1.0, 1.0, 1.0, 0.0]), 20
    rows = []
    for k in range(40):
        slipped = np.array([0.0, 1.0, 0.0, 0.0]) * 1.0 * DT * max(k - start, 0)
        rows.append(readings(feet_at(0.04 - 0.2 * DT * k + slipped), carries))
    estimate = run(rows)
    assert estimate.velocity_base[0, 0] == pytest.approx(0.2, abs=0.02)
    assert estimate.contact[0, 1] < 0.1 < 0.8 < estimate.contact[0, 0]


def test_a_turning_base_over_standing_feet():
    # The base pitches about the feet's height: its origin goes forward with the height times the rate.
    rate = 0.5
    rows = []
    for k in range(20):
        pitch = rate * DT * k
        place = ROBOT.leg_mounts + feet_at(0.0)
        centre = np.array([0.0, 0.0, -HEIGHT])
        cos, sin = np.cos(pitch), np.sin(pitch)
        # In the base frame: the world turned back about the point below the base.
        back = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
        rows.append(readings((place - centre) @ back.T + centre - ROBOT.leg_mounts, ALL, pitch=pitch, rate=rate))
    estimate = run(rows)
    # The torques here act through the foot's tip, in the odometry through its centre, so that soles seem to give way.
    np.testing.assert_allclose(estimate.velocity_base[0, 0], rate * HEIGHT, atol=4e-3)


def test_a_robot_in_flight_falls_freely():
    moving = [readings(feet_at(0.04 - 0.3 * DT * k), ALL) for k in range(20)]
    flying = [readings(feet_at(0.02), np.zeros(4))] * 10
    estimate = run(moving + flying)
    np.testing.assert_allclose(estimate.velocity_base[0], [0.3, 0.0, -GRAVITY * 10 * DT], atol=0.1)
    assert estimate.covariance[0, 0, 0] > 4 * run(moving).covariance[0, 0, 0]


def test_an_accelerometer_is_integrated_in_flight():
    flying = replace(readings(feet_at(0.02), np.zeros(4)), accelerometer=np.array([[2.0, -1.0, GRAVITY]]))
    estimate = run([readings(feet_at(0.0), ALL)] * 20 + [flying] * 20)
    np.testing.assert_allclose(estimate.velocity_base[0], [0.4, -0.2, 0.0], atol=0.03)


def test_robots_of_a_batch_do_not_affect_each_other():
    one, other = readings(feet_at(0.02), ALL), readings(feet_at(0.0), np.array([1.0, 0.0, 0.0, 1.0]))
    both = MotionReadings(
        **{
            name: np.concatenate([getattr(one, name), getattr(other, name)])
            for name in vars(one)
            if getattr(one, name) is not None
        }
    )
    batch, single = LeggedOdometry(ROBOT, 2), LeggedOdometry(ROBOT)
    for _ in range(3):
        estimate, alone = batch.update(both), single.update(other)
    np.testing.assert_allclose(estimate.contact[1], alone.contact[0], rtol=1e-9)


def test_a_leg_that_cannot_close_and_torques_that_are_unknown_are_left_out():
    rows = [readings(feet_at(0.0), ALL) for _ in range(5)]
    angle = rows[-1].motor_angle.copy()
    angle[0, ROBOT.leg_motor_index[0]] = np.nan
    unknown = replace(rows[-1], motor_angle=angle, motor_torque=np.full((1, ROBOT.num_motors), np.nan))
    estimate = run([*rows, unknown])
    assert np.isfinite(estimate.velocity_base).all()
    assert np.isfinite(estimate.height).all()
    assert estimate.contact[0, 0] == 0.0 < 0.3 < estimate.contact[0, 1]
