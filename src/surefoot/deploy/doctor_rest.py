"""The doctor's look at a robot at rest: battery, temperatures, encoders and IMU, with motors damped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.connection import RobotConnection
from surefoot.deploy.doctor_link import listen
from surefoot.deploy.findings import Finding
from surefoot.deploy.safety import SafetyLimits
from surefoot.deploy.wire import Handshake, State
from surefoot.robot import RobotDescription

Array = NDArray[np.float64]

DURATION = 1.0
"""How long a robot at rest is watched [s]."""
SWING_ROOM = 0.05
"""How far [rad] a resting leg may swing beyond leg space: encoders are that well aligned, and a mirrored one is not."""
LEVEL = 0.3
"""Largest roll and pitch [rad] of a robot that sits on the floor or hangs on a rack."""
GYRO_BIAS = 0.05
"""Largest mean of a resting gyro [rad/s]: .3 deg/s is usual after calibration, ten times that is none."""
GYRO_NOISE = 0.05
"""Largest standard deviation of a resting gyro [rad/s]."""
TILT_NOISE = 0.02
"""Largest standard deviation of roll and pitch at rest [rad]."""
DRIFT = 0.05
"""Largest difference [rad/s] between how fast roll or pitch change and what the gyro says of it."""
_PING_EVERY = 0.05


@dataclass(frozen=True)
class Sample:
    """A state, and when it was sent on the robot's clock [s]."""

    time: float
    state: State


def watch(connection: RobotConnection, duration: float = DURATION) -> list[Sample]:
    """States of a while, with pings to keep the session.

    Raises:
        LinkLostError: the port is gone.
    """
    samples: list[Sample] = []
    connection.update()
    connection.on_state = lambda state, sent, _: samples.append(Sample(sent, state))
    end = connection.clock.now() + duration
    try:
        while (now := connection.clock.now()) < end:
            connection.link.ping()
            listen(connection, min(now + _PING_EVERY, end))
    finally:
        connection.on_state = None
    return samples


def check_rest(
    samples: Sequence[Sample], robot: RobotDescription, handshake: Handshake, limits: SafetyLimits
) -> list[Finding]:
    """Judge a robot that nobody moves.

    Args:
        samples: states of about a second.
        robot: its data sheet.
        handshake: what it says of itself.
        limits: of a deployment.
    """
    names = ("battery", "temperature", "encoders", "IMU")
    if len(samples) < 2:
        why = f"{len(samples)} states in {DURATION:g} s; the robot must send them by itself after the greeting"
        return [Finding(name, False, why, "check the firmware's state period") for name in names]
    states = [sample.state for sample in samples]
    angles = np.mean([state.motor_angle for state in states], axis=0)
    times = np.array([sample.time for sample in samples])
    tilt = np.array([state.roll_pitch_yaw[:2] for state in states])
    rate = np.array([state.angular_velocity_base for state in states])
    return [
        _battery(float(np.mean([state.voltage for state in states])), handshake, limits),
        _temperature(states[-1].temperature, robot, limits),
        _encoders(angles, robot),
        _imu(times, tilt, rate),
    ]


def _battery(voltage: float, handshake: Handshake, limits: SafetyLimits) -> Finding:
    told = f"{voltage:.2f} V"
    least = max(limits.battery_warn, handshake.voltage_min)
    if voltage >= least:
        return Finding("battery", True, told, value=voltage)
    why = f"{told}; it must be {least:g} V to begin with, and the robot damps itself at {handshake.voltage_min:g} V"
    return Finding("battery", False, why, "charge the battery", voltage)


def _temperature(temperature: Array, robot: RobotDescription, limits: SafetyLimits) -> Finding:
    hottest = int(np.argmax(temperature))
    told, value = (
        f"hottest motor: {robot.motor_names[hottest]}, {temperature[hottest]:.0f} degC",
        float(temperature.max()),
    )
    if value <= limits.temperature_warn:
        return Finding("temperature", True, told, value=value)
    why = f"{told}; at most {limits.temperature_warn:g} to begin with"
    return Finding("temperature", False, why, "let the motors cool; if they are cold, check the sensor", value)


def _encoders(angles: Array, robot: RobotDescription) -> Finding:
    """Whether each leg is in a pose that it can be in: a mirrored encoder makes it seem to swing too far."""
    name = "encoders"
    if not np.isfinite(angles).all():
        bad = robot.motor_names[int(np.argmin(np.isfinite(angles)))]
        return Finding(name, False, f"the angle of {bad} is not finite", "check its encoder and the firmware")
    swing, extension = robot.motor_to_leg_pose(angles)
    low, high = robot.swing_range
    for leg, motors, s, e in zip(robot.legs, robot.leg_motor_index, swing, extension, strict=True):
        closes = bool(robot.leg_geometry.closes(*angles[motors]))
        if closes and low - SWING_ROOM <= s <= high + SWING_ROOM and 0 < e < np.pi + SWING_ROOM:
            continue
        told = " and ".join(f"{robot.motor_names[index]} {angles[index]:.2f}" for index in motors)
        return Finding(
            name,
            False,
            f"{leg.name} reads {told} rad: swing {s:.2f}, extension {e:.2f}; a leg swings {low:g} to {high:g} rad "
            f"and extends 0 to {np.pi:.2f}",
            "one of its two encoders is mirrored, or its zero is elsewhere: set sign and offset in the firmware",
            float(s),
        )
    told = f"swing {swing.min():.2f} to {swing.max():.2f}, extension {extension.min():.2f} to {extension.max():.2f} rad"
    return Finding(name, True, f"every leg is in a pose that it can be in: {told}", value=float(np.abs(swing).max()))


def _imu(times: Array, tilt: Array, rate: Array) -> Finding:
    name, todo = "IMU", "let the robot lie still, calibrate the gyro, and check how the IMU is mounted and its units"
    if not (np.isfinite(tilt).all() and np.isfinite(rate).all()):
        return Finding(name, False, "roll, pitch or a rate is not finite", "check the IMU's wiring and the firmware")
    bias, mean = rate.mean(axis=0), tilt.mean(axis=0)
    drift = (np.polyfit(times - times[0], tilt, 1)[0] - bias[:2]) if len(times) > 2 else np.zeros(2)
    measured = (
        ("roll", abs(mean[0]), LEVEL, "rad"),
        ("pitch", abs(mean[1]), LEVEL, "rad"),
        ("gyro's mean", float(np.abs(bias).max()), GYRO_BIAS, "rad/s"),
        ("gyro's noise", float(rate.std(axis=0).max()), GYRO_NOISE, "rad/s"),
        ("noise of roll and pitch", float(tilt.std(axis=0).max()), TILT_NOISE, "rad"),
        ("drift of roll and pitch against the gyro", float(np.abs(drift).max()), DRIFT, "rad/s"),
    )
    for what, value, most, unit in measured:
        if value > most:
            why = f"{what} is {value:.3f} {unit} at rest; at most {most:g}"
            return Finding(name, False, why, todo, float(value))
    why = (
        f"roll {mean[0]:+.3f}, pitch {mean[1]:+.3f} rad; gyro's mean at most {measured[2][1]:.4f}, "
        f"noise {measured[3][1]:.4f} rad/s"
    )
    return Finding(name, True, why, value=measured[2][1])
