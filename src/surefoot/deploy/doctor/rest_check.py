"""Check of a robot at rest with damped motors: battery, temperatures, encoders and IMU."""

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
"""Time [s] for which a robot at rest is observed."""
MAX_SPREAD = 0.5
"""Greatest difference of swing and extension of a resting leg from the median of all legs [rad]."""
MAX_TILT = 0.3
"""Greatest roll and pitch [rad] of a robot that sits on the floor or hangs on a rack."""
MAX_GYRO_BIAS = 0.05
"""Greatest mean of a resting gyro [rad/s]: .3 deg/s is usual after calibration, ten times that is none."""
MAX_GYRO_NOISE = 0.05
"""Greatest standard deviation of a resting gyro [rad/s]."""
MAX_TILT_NOISE = 0.06
"""Greatest standard deviation of roll and pitch at rest [rad]: gaits are trained with up to .05 (Tan et al. 2018)."""
MAX_DRIFT = 0.05
"""Greatest difference [rad/s] between the change of roll or pitch and the gyro."""
_PING_PERIOD = 0.05


@dataclass(frozen=True)
class TimedState:
    """A state, and when it was sent on the robot's clock [s]."""

    time: float
    state: State


def record_states(link: RobotLink) -> list[TimedState]:
    """Return the states of `DURATION`, with pings that keep the session.

    Raises:
        LinkLostError: the port is gone.
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
    """Judge states of a robot at rest, by the limits of a deployment."""
    if len(timed_states) < 2:
        message = f"{len(timed_states)} states in {DURATION:g} s; the robot must send them after the handshake"
        names = ("battery", "temperature", "encoders", "IMU")
        return [CheckResult(name, False, message, "check the firmware's state period") for name in names]
    states = [timed.state for timed in timed_states]
    voltage = float(np.mean([state.voltage for state in states]))
    least = max(limits.battery_warn, handshake.voltage_min)
    hottest = int(np.argmax(states[-1].temperature))
    temperature = float(states[-1].temperature[hottest])
    return [
        pass_if(
            "battery",
            voltage >= least,
            f"{voltage:.2f} V",
            f"; it must be {least:g} V to begin with, and the robot damps itself at {handshake.voltage_min:g} V",
            "charge the battery",
            voltage,
        ),
        pass_if(
            "temperature",
            temperature <= limits.temperature_warn,
            f"hottest motor: {robot.motor_names[hottest]}, {temperature:.0f} degC",
            f"; at most {limits.temperature_warn:g} to begin with",
            "let the motors cool; if they are cold, check the sensor",
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
    # Legs of a robot that lies, sits or hangs without force are in about the same pose, whichever that is; they may be
    # folded far beyond the range of a gait. A mirrored or misplaced encoder makes one differ, or keeps its loop open.
    if not np.isfinite(angles).all():
        motor = robot.motor_names[int(np.argmin(np.isfinite(angles)))]
        message = f"the angle of {motor} is not finite"
        return CheckResult("encoders", False, message, "check its encoder and the firmware")
    coordinates = list(zip(robot.coordinates, robot.to_pose(angles), robot.leg_geometry.units, strict=True))

    def format_pose(legs: slice) -> str:
        words = []
        for name, values, unit in coordinates:
            low, high = float(values[legs].min()), float(values[legs].max())
            span = f"{low:.2f}" if low == high else f"{low:.2f} to {high:.2f}"
            words.append(f"{name} {span}{'' if unit == '1' else f' {unit}'}")
        return ", ".join(words)

    spread = np.max([np.abs(values - np.median(values)) for _, values, _ in coordinates], axis=0)
    closes = robot.leg_geometry.closes(angles[robot.leg_motor_index])
    all_legs = format_pose(slice(None))
    worst = int(np.argmax(np.where(closes, spread, np.inf)))
    if closes.all() and spread.max() <= MAX_SPREAD:
        return CheckResult("encoders", True, f"legs are alike: {all_legs}", value=float(spread.max()))
    readings = " and ".join(f"{robot.motor_names[i]} {angles[i]:.2f}" for i in robot.leg_motor_index[worst])
    rule = f"all must be alike to {MAX_SPREAD:g} rad ({all_legs})" if closes[worst] else "its loop can't close so"
    return CheckResult(
        "encoders",
        False,
        f"{robot.leg_names[worst]} reads {readings}: {format_pose(slice(worst, worst + 1))}; {rule}",
        "lay all legs alike; if they are, an encoder of this leg is mirrored or its zero is elsewhere: set sign and "
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
        ("gyro's mean", gyro_bias, MAX_GYRO_BIAS, "rad/s"),
        ("gyro's noise", gyro_noise, MAX_GYRO_NOISE, "rad/s"),
        ("noise of roll and pitch", tilt.std(axis=0).max(), MAX_TILT_NOISE, "rad"),
        ("drift of roll and pitch against the gyro", np.abs(drift).max(), MAX_DRIFT, "rad/s"),
    ):
        if value > limit:
            message = f"{quantity} is {value:.3f} {unit} at rest; at most {limit:g}"
            remedy = "let the robot lie still, calibrate the gyro, and check how the IMU is mounted and its units"
            return CheckResult("IMU", False, message, remedy, float(value))
    message = f"roll {mean[0]:+.3f}, pitch {mean[1]:+.3f} rad; gyro's mean at most {gyro_bias:.4f}, "
    return CheckResult("IMU", True, f"{message}noise {gyro_noise:.4f} rad/s", value=gyro_bias)
