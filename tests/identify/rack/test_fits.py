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

PERIOD, SPIKE_PERIOD, SPIKES, MOTORS = 0.002, 0.12, 12, 8
TRANSMISSION_TIME = 0.0013
"""Time from sending a command to its arrival [s]."""
STEP = 2 * np.pi / 2**14


def spike_recording(
    age: float, speed: float = 5.0, moving: int = MOTORS, noise: float = 1.0, seed: int = 0
) -> Recording:
    """Return a recording of one-command spikes in both directions; motors respond freely, then brake.

    From 0 to T a motor moves by v t^2 / 2 T, later by v (t - T / 2) - c (t - T)^2 until it stops. Odd motors move in
    the opposite direction. States report the motion `age` later.
    """
    rng = np.random.default_rng(seed)
    count = round(SPIKES * SPIKE_PERIOD / PERIOD)
    sent = 0.5 + PERIOD * np.arange(count)
    # A spike acts from the next servo step, which begins at a multiple of 1 ms on the robot's clock.
    arrival = sent + TRANSMISSION_TIME
    value = np.zeros((count, MOTORS))
    driven = np.arange(0, count, round(SPIKE_PERIOD / PERIOD))
    height = 0.4 * np.where(np.arange(MOTORS) % 2 == 0, 1.0, -1.0) * np.where(np.arange(MOTORS) < moving, 1.0, 0.0)
    state_time = arrival[0] - 0.0203 + PERIOD * np.arange(count + 20)
    angle, rate = np.full((len(state_time), MOTORS), 1.7), np.zeros((len(state_time), MOTORS))
    for k, c in enumerate(driven):
        direction = height * (1.0 if k % 2 == 0 else -1.0)
        value[c] = direction if moving else 0.4
        begin = np.ceil(arrival[c] / 0.001 - 1e-6) * 0.001
        length = np.ceil(arrival[c + 1] / 0.001 - 1e-6) * 0.001 - begin
        since = np.maximum(state_time - age - begin, 0.0)
        brakes = np.clip(since - length, 0.0, 0.05)
        deceleration = speed / 0.05
        distance = np.where(since < length, since**2 / (2 * length), 0.0) * speed
        distance = np.where(since < length, distance, speed * (length / 2 + brakes) - deceleration * brakes**2 / 2)
        velocity = np.where(since < length, speed * since / length, speed - deceleration * brakes)
        angle += distance[:, None] * np.sign(direction)
        rate += velocity[:, None] * np.sign(direction)
    angle = np.round((angle + noise * 1e-4 * rng.normal(size=angle.shape)) / STEP) * STEP
    rate = rate + noise * 0.05 * rng.normal(size=rate.shape)
    numbers = np.arange(count) + 100.0
    active = np.searchsorted(arrival, state_time + 1e-9, side="right") - 1
    zeros = np.zeros((len(state_time), MOTORS))
    meta: dict[str, Any] = {
        "servo_period": 0.001,
        "phases": [{"name": "spikes", "mode": int(Mode.PWM), "use": "fit", "duration": SPIKES * SPIKE_PERIOD}],
    }
    return Recording(
        sent_number=numbers, sent_time=sent, sent_phase=np.zeros(count), sent_value=value, time=state_time,
        host_time=state_time + 0.0017, mode=np.full(len(state_time), 2.0),
        command=np.where(active < 0, 0.0, numbers[active]),
        command_age=np.maximum(state_time - arrival[active], 0.0), motor_angle=angle, motor_velocity=rate,
        motor_torque=zeros, roll_pitch_yaw=zeros[:, :3], angular_velocity_base=zeros[:, :3],
        voltage=np.full(len(state_time), 16.0), temperature=zeros, meta=meta,
    )  # fmt: skip


@pytest.mark.parametrize("age", [0.0003, 0.020, 0.0355])
def test_spikes_give_the_true_age(age: float):
    spikes = measure_spikes(spike_recording(age))
    assert spikes.total == SPIKES * MOTORS
    assert len(spikes.age) > 0.9 * spikes.total
    assert np.median(spikes.age) == pytest.approx(age, abs=1e-4)
    assert np.abs(spikes.age - age).max() < 1e-3
    # At the host: transmission, wait for the servo's next step, the age, and transmission back.
    recording = spike_recording(age)
    begin = np.ceil((recording.arrival[0] - 2e-5) / 0.001) * 0.001
    assert np.median(spikes.host) == pytest.approx(begin - recording.sent_time[0] + age + 0.0017, abs=2e-4)


def test_spikes_without_motion_are_left_out():
    spikes = measure_spikes(spike_recording(0.02, moving=3))
    assert spikes.total == SPIKES * MOTORS
    assert 0.9 * 3 * SPIKES < len(spikes.age) <= 3 * SPIKES
    assert np.median(spikes.age) == pytest.approx(0.02, abs=1e-4)
    none = measure_spikes(spike_recording(0.02, speed=0.0))
    assert (len(none.age), none.total) == (0, SPIKES * MOTORS)


def test_a_recording_without_spikes():
    recording = spike_recording(0.02)
    recording.meta["phases"][0]["name"] = "hold"
    spikes = measure_spikes(recording)
    assert (len(spikes.age), spikes.total) == (0, 0)


def still(roll: float, pitch: float, noise: float, count: int = 20_000) -> SimpleNamespace:
    tilt = np.random.default_rng(1).normal([roll, pitch, 9.0], noise, (count, 3))
    return SimpleNamespace(roll_pitch_yaw=tilt)


def test_bias_and_noise_of_the_imu():
    roll, pitch, noise = estimate_imu(still(0.03, -0.05, 0.01))
    assert [(e.name, e.index, e.unit) for e in (roll, pitch)] == [("imu_bias", 0, "rad"), ("imu_bias", 1, "rad")]
    assert roll.value == pytest.approx(0.03, abs=3e-4)
    assert pitch.value == pytest.approx(-0.05, abs=3e-4)
    # The uncertainty of the mean is small compared with the tilt of the rack.
    assert roll.deviation == pytest.approx(np.hypot(RACK_TILT, 0.01 / np.sqrt(20_000)), rel=1e-2)
    assert (noise.name, noise.index) == ("imu_noise", None)
    assert noise.value == pytest.approx(0.01, rel=0.02)
    assert noise.interval[0] < 0.01 < noise.interval[1]


def test_noise_of_an_ideal_imu_is_zero():
    noise = estimate_imu(still(0.0, 0.0, 0.0))[2]
    assert (noise.value, noise.interval[0]) == (0.0, 0.0)
    assert 0 < noise.interval[1] < 1e-4


def test_voltage_is_estimated_at_rest():
    recording = SimpleNamespace(voltage=np.array([15.8, 15.9, 14.0, 13.0]), resting=slice(0, 2))
    estimate = estimate_voltage(recording)
    assert estimate.value == pytest.approx(15.85)
    assert estimate.deviation == VOLTAGE_DEVIATION
