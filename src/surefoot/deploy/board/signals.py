"""What microcontroller and body exchange: readings one way, orders for the motors the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from surefoot.arrays import Array
from surefoot.deploy.messages import Mode, Reason

Hazard = tuple[Reason, str]
"""Why motors must not move, and what was seen."""


@dataclass(slots=True)  # a frozen one takes three times as long, 500 times a second
class Vitals:
    """What the microcontroller checks in every servo step; the tilt is the larger of |roll| and |pitch| [rad]."""

    motor_angle: Array | Sequence[float]
    tilt: float
    voltage: float
    temperature: float
    """The hottest motor [degC]."""
    hazard: Hazard | None = None
    """What else damps the motors."""
    sit: Hazard | None = None
    """What asks the operator to bring the robot to rest."""


@dataclass(frozen=True)
class Sensors:
    """The readings in a state, as `messages.State` defines them."""

    motor_angle: Array
    motor_velocity: Array
    motor_torque: Array
    roll_pitch_yaw: Array
    angular_velocity_base: Array
    energy: float
    voltage: float
    temperature: Array


@dataclass(frozen=True)
class MotorCommand:
    """What the motors do until the next order."""

    mode: Mode
    """POSITION: hold the target; PWM: duty; otherwise damped."""
    values: Array
    """Motor angles [rad] or duties (M,)."""


def microseconds(seconds: float) -> int:
    """Return seconds as whole microseconds."""
    return round(seconds * 1e6)
