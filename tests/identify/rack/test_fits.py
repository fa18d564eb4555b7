"""Fits on a rack: responses to spikes of torque with known delays, and readings at rest."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.deploy.messages import Mode
from surefoot.identify.rack.fits import RACK_TILT, VOLTAGE_DEVIATION, estimate_imu, estimate_voltage, measure_spikes
from surefoot.identify.recording import Recording

PERIOD, EVERY, SPIKES, MOTORS = 0.002, 0.12, 12, 8
TRANSMISSION_TIME = 0.0013
"""Time that a command takes to come [s]; states take as long to go."""
STEP = 2 * np.pi / 2**14


def answered(age: float, speed: float = 5.0, moving: int = MOTORS, noise: float = 1.0, seed: int = 0) -> Recording:
    """Spikes of one command to and fro, which motors answer as free ones do, then brake; states report it `age` later.

    From 0 to T a motor's way is v t^2 / 2 T, later v (t - T / 2) - c (t - T)^2 until it stands. Odd motors go the other
    way round.
    """
    rng = np.random.default_rng(seed)
    count = round(SPIKES * EVERY / PERIOD)
    sent = 0.5 + PERIOD * np.arange(count)
    # The servo's next step begins when the robot's clock shows a multiple of 1 ms: a spike acts from there.
    came = sent + TRANSMISSION_TIME
    value = np.zeros((count, MOTORS))
    driven = np.arange(0, count, round(EVERY / PERIOD))
    height = 0.4 * np.where(np.arange(MOTORS) % 2 == 0, 1.0, -1.0) * np.where(np.arange(MOTORS) < moving, 1.0, 0.0)
    state_time = came[0] - 0.0203 + PERIOD * np.arange(count + 20)
    angle, rate = np.full((len(state_time), MOTORS), 1.7), np.zeros((len(state_time), MOTORS))
    for k, c in enumerate(driven):
        turned = height * (1.0 if k % 2 == 0 else -1.0)
        value[c] = turned if moving else 0.4
        begin = np.ceil(came[c] / 0.001 - 1e-6) * 0.001
        length = np.ceil(came[c + 1] / 0.001 - 1e-6) * 0.001 - begin
        since = np.maximum(state_time - age - begin, 0.0)
        brakes = np.clip(since - length, 0.0, 0.05)
        slowing = speed / 0.05
        way = np.where(since < length, since**2 / (2 * length), 0.0) * speed
        way = np.where(since < length, way, speed * (length / 2 + brakes) - slowing * brakes**2 / 2)
        now = np.where(since < length, speed * since / length, speed - slowing * brakes)
        angle += way[:, None] * np.sign(turned)
        rate += now[:, None] * np.sign(turned)
    angle = np.round((angle + noise * 1e-4 * rng.normal(size=angle.shape)) / STEP) * STEP
    rate = rate + noise * 0.05 * rng.normal(size=rate.shape)
    numbers = np.arange(count) + 100.0
    obeyed = np.searchsorted(came, state_time + 1e-9, side="right") - 1
    nothing = np.zeros((len(state_time), MOTORS))
    meta: dict[str, Any] = {
        "servo_period": 0.001,
        "phases": [{"name": "spikes", "mode": int(Mode.PWM), "use": "fit", "duration": SPIKES * EVERY}],
    }
    return Recording(
        sent_number=numbers, sent_time=sent, sent_phase=np.zeros(count), sent_value=value, time=state_time,
        host_time=state_time + 0.0017, mode=np.full(len(state_time), 2.0),
        command=np.where(obeyed < 0, 0.0, numbers[obeyed]),
        command_age=np.maximum(state_time - came[obeyed], 0.0), motor_angle=angle, motor_velocity=rate,
        motor_torque=nothing, roll_pitch_yaw=nothing[:, :3], angular_velocity_base=nothing[:, :3],
        voltage=np.full(len(state_time), 16.0), temperature=nothing, meta=meta,
    )  # fmt: skip


@pytest.mark.parametrize("age", [0.0003, 0.020, 0.0355])
def test_spikes_give_the_true_age(age: float):
    spikes = measure_spikes(answered(age))
    assert spikes.tried == SPIKES * MOTORS
    assert len(spikes.age) > 0.9 * spikes.tried
    assert np.median(spikes.age) == pytest.approx(age, abs=1e-4)
    assert np.abs(spikes.age - age).max() < 1e-3
    # At the host: way there, until the servo's next step begins, the age, and way back.
    recording = answered(age)
    begin = np.ceil((recording.arrival[0] - 2e-5) / 0.001) * 0.001
    assert np.median(spikes.host) == pytest.approx(begin - recording.sent_time[0] + age + 0.0017, abs=2e-4)


def test_spikes_without_motion_are_left_out():
    spikes = measure_spikes(answered(0.02, moving=3))
    assert spikes.tried == SPIKES * MOTORS
    assert 0.9 * 3 * SPIKES < len(spikes.age) <= 3 * SPIKES
    assert np.median(spikes.age) == pytest.approx(0.02, abs=1e-4)
    none = measure_spikes(answered(0.02, speed=0.0))
    assert (len(none.age), none.tried) == (0, SPIKES * MOTORS)


def test_a_recording_without_spikes():
    recording = answered(0.02)
    recording.meta["phases"][0]["name"] = "hold"
    spikes = measure_spikes(recording)
    assert (len(spikes.age), spikes.tried) == (0, 0)


def still(roll: float, pitch: float, noise: float, count: int = 20_000) -> SimpleNamespace:
    tilt = np.random.default_rng(1).normal([roll, pitch, 9.0], noise, (count, 3))
    return SimpleNamespace(roll_pitch_yaw=tilt)


def test_bias_and_noise_of_the_imu():
    roll, pitch, noise = estimate_imu(still(0.03, -0.05, 0.01))
    assert [(e.name, e.index, e.unit) for e in (roll, pitch)] == [("imu_bias", 0, "rad"), ("imu_bias", 1, "rad")]
    assert roll.value == pytest.approx(0.03, abs=3e-4)
    assert pitch.value == pytest.approx(-0.05, abs=3e-4)
    # What a mean of so many is known to is nothing beside how level the rack is.
    assert roll.deviation == pytest.approx(np.hypot(RACK_TILT, 0.01 / np.sqrt(20_000)), rel=1e-2)
    assert (noise.name, noise.index) == ("imu_noise", None)
    assert noise.value == pytest.approx(0.01, rel=0.02)
    assert noise.interval[0] < 0.01 < noise.interval[1]


def test_noise_of_an_ideal_imu_is_zero():
    noise = estimate_imu(still(0.0, 0.0, 0.0))[2]
    assert (noise.value, noise.interval[0]) == (0.0, 0.0)
    assert 0 < noise.interval[1] < 1e-4


def test_voltage_is_that_at_rest():
    recording = SimpleNamespace(voltage=np.array([15.8, 15.9, 14.0, 13.0]), resting=slice(0, 2))
    estimate = estimate_voltage(recording)
    assert estimate.value == pytest.approx(15.85)
    assert estimate.deviation == VOLTAGE_DEVIATION
