"""Checks of a robot at rest with damped motors: battery, temperatures, encoders and IMU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, pass_if
from surefoot.deploy.doctor.link_check import receive_until
from surefoot.deploy.messages import Handshake, State
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.safety import SafetyLimits
from surefoot.robot import RobotDescription

DURATION = 1.0
"""Time for which a robot at rest is observed [s]."""
MAX_SPREAD = 0.5
"""Maximum difference of a resting leg's swing and extension from the median of all legs [rad]."""
MAX_TILT = 0.3
"""Maximum roll and pitch of a robot that sits on the floor or hangs on a rack [rad]."""
MAX_GYRO_BIAS = 0.05
"""Maximum mean rate of a gyro at rest [rad/s]: 0.3 deg/s is usual after calibration, and ten times that means no
calibration."""
MAX_GYRO_NOISE = 0.05
"""Maximum standard deviation of a gyro at rest [rad/s]."""
MAX_TILT_NOISE = 0.06
"""Maximum standard deviation of roll and pitch at rest [rad]: gaits are trained with up to 0.05 (Tan et al. 2018)."""
MAX_DRIFT = 0.05
"""Maximum difference between the rate of change of roll or pitch and the gyro [rad/s]."""
_PING_PERIOD = 0.05


@dataclass(frozen=True)
class TimedState:
    """State with the time at which it was sent, on the robot's clock [s]."""

    time: float
    state: State


def record_states(link: RobotLink) -> list[TimedState]:
    """Record the states of a period of `DURATION`, while pings keep the session alive.

    Raises:
        LinkLostError: the link is lost.
    """
    states: list[TimedState] = []
    link.update()
    link.on_state = lambda state, sent, _: states.append(TimedState(sent, state))
    end = link.clock.now() + DURATION
    try:
        while (now := link.clock.now()) < end:
            link.ping()
            receive_until(link, min(now + _PING_PERIOD, end))
    finally:
        link.on_state = None
    return states


def check_rest(
    timed_states: Sequence[TimedState], robot: RobotDescription, handshake: Handshake, limits: SafetyLimits
) -> list[CheckResult]:
    """Check the states of a robot at rest against the limits of a deployment."""
    if len(timed_states) < 2:
        message = f"{len(timed_states)} states in {DURATION:g} s; the robot must send them after the handshake"
        names = ("battery", "temperature", "encoders", "IMU")
        return [CheckResult(name, False, message, "check the firmware's state period") for name in names]
    states = [timed.state for timed in timed_states]
    voltage = float(np.mean([state.voltage for state in states]))
    min_voltage = max(limits.battery_warn, handshake.voltage_min)
    hottest = int(np.argmax(states[-1].temperature))
    temperature = float(states[-1].temperature[hottest])
    return [
        pass_if(
            "battery",
            voltage >= min_voltage,
            f"{voltage:.2f} V",
            f"; at least {min_voltage:g} V to start, and the robot damps itself at {handshake.voltage_min:g} V",
            "charge the battery",
            voltage,
        ),
        pass_if(
            "temperature",
            temperature <= limits.temperature_warn,
            f"hottest motor: {robot.motor_names[hottest]}, {temperature:.0f} degC",
            f"; at most {limits.temperature_warn:g} to start",
            "let the motors cool down; if they are cold, check the sensor",
            temperature,
        ),
        _check_encoders(np.mean([state.motor_angle for state in states], axis=0), robot),
        _check_imu(
            np.array([timed.time for timed in timed_states]),
            np.array([state.roll_pitch_yaw[:2] for state in states]),
            np.array([state.angular_velocity_base for state in states]),
        ),
    ]


def _check_encoders(angles: Array, robot: RobotDescription) -> CheckResult:
    # When a robot lies, sits or hangs without torque, all legs have about the same pose, which may be folded far beyond
    # the range of a gait. A mirrored or shifted encoder makes one leg differ, or its angles inconsistent with a closed
    # loop.
    if not np.isfinite(angles).all():
        motor = robot.motor_names[int(np.argmin(np.isfinite(angles)))]
        message = f"the angle of {motor} is not finite"
        return CheckResult("encoders", False, message, "check its encoder and the firmware")
    coordinates = list(zip(robot.coordinates, robot.to_pose(angles), robot.leg_geometry.units, strict=True))

    def format_pose(legs: slice) -> str:
        ranges = []
        for name, values, unit in coordinates:
            low, high = float(values[legs].min()), float(values[legs].max())
            span = f"{low:.2f}" if low == high else f"{low:.2f} to {high:.2f}"
            ranges.append(f"{name} {span}{'' if unit == '1' else f' {unit}'}")
        return ", ".join(ranges)

    spread = np.max([np.abs(values - np.median(values)) for _, values, _ in coordinates], axis=0)
    closes = robot.leg_geometry.is_feasible(angles[robot.leg_motor_index])
    all_legs = format_pose(slice(None))
    worst = int(np.argmax(np.where(closes, spread, np.inf)))
    if closes.all() and spread.max() <= MAX_SPREAD:
        return CheckResult("encoders", True, f"all legs have the same pose: {all_legs}", value=float(spread.max()))
    readings = " and ".join(f"{robot.motor_names[i]} {angles[i]:.2f}" for i in robot.leg_motor_index[worst])
    rule = (
        f"all legs must agree within {MAX_SPREAD:g} rad ({all_legs})"
        if closes[worst]
        else "its loop can't close at these angles"
    )
    return CheckResult(
        "encoders",
        False,
        f"{robot.leg_names[worst]} reads {readings}: {format_pose(slice(worst, worst + 1))}; {rule}",
        "put all legs in the same pose; if they are, the sign or zero of an encoder of this leg is wrong: set sign and "
        "offset in the firmware",
        float(spread.max()),
    )


def _check_imu(times: Array, tilt: Array, rate: Array) -> CheckResult:
    if not (np.isfinite(tilt).all() and np.isfinite(rate).all()):
        message = "roll, pitch or a rate is not finite"
        return CheckResult("IMU", False, message, "check the IMU's wiring and the firmware")
    bias, mean = rate.mean(axis=0), tilt.mean(axis=0)
    drift = (np.polyfit(times - times[0], tilt, 1)[0] - bias[:2]) if len(times) > 2 else np.zeros(2)
    gyro_bias, gyro_noise = float(np.abs(bias).max()), float(rate.std(axis=0).max())
    for quantity, value, limit, unit in (
        ("roll", abs(mean[0]), MAX_TILT, "rad"),
        ("pitch", abs(mean[1]), MAX_TILT, "rad"),
        ("gyro bias", gyro_bias, MAX_GYRO_BIAS, "rad/s"),
        ("gyro noise", gyro_noise, MAX_GYRO_NOISE, "rad/s"),
        ("noise of roll and pitch", tilt.std(axis=0).max(), MAX_TILT_NOISE, "rad"),
        ("drift of roll and pitch relative to the gyro", np.abs(drift).max(), MAX_DRIFT, "rad/s"),
    ):
        if value > limit:
            message = f"{quantity} is {value:.3f} {unit} at rest; at most {limit:g}"
            remedy = "let the robot lie still, calibrate the gyro, and check the mounting and units of the IMU"
            return CheckResult("IMU", False, message, remedy, float(value))
    message = f"roll {mean[0]:+.3f}, pitch {mean[1]:+.3f} rad; gyro bias {gyro_bias:.4f}, "
    return CheckResult("IMU", True, f"{message}noise {gyro_noise:.4f} rad/s", value=gyro_bias)
