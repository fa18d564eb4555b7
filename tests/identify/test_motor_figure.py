"""Simulated motors that follow a log with each actuator model, and the log's file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.identify.motor_figure import MotorLog, motor_index, run_motor_experiment
from surefoot.robot import RobotDescription
from surefoot.world.sim_world import SimWorld

MOTOR = "front_left_1_motor"


def step_log(robot: RobotDescription, size: float, duration: float = 0.3) -> MotorLog:
    """Return a log with a constant target `size` [rad] away from the resting pose, sampled every servo step."""
    time = np.arange(round(duration / 0.001) + 1) * 0.001
    rest = float(robot.resting_angles[robot.motor_names.index(MOTOR)])
    return MotorLog("step", time, np.full(len(time), rest + size), np.full(len(time), np.nan))


def follow(robot: RobotDescription, log: MotorLog, **params: float) -> dict[str, np.ndarray]:
    return run_motor_experiment(robot, SimWorld, log, motor_index(robot, MOTOR), params)


def test_sine_has_its_known_targets() -> None:
    log = MotorLog.sine(2.0, 0.3, 2.5, 0.4, 0.1)
    np.testing.assert_allclose(log.time, [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(log.target, [2.0, 2.3, 2.0, 1.7, 2.0])
    assert np.isnan(log.angle).all()


def test_error_is_relative_to_measured_angles_or_targets(robot: RobotDescription) -> None:
    log, angle = step_log(robot, 0.1, 0.01), np.linspace(0.0, 0.1, 11)
    # Without measurements, the error is relative to the targets.
    assert log.error(angle) == pytest.approx(np.sqrt(np.mean((angle - log.target) ** 2)))
    # With measurements, only measured rows count.
    measured = np.where(np.arange(len(angle)) < 3, angle + 0.03, np.nan)
    assert replace(log, angle=measured).error(angle) == pytest.approx(0.03)


def test_a_constraint_motor_approaches_its_target_with_its_time_constant(robot: RobotDescription) -> None:
    # k_d / k_p + dt = 16 ms: after n steps (15 / 16)^n of a small error remains, independent of inertia.
    size = 0.02
    log = step_log(robot, size, 0.05)
    angle = follow(robot, log)["constraint"]
    steps = np.arange(len(angle))
    # The first target is held while the motor comes to rest, so the first angle already equals the target.
    np.testing.assert_allclose(angle, log.target, atol=1e-4)
    # Later targets start from there.
    target = np.where(steps < 1, log.target[0], log.target[0] + size)
    angle = follow(robot, replace(log, target=target))["constraint"]
    left = (15 / 16) ** np.maximum(steps - 1, 0)
    np.testing.assert_allclose(target[-1] - angle, size * left, atol=3e-4)


def test_physical_parameters_reach_the_models(robot: RobotDescription) -> None:
    log = MotorLog.sine(2.0, 0.3, 3.0, 0.4, 0.006)
    free, slowed = (follow(robot, log, motor_friction=friction)["dc"] for friction in (0.0, 0.3))
    assert np.ptp(slowed) < 0.95 * np.ptp(free)


def test_a_log_is_written_and_read(tmp_path: Path) -> None:
    log = MotorLog("x", np.array([0.0, 0.01]), np.array([1.0, 2.0]), np.array([1.5, 1.75]))
    again = MotorLog.read(log.write(tmp_path / "logs" / "motor.csv"))
    for name in ("time", "target", "angle"):
        np.testing.assert_allclose(getattr(again, name), getattr(log, name), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has 0 columns and 0 rows"),
        ("time,angle\n0,1\n", "takes time, target, angle"),
        ("time,target,angle\n0,1,1\n0.1,x,1\n", "must be finite"),
        ("time,target,angle\n0,1\n0.1,1,1\n", "line 2 has 2 values; the first line names 3"),
        ("time,target,angle\n0,1,1\n", "has 1 rows"),
        ("time,target,angle\n0,1,1\n0,1,1\n", "times must rise"),
        ("time,target,angle\n0,nan,1\n1,1,1\n", "must be finite"),
        ("time,target,angle\n0,1,1\n5e9,1,1\n", "is 5e\\+09 s long, at most 600 s; are its times in seconds"),
    ],
)
def test_a_table_that_is_not_a_motor_log_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(SurefootError, match=message):
        MotorLog.read(path)


def test_motor_figure_rejects_a_missing_log_and_motor(tmp_path: Path, robot: RobotDescription) -> None:
    with pytest.raises(SurefootError, match="can't be read"):
        MotorLog.read(tmp_path / "none.csv")
    with pytest.raises(SurefootError, match="motor 'tail' does not exist; choices: front_left_2_motor"):
        motor_index(robot, "tail")
