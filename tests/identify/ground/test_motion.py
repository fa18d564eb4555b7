"""Block statistics, regression with block covariance, and fusion of IMU angles and gyro rates."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.errors import SurefootError
from surefoot.identify.ground.fits import _weight
from surefoot.identify.ground.motion import (
    STEP,
    TILT_TIME_CONSTANT,
    GroundMotion,
    _filter_tilt,
    _smooth,
    _torque_excess,
    block_deviation,
    ground_motion,
    regress,
)
from surefoot.robot import PhysicalParams, RobotDescription


def test_deviation_of_a_mean_by_blocks():
    # Two blocks with means 1 and 3: their standard deviation is sqrt(2), and sqrt(2) / sqrt(2) for their mean.
    assert block_deviation(np.array([1.0, 1.0, 3.0, 3.0]), np.array([0, 0, 1, 1])) == pytest.approx(1.0)
    # Differences within a block do not matter.
    assert block_deviation(np.array([0.0, 2.0, 2.0, 4.0]), np.array([0, 0, 1, 1])) == pytest.approx(1.0)
    assert block_deviation(np.array([1.0, 2.0]), np.array([4, 4])) == float("inf")


def test_a_regression_by_blocks():
    ones, values, blocks = np.ones((4, 1)), np.array([1.0, 1.0, 3.0, 3.0]), np.array([0, 0, 1, 1])
    estimate, covariance = regress(ones, values, blocks)
    assert estimate[0] == pytest.approx(2.0)
    # Gradients -2 and 2; two blocks minus one coefficient; H = 4.
    assert covariance[0, 0] == pytest.approx((4 + 4) * 2 / 16)


def test_a_regression_on_two_columns():
    x = np.array([-1.0, 0.0, 1.0, 2.0, 5.0])
    columns = np.stack([x, np.ones(5)], axis=1)
    estimate, covariance = regress(columns, 3.0 * x - 2.0, np.arange(5))
    np.testing.assert_allclose(estimate, [3.0, -2.0], atol=1e-12)
    np.testing.assert_allclose(covariance, 0.0, atol=1e-20)
    # A missing column is not identifiable, and does not change the others.
    with_none, _ = regress(np.column_stack([columns, np.zeros(5)]), 3.0 * x - 2.0, np.arange(5))
    np.testing.assert_allclose(with_none, [3.0, -2.0, 0.0], atol=1e-12)


def test_tilt_follows_the_gyro_at_high_and_the_imu_at_low_frequency():
    rng, time = np.random.default_rng(3), np.arange(0.0, 8.0, STEP)
    fast, slow = 0.1 * np.sin(2 * np.pi * 3 * time), 0.03
    tilt = slow + fast + rng.normal(0.0, 0.05, len(time))
    # The gyro measures the exact change between samples.
    rate = np.diff(fast, prepend=fast[0]) / STEP
    estimate = _filter_tilt(
        np.stack([tilt, np.zeros_like(tilt)], axis=1), np.stack([rate, np.zeros_like(rate)], axis=1)
    )
    error = estimate[:, 0] - slow - fast
    # The start is a mean over noise and motion; later, noise of 50 mrad is averaged over some 1000 samples.
    assert abs(error[0]) < 0.06
    assert np.abs(error[2000:]).max() < 0.012
    assert np.std(tilt - slow - fast) > 0.045
    np.testing.assert_array_equal(estimate[:, 1], 0.0)


def test_tilt_has_no_mean_error_from_a_biased_gyro():
    # With the time constant T, a rate bias b causes an angle of b T (1 - exp(-t / T)), minus its mean.
    time, bias = np.arange(0.0, 6.0, STEP), 0.01
    estimate = _filter_tilt(np.zeros((len(time), 2)), np.full((len(time), 2), bias))
    expected = bias * TILT_TIME_CONSTANT * (1 - np.exp(-(time + STEP) / TILT_TIME_CONSTANT))
    np.testing.assert_allclose(estimate[:, 0], expected - expected.mean(), atol=1e-4)
    assert abs(estimate[:, 0].mean()) < 1e-12


def test_smoothing_reproduces_cubics():
    time = np.arange(0.0, 0.2, STEP)
    values = np.stack([time**3 - time, np.full_like(time, 4.0)], axis=1)
    np.testing.assert_allclose(_smooth(values), values, atol=1e-12)
    np.testing.assert_allclose(_smooth(values, 1), np.stack([3 * time**2 - 1, 0 * time], axis=1), atol=1e-9)


def test_values_are_selected_by_phase_and_use():
    names, uses = ("stand", "nod", "nod"), ("transition", "fit", "check")
    standing = GroundMotion(np.arange(6) * 0.3, np.array([0, 0, 1, 1, 2, 2]), None, names, uses)
    assert standing.during("nod").tolist() == [False, False, True, True, False, False]
    assert standing.during("nod", uses=("check",)).tolist() == [False, False, False, False, True, True]
    assert standing.during(uses=("fit", "check")).tolist() == [False, False, True, True, True, True]
    assert not standing.during("stand").any()
    # Blocks of half a second: 0 and 0.3; 0.6 and 0.9; 1.2; 1.5.
    assert standing.blocks.tolist() == [0, 0, 1, 1, 2, 3]


def test_mean_torque_exceeds_the_report_after_a_command(robot: RobotDescription):
    """A motor turns at 1 rad/s under servo control; a state precedes each command, every 2 ms."""
    time = np.arange(100) * 0.002
    turning = np.tile((1.7 + time)[:, None], (1, 8))
    recording = SimpleNamespace(
        meta={"servo_period": 0.001}, period=0.002, time=time, arrival=time, voltage=np.full(100, 16.0),
        sent_value=np.full((100, 8), 1.82), motor_angle=turning, motor_velocity=np.ones((100, 8)),
    )  # fmt: skip
    nominal = PhysicalParams.nominal(robot)
    # In the second of two servo steps the error is 1 mrad smaller, a duty of 0.001 of 16 V, at 0.186 Ohm and 0.1 N m/A
    # up to 10 A. The mean of both exceeds the second by half of that.
    expected = 0.001 * 16 / 0.186 * 0.1 / 2
    estimate = _torque_excess(robot, recording, nominal, 0.0)
    np.testing.assert_allclose(estimate[20:], expected, rtol=1e-6)
    # A still motor has equal torques in both steps.
    still = SimpleNamespace(**vars(recording) | {"motor_angle": turning * 0, "motor_velocity": turning * 0})
    np.testing.assert_allclose(_torque_excess(robot, still, nominal, 0.0)[20:], 0.0, atol=1e-12)


def test_the_weight_is_the_force_along_a_tilted_vertical_over_its_cosine():
    # 100 N carried by a base with roll 0.3 and pitch 0.2 is 100 cos 0.3 cos 0.2 N along its own vertical.
    share = 100.0 * np.cos(0.3) * np.cos(0.2) / 4
    standing = SimpleNamespace(motion=SimpleNamespace(roll_pitch=np.array([[0.3, 0.2], [0.0, 0.0]])))
    forces = SimpleNamespace(force=np.array([[[0.0, share]] * 4, [[0.0, 25.0]] * 4]))
    np.testing.assert_allclose(_weight(standing, forces, np.array([True, True])), 100.0)


def test_ground_experiments_need_the_readings_of_all_motors(robot: RobotDescription):
    recording = SimpleNamespace(still_motors=frozenset({2}))
    with pytest.raises(SurefootError, match=f"{robot.motor_names[2]} never moves, but foot forces need"):
        ground_motion(robot, recording, PhysicalParams.nominal(robot), {})
