"""Fits to the log of a simulated robot with known parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.errors import SurefootError
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.robot_fit import find_imu_yaw, fit_robot
from surefoot.identify.motion.robot_model import robot_model
from surefoot.identify.motion.robot_unknowns import robot_params, robot_unknowns
from surefoot.identify.motion.start_search import search_start
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.robot import PhysicalParams, RobotDescription

TRUTH = {"servo_kp": 8.0, "servo_kd": 0.76, "motor_friction": 0.08, "control_latency": 0.016}
NAMES = ("servo_kp", "damping_ratio", "motor_friction", "control_latency")


@pytest.fixture(scope="module")
def hanging(pupper: RobotDescription) -> RecordedMotion:
    """One second of motion of a hip and a knee on a rack, in rows 10 ms apart."""
    time = 0.01 * np.arange(101)
    command = np.tile(np.tile([0.0, 0.6, -1.2], 4), (len(time), 1))
    command[:, 1] += 0.3 * np.sin(9 * time)
    command[:, 8] += 0.4 * np.sin(13 * time)
    blank = RecordedMotion("hanging.npz", time, command, time, rack=True)
    truth = PhysicalParams.nominal(pupper).with_values(pupper, **TRUTH)
    readings = Replayer(pupper, 1, torques=False).run(segment_from_motion(blank, pupper), truth)
    return replace(blank, motor_angle=readings.motor_angle[0])


def test_log_fit_identifies_the_true_parameters_on_a_rack(pupper: RobotDescription, hanging: RecordedMotion):
    result = fit_robot(pupper, [hanging], [], NAMES, PhysicalParams.nominal(pupper))
    for name, value in TRUTH.items():
        item = result.estimate(name)
        assert item.value == pytest.approx(value, rel=0.1), name
        assert item.interval[0] <= value <= item.interval[1], name
    (check,) = result.checks
    assert check.what == "hanging.npz, fitted: 1.0 of 1.0 s"
    assert check.after < 0.05 * check.before


def test_candidates_combine_shared_values_and_ratios(pupper: RobotDescription):
    initial = PhysicalParams.nominal(pupper)
    unknowns = robot_unknowns(pupper, initial, ["motor_friction", "friction_ratio", "damping_ratio", "motor_offset"])
    values = np.array([u.start for u in unknowns])
    at = {(u.name, u.index): k for k, u in enumerate(unknowns)}
    values[at["motor_friction", None]], values[at["friction_ratio", 4]] = 0.1, 1.5
    values[at["damping_ratio", None]], values[at["motor_offset", 2]] = 0.08, 0.05
    params = robot_params(initial, unknowns, values[None])
    np.testing.assert_allclose(params.motor_friction[0], [0.1] * 4 + [0.15] + [0.1] * 7)
    np.testing.assert_allclose(params.servo_kd, 0.08 * initial.servo_kp)
    assert params.motor_offset[0].tolist() == [0, 0, 0.05, *[0] * 9]


def test_log_fit_rejects_unknown_names_no_logs_and_dc_motors(pupper: RobotDescription, hanging: RecordedMotion):
    initial = PhysicalParams.nominal(pupper)
    with pytest.raises(SurefootError, match="logs can't identify 'voltage'; choices: servo_kp"):
        fit_robot(pupper, [hanging], [], ["voltage"], initial)
    with pytest.raises(SurefootError, match="there are no logs to fit"):
        fit_robot(pupper, [], [hanging], None, initial)
    minitaur = RobotDescription.load("minitaur")
    with pytest.raises(SurefootError, match="motors of minitaur are of kind dc"):
        fit_robot(minitaur, [hanging], [], None, PhysicalParams.nominal(minitaur))


def test_search_reduces_the_cost_over_shared_unknowns(pupper: RobotDescription, hanging: RecordedMotion):
    initial, progress = PhysicalParams.nominal(pupper), []
    model = robot_model(
        pupper,
        [hanging.first_seconds(0.5)],
        robot_unknowns(pupper, initial, ["servo_kp", "motor_offset"]),
        initial,
    )
    start = np.array([unknown.start for unknown in model.unknowns])
    result = search_start(model, 2, 1, lambda step, cost: progress.append((step, cost)))
    before, after = (float(np.sum(model.residuals(one[None]) ** 2)) for one in (start, result))
    assert after < before
    # Unknowns of single motors are left to the fit.
    assert result[0] != start[0]
    assert np.array_equal(result[1:], start[1:])
    assert [step for step, _ in progress] == ["search, generation 1", "search, generation 2"]
    assert progress[1][1] <= progress[0][1]
    assert np.array_equal(result, search_start(model, 2, 1, lambda *_: None))
    with pytest.raises(SurefootError, match="--generations searches over parameters that all motors share"):
        fit_robot(pupper, [hanging], [], ["motor_offset"], initial, search=2)


@pytest.fixture(scope="module")
def tilting(pupper: RobotDescription, hanging: RecordedMotion) -> RecordedMotion:
    """Half a second on the ground, with the IMU turned by half a turn: the left legs bend, so it rolls and pitches."""
    truth, first = PhysicalParams.nominal(pupper).rows(np.zeros(1, np.int64)), hanging.first_seconds(0.5)
    truth.imu_mount[0, 2] = np.pi
    command = first.command.copy()
    command[:, 2::6] -= 0.4 * np.linspace(0, 1, len(command))[:, None]
    blank = replace(first, command=command, rack=False)
    readings = Replayer(pupper, 1, rack=False, torques=False).run(segment_from_motion(blank, pupper), truth)
    attitude, rates = readings.imu[0, :, :3], readings.imu[0, :, 3:]
    return replace(blank, motor_angle=readings.motor_angle[0], roll_pitch_yaw=attitude, angular_velocity_base=rates)


def without_tilt(log: RecordedMotion, rows: list[int]) -> RecordedMotion:
    """Return a log whose IMU sent nothing in some rows."""
    attitude = log.roll_pitch_yaw.copy()
    attitude[rows] = np.nan
    return replace(log, roll_pitch_yaw=attitude)


def test_yaw_of_the_imu_is_identified(pupper: RobotDescription, hanging: RecordedMotion, tilting: RecordedMotion):
    nominal = PhysicalParams.nominal(pupper)
    assert np.ptp(tilting.imu[:, :2], axis=0).min() > 0.01
    assert find_imu_yaw(pupper, [tilting], nominal) == np.pi
    assert find_imu_yaw(pupper, [hanging], nominal) is None
    assert find_imu_yaw(pupper, [without_tilt(tilting, [0, 20])], nominal) == np.pi
    assert find_imu_yaw(pupper, [without_tilt(tilting, list(range(len(tilting.time))))], nominal) is None


def test_a_missing_reading_of_the_imu_is_left_out_of_the_fit(pupper: RobotDescription, tilting: RecordedMotion):
    truth = PhysicalParams.nominal(pupper).rows(np.zeros(1, np.int64))
    truth.imu_mount[0, 2] = np.pi
    unknowns = robot_unknowns(pupper, truth, ["servo_kp"])
    start = np.array([unknown.start for unknown in unknowns])
    for rows in ([], [30], list(range(len(tilting.time)))):
        model = robot_model(pupper, [without_tilt(tilting, rows)], unknowns, truth)
        residuals = model.residuals(start[None])[0]
        assert np.abs(residuals).max() < 0.1  # the true robot
