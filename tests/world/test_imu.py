"""IMUs that are not aligned with the base: attitudes and rates worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.world.actuation import rotate_to_imu
from surefoot.world.sim_world import SimWorld

QUARTER = np.pi / 2


def test_an_imu_rotated_by_90_degrees_about_z_reads_roll_as_pitch():
    # Its x axis is the base's y axis: a base that rolls by 0.1 has an IMU that pitches by -0.1.
    attitude, rates = np.array([[0.1, 0.0, 0.0]]), np.array([[1.0, 2.0, 3.0]])
    rotate_to_imu(attitude, rates, np.array([[0.0, 0.0, QUARTER]]))
    np.testing.assert_allclose(attitude, [[0.0, -0.1, QUARTER]], atol=1e-12)
    np.testing.assert_allclose(rates, [[2.0, -1.0, 3.0]], atol=1e-12)


def test_small_mounting_errors_add_to_a_level_attitude():
    mount = np.array([[0.01, 0.0, 0.0], [0.0, -0.02, 0.0], [0.0, 0.0, 0.03]])
    attitude = np.zeros((3, 3))
    rotate_to_imu(attitude, np.zeros((3, 3)), mount)
    np.testing.assert_allclose(attitude, mount, atol=1e-12)


def test_each_robot_has_its_own_imu_mounting(make_world):
    mount = np.array([[0.0, 0.0, 0.0], [0.02, -0.01, 0.0]])
    world: SimWorld = make_world(2, imu_mount=mount)
    for _ in range(20):
        readings = world.step(world.resting_angles)
    truth = world.truth().roll_pitch_yaw
    np.testing.assert_allclose(readings.roll_pitch_yaw[0], truth[0], atol=2e-3)
    np.testing.assert_allclose(readings.roll_pitch_yaw[1] - readings.roll_pitch_yaw[0], mount[1], atol=5e-4)


def test_the_yaw_of_an_imu_drifts_with_the_bias_of_its_gyro(make_world):
    world: SimWorld = make_world(2, imu_yaw_drift=[0.0, 0.1])
    for _ in range(50):
        readings = world.step(world.resting_angles)
    yaw = readings.roll_pitch_yaw[:, 2]
    assert yaw[1] - yaw[0] == pytest.approx(0.1 * readings.time[1])
    assert readings.angular_velocity_base[1, 2] - readings.angular_velocity_base[0, 2] == pytest.approx(0.1)
