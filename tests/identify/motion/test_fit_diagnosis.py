"""A fit that is no better than the baseline of a delayed command does not explain its log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.identify.motion.fit_diagnosis import _column_hints, diagnose_fit, following_error
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.robot import PhysicalParams, RobotDescription


@pytest.fixture(scope="module")
def log(pupper: RobotDescription) -> RecordedMotion:
    time = 0.01 * np.arange(151)
    command = np.tile(np.tile([0.0, 0.6, -1.2], 4), (len(time), 1))
    command[:, 1] += 0.3 * np.sin(9 * time)
    command[:, 4] += 0.3 * np.sin(13 * time)
    blank = RecordedMotion("log.npz", time, command, time, rack=True)
    readings = Replayer(pupper, 1, torques=False).run(
        segment_from_motion(blank, pupper), PhysicalParams.nominal(pupper)
    )
    return replace(blank, motor_angle=readings.motor_angle[0])


def test_the_true_robot_explains_its_log(pupper: RobotDescription, log: RecordedMotion):
    assert diagnose_fit(pupper, [log], PhysicalParams.nominal(pupper)) == ()


def test_the_baseline_has_the_error_that_no_delay_removes():
    time = 0.01 * np.arange(400)
    command = np.sin(3 * time)[:, None]
    late = np.interp(time - 0.1, time, command[:, 0])[:, None]
    motion = RecordedMotion("log", time, command, time, late)
    assert following_error(motion) < 1e-6
    assert following_error(replace(motion, motor_angle=late + 0.02)) == pytest.approx(0.02, abs=0.003)


def test_wrong_signs_and_orders_are_named(pupper: RobotDescription, log: RecordedMotion):
    angles = log.motor_angle.copy()
    angles[:, 1] *= -1
    (hint,) = _column_hints(pupper, replace(log, motor_angle=angles))
    assert hint == "the angle of rightFrontUpperLegMotor moves against its command: is its sign right?"
    angles = log.motor_angle.copy()
    angles[:, [1, 4]] = angles[:, [4, 1]]
    first, second = _column_hints(pupper, replace(log, motor_angle=angles))
    names = "rightFrontUpperLegMotor", "leftFrontUpperLegMotor"
    assert first == "the angle of {} follows the command of {}: is the order of joints right?".format(*names)
    assert second == "the angle of {1} follows the command of {0}: is the order of joints right?".format(*names)
    reason, *hints = diagnose_fit(pupper, [replace(log, motor_angle=angles)], PhysicalParams.nominal(pupper))
    assert reason.startswith("the fitted robot does not reproduce these logs")
    assert first in hints


def test_a_log_without_angles_does_not_hide_a_bad_fit(pupper: RobotDescription, log: RecordedMotion):
    angles = log.motor_angle.copy()
    angles[:, [1, 4]] = angles[:, [4, 1]]
    bad, blind = replace(log, motor_angle=angles), replace(log, motor_angle=np.full_like(angles, np.nan))
    nominal = PhysicalParams.nominal(pupper)
    assert diagnose_fit(pupper, [bad, blind], nominal)[0].startswith("the fitted robot does not reproduce these logs")
    assert diagnose_fit(pupper, [blind, bad], nominal) == diagnose_fit(pupper, [bad, blind], nominal)
    assert diagnose_fit(pupper, [blind], nominal) == ()
