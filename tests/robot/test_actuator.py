"""Data of motors."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.robot import RobotDescription


def test_heat_is_that_of_the_current_in_the_torque_table():
    # 1.9 N m take 20 A, 1.45 N m half way between 10 and 20 A; R is .186 Ohm.
    motors = RobotDescription.load("minitaur").actuator
    np.testing.assert_allclose(motors.heat(np.array([0.0, 1.9, -1.9, 1.45])), 0.186 * np.array([0, 20, 20, 15]) ** 2)


def test_heat_of_a_drive_grows_with_the_square_of_its_torque():
    drive = RobotDescription.load("pupper_v2").actuator  # 1.1 N m up to 10 rad/s; half of that is heat at full torque
    heat = drive.heat(np.array([1.1, 0.55]))
    assert heat == pytest.approx([5.5, 1.375])
