"""What a robot tells that hangs still."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.identify.fits.motor import LEVEL, VOLTAGE, imu_estimates, rest_voltage
from surefoot.identify.recording import Recording


def still(roll: float, pitch: float, noise: float, count: int = 20_000) -> SimpleNamespace:
    tilt = np.random.default_rng(1).normal([roll, pitch, 9.0], noise, (count, 3))
    return SimpleNamespace(roll_pitch_yaw=tilt)


def test_bias_and_noise_of_the_imu():
    roll, pitch, noise = imu_estimates(still(0.03, -0.05, 0.01))
    assert [(e.name, e.index, e.unit) for e in (roll, pitch)] == [("imu_bias", 0, "rad"), ("imu_bias", 1, "rad")]
    assert roll.value == pytest.approx(0.03, abs=3e-4)
    assert pitch.value == pytest.approx(-0.05, abs=3e-4)
    # What a mean of so many is known to is nothing beside how level the rack is.
    assert roll.deviation == pytest.approx(np.hypot(LEVEL, 0.01 / np.sqrt(20_000)), rel=1e-2)
    assert (noise.name, noise.index) == ("imu_noise", None)
    assert noise.value == pytest.approx(0.01, rel=0.02)
    assert noise.interval[0] < 0.01 < noise.interval[1]


def test_an_imu_without_noise():
    noise = imu_estimates(still(0.0, 0.0, 0.0))[2]
    assert (noise.value, noise.interval[0]) == (0.0, 0.0)
    assert 0 < noise.interval[1] < 1e-4


def test_the_battery_is_looked_at_before_motors_move():
    recording = SimpleNamespace(voltage=np.array([15.8, 15.9, 14.0, 13.0]), meta={"resting_states": 2})
    estimate = rest_voltage(recording)
    assert estimate.value == pytest.approx(15.85)
    assert estimate.deviation == VOLTAGE
    assert rest_voltage(SimpleNamespace(voltage=recording.voltage, meta={"resting_states": 0})).value == 15.8


def test_an_emulated_robot(recorded: Recording):
    roll, pitch, noise = imu_estimates(recorded)
    assert abs(roll.value) < 1e-3
    assert abs(pitch.value) < 1e-3
    assert noise.value < 1e-3
    assert rest_voltage(recorded).value == pytest.approx(16.0, abs=0.02)
