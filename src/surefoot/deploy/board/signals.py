"""Interface between microcontroller and robot hardware: sensor readings in, motor commands out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from surefoot.arrays import Array
from surefoot.deploy.messages import Mode, Reason

Hazard = tuple[Reason, str]
"""Reason why the motors must not move, and a description."""


@dataclass(slots=True)  # frozen would take three times as long, 500 times per second
class Vitals:
    """Readings that the microcontroller checks in every servo step."""

    motor_angle: Array | Sequence[float]
    """Motor angles (M,) [rad]."""
    tilt: float
    """Maximum of |roll| and |pitch| [rad]."""
    voltage: float
    """Battery voltage [V]."""
    temperature: float
    """Temperature of the hottest motor [degC]."""
    hazard: Hazard | None = None
    """Further hazard that damps the motors."""
    sit: Hazard | None = None
    """Reason to ask the operator to bring the robot to rest."""


@dataclass(frozen=True)
class Sensors:
    """Sensor readings of a state, as defined by `messages.State`."""

    motor_angle: Array
    motor_velocity: Array
    motor_torque: Array
    roll_pitch_yaw: Array
    angular_velocity_base: Array
    energy: float
    voltage: float
    temperature: Array
    accelerometer: Array | None = None


@dataclass(frozen=True)
class MotorCommand:
    """Command to all motors, valid until the next one."""

    mode: Mode
    """POSITION: motor angles; PWM: duties; otherwise the motors are damped."""
    values: Array
    """Motor angles [rad] or duties (M,)."""


def microseconds(seconds: float) -> int:
    """Convert seconds to whole microseconds."""
    return round(seconds * 1e6)
