"""A fit to the log of a simulated robot finds the robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.errors import SurefootError
from surefoot.identify.log_fit import fit_logs
from surefoot.identify.log_model import LogRun, params_of_logs, unknowns_of
from surefoot.identify.replay import Replayer, stretch_of_log
from surefoot.identify.robot_log import RobotLog
from surefoot.robot import PhysicalParams, RobotDescription

TRUTH = {"servo_kp": 8.0, "servo_kd": 0.76, "motor_friction": 0.08, "control_latency": 0.016}
NAMES = ("servo_kp", "damping_ratio", "motor_friction", "control_latency")


@pytest.fixture(scope="module")
def pupper() -> RobotDescription:
    return RobotDescription.load("pupper_v2")


@pytest.fixture(scope="module")
def hanging(pupper: RobotDescription) -> RobotLog:
    """One second of a hip and a knee on a rack, read every 10 ms."""
    time = 0.01 * np.arange(101)
    command = np.tile(np.tile([0.0, 0.6, -1.2], 4), (len(time), 1))
    command[:, 1] += 0.3 * np.sin(9 * time)
    command[:, 8] += 0.4 * np.sin(13 * time)
    blank = RobotLog(
        "hanging.npz", time, command, time, np.full((len(time), 12), np.nan), np.full((len(time), 4), np.nan)
    )
    truth = PhysicalParams.nominal(pupper).with_values(pupper, **TRUTH)
    told = Replayer(pupper, 1, torques=False).run(stretch_of_log(blank, pupper), truth)
    return replace(blank, motor_angle=told.motor_angle[0])


def test_a_robot_on_its_rack_is_found(pupper: RobotDescription, hanging: RobotLog):
    found = fit_logs(pupper, [LogRun(hanging, True)], [], NAMES, PhysicalParams.nominal(pupper))
    for name, value in TRUTH.items():
        item = found.estimate(name)
        assert item.value == pytest.approx(value, rel=0.1), name
        assert item.interval[0] <= value <= item.interval[1], name
    (check,) = found.checks
    assert check.what == "hanging.npz, fitted"
    assert check.after < 0.05 * check.before


def test_what_motors_have_of_their_own_is_around_what_they_share(pupper: RobotDescription):
    known = PhysicalParams.nominal(pupper)
    unknowns = unknowns_of(pupper, known, ["motor_friction", "friction_ratio", "damping_ratio", "motor_offset"])
    values = np.array([u.start for u in unknowns])
    at = {(u.name, u.index): k for k, u in enumerate(unknowns)}
    values[at["motor_friction", None]], values[at["friction_ratio", 4]] = 0.1, 1.5
    values[at["damping_ratio", None]], values[at["motor_offset", 2]] = 0.08, 0.05
    params = params_of_logs(known, unknowns, values[None])
    np.testing.assert_allclose(params.motor_friction[0], [0.1] * 4 + [0.15] + [0.1] * 7)
    np.testing.assert_allclose(params.servo_kd, 0.08 * known.servo_kp)
    assert params.motor_offset[0].tolist() == [0, 0, 0.05, *[0] * 9]


def test_what_can_t_be_fitted_is_refused(pupper: RobotDescription, hanging: RobotLog):
    known = PhysicalParams.nominal(pupper)
    with pytest.raises(SurefootError, match="logs do not tell 'voltage'; choices: servo_kp"):
        fit_logs(pupper, [LogRun(hanging, True)], [], ["voltage"], known)
    with pytest.raises(SurefootError, match="there are no logs to fit"):
        fit_logs(pupper, [], [LogRun(hanging, True)], None, known)
    minitaur = RobotDescription.load("minitaur")
    with pytest.raises(SurefootError, match="motors of minitaur are of kind dc"):
        fit_logs(minitaur, [LogRun(hanging, True)], [], None, PhysicalParams.nominal(minitaur))
