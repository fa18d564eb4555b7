"""The doctor's look at a robot at rest: battery, temperatures, encoders and IMU, with motors damped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge
from surefoot.deploy.doctor.link import listen
from surefoot.deploy.messages import Handshake, State
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.safety import SafetyLimits
from surefoot.robot import RobotDescription

DURATION = 1.0
"""How long a robot at rest is watched [s]."""
ALIKE = 0.5
"""How far [rad] swing and extension of a resting leg may be from the middle of all legs."""
LEVEL = 0.3
"""Largest roll and pitch [rad] of a robot that sits on the floor or hangs on a rack."""
GYRO_BIAS = 0.05
"""Largest mean of a resting gyro [rad/s]: .3 deg/s is usual after calibration, ten times that is none."""
GYRO_NOISE = 0.05
"""Largest standard deviation of a resting gyro [rad/s]."""
TILT_NOISE = 0.06
"""Largest standard deviation of roll and pitch at rest [rad]: gaits are trained with up to .05 (Tan et al. 2018)."""
DRIFT = 0.05
"""Largest difference [rad/s] between how fast roll or pitch change and what the gyro says of it."""
_PING_EVERY = 0.05


@dataclass(frozen=True)
class Sample:
    """A state, and when it was sent on the robot's clock [s]."""

    time: float
    state: State


def watch(link: RobotLink, duration: float = DURATION) -> list[Sample]:
    """States of a while, with pings to keep the session.

    Raises:
        LinkLostError: the port is gone.
    """
    samples: list[Sample] = []
    link.update()
    link.on_state = lambda state, sent, _: samples.append(Sample(sent, state))
    end = link.clock.now() + duration
    try:
        while (now := link.clock.now()) < end:
            link.ping()
            listen(link, min(now + _PING_EVERY, end))
    finally:
        link.on_state = None
    return samples


def check_rest(
    samples: Sequence[Sample], robot: RobotDescription, handshake: Handshake, limits: SafetyLimits
) -> list[CheckResult]:
    """Judge a robot that nobody moves, from states of about a second, by the limits of a deployment."""
    names = ("battery", "temperature", "encoders", "IMU")
    if len(samples) < 2:
        why = f"{len(samples)} states in {DURATION:g} s; the robot must send them by itself after the greeting"
        return [CheckResult(name, False, why, "check the firmware's state period") for name in names]
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


def _battery(voltage: float, handshake: Handshake, limits: SafetyLimits) -> CheckResult:
    told = f"{voltage:.2f} V"
    least = max(limits.battery_warn, handshake.voltage_min)
    rule = f"; it must be {least:g} V to begin with, and the robot damps itself at {handshake.voltage_min:g} V"
    return judge("battery", voltage >= least, told, rule, "charge the battery", voltage)


def _temperature(temperature: Array, robot: RobotDescription, limits: SafetyLimits) -> CheckResult:
    hottest = int(np.argmax(temperature))
    value = float(temperature[hottest])
    told = f"hottest motor: {robot.motor_names[hottest]}, {value:.0f} degC"
    rule = f"; at most {limits.temperature_warn:g} to begin with"
    todo = "let the motors cool; if they are cold, check the sensor"
    return judge("temperature", value <= limits.temperature_warn, told, rule, todo, value)


def _span(name: str, values: Array, unit: str) -> str:
    low, high = float(values.min()), float(values.max())
    numbers = f"{low:.2f}" if low == high else f"{low:.2f} to {high:.2f}"
    return f"{name} {numbers}{'' if unit == '1' else f' {unit}'}"


def _encoders(angles: Array, robot: RobotDescription) -> CheckResult:
    # Legs of a robot that lies, sits or hangs without force are in about the same pose, whichever that is; they may be
    # folded far beyond what a gait asks for. A mirrored or misplaced encoder makes one differ, or keeps its loop open.
    name = "encoders"
    if not np.isfinite(angles).all():
        bad = robot.motor_names[int(np.argmin(np.isfinite(angles)))]
        return CheckResult(name, False, f"the angle of {bad} is not finite", "check its encoder and the firmware")
    parts = list(zip(robot.coordinates, robot.to_pose(angles), robot.leg_geometry.units, strict=True))

    def told_pose(of: slice) -> str:
        return ", ".join(_span(name, values[of], unit) for name, values, unit in parts)

    off = np.max([np.abs(values - np.median(values)) for _, values, _ in parts], axis=0)
    closes = robot.leg_geometry.closes(angles[robot.leg_motor_index])
    spread = told_pose(slice(None))
    if closes.all() and off.max() <= ALIKE:
        return CheckResult(name, True, f"legs are alike: {spread}", value=float(off.max()))
    worst = int(np.argmax(np.where(closes, off, np.inf)))
    told = " and ".join(f"{robot.motor_names[i]} {angles[i]:.2f}" for i in robot.leg_motor_index[worst])
    legs_pose = told_pose(slice(worst, worst + 1))
    rule = f"all must be alike to {ALIKE:g} rad ({spread})" if closes[worst] else "its loop can't close so"
    return CheckResult(
        name,
        False,
        f"{robot.leg_names[worst]} reads {told}: {legs_pose}; {rule}",
        "lay all legs alike; if they are, an encoder of this leg is mirrored or its zero is elsewhere: set sign and "
        "offset in the firmware",
        float(off.max()),
    )


def _imu(times: Array, tilt: Array, rate: Array) -> CheckResult:
    name, todo = "IMU", "let the robot lie still, calibrate the gyro, and check how the IMU is mounted and its units"
    if not (np.isfinite(tilt).all() and np.isfinite(rate).all()):
        return CheckResult(
            name, False, "roll, pitch or a rate is not finite", "check the IMU's wiring and the firmware"
        )
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
            return CheckResult(name, False, why, todo, float(value))
    why = (
        f"roll {mean[0]:+.3f}, pitch {mean[1]:+.3f} rad; gyro's mean at most {measured[2][1]:.4f}, "
        f"noise {measured[3][1]:.4f} rad/s"
    )
    return CheckResult(name, True, why, value=measured[2][1])
