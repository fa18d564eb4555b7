"""Notes on implausible units, computed clocks and repeated commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.identify.motion.log_checks import check_log
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.robot import RobotDescription

COMPUTED_CLOCK = "these times look computed, not measured: errors of the clock can't be distinguished from delay"


@pytest.fixture
def go2() -> RobotDescription:
    return RobotDescription.load("go2")


@pytest.fixture
def log() -> RecordedMotion:
    draw = np.random.default_rng(1)
    time = 0.01 * np.arange(301) + draw.uniform(0, 1e-3, 301)
    angle = np.tile([0.0, 0.9, -1.8], 4) + 0.2 * np.sin(4 * time)[:, None]
    return RecordedMotion("log", time, angle, time, angle)


def test_a_plausible_log_has_no_notes(log: RecordedMotion, go2: RobotDescription):
    assert check_log(log, go2) == []


def test_angles_outside_limits_and_times_in_another_unit_are_noted(log: RecordedMotion, go2: RobotDescription):
    (note,) = check_log(replace(log, motor_angle=np.radians(log.motor_angle)), go2)
    assert note.startswith("FR_calf_joint goes from -0.03 to -0.03 rad, outside its limits -2.72 to -0.84")
    (note,) = check_log(replace(log, time=1e-3 * log.time), go2)
    assert note == "301 rows in 0.003 s: is the unit of time right?"
    (note,) = check_log(replace(log, time=1e3 * log.time), go2)
    assert note == "301 rows in 3e+03 s: is the unit of time right?"


def test_computed_times_and_repeated_commands_are_noted(log: RecordedMotion, go2: RobotDescription):
    assert check_log(replace(log, time=0.01 * np.arange(301)), go2) == [COMPUTED_CLOCK]
    # Computed times in single precision also count as computed.
    assert check_log(replace(log, time=np.linspace(0, 3, 301, dtype=np.float32).astype(float)), go2) == [COMPUTED_CLOCK]
    repeated = np.repeat(log.command[::4], 4, axis=0)[:301]
    assert check_log(replace(log, command=repeated), go2) == ["75 % of the commands repeat the previous row"]
