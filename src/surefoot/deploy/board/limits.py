"""What a microcontroller allows, and its handshake."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from surefoot.deploy.messages import Handshake

if TYPE_CHECKING:
    from surefoot.robot import RobotDescription  # and with it URDF and sheets, which a board does not need


@dataclass(frozen=True)
class Limits:
    """When the microcontroller damps its motors by itself, and when it arms again. Times in s."""

    voltage: float
    """Battery voltage [V] below which the robot damps itself."""
    temperature: float
    """Motor temperature [degC] beyond which the robot damps itself."""
    command_timeout: float = 0.050
    """Silence after which an armed robot damps itself."""
    stale_after: float = 3.0
    """Command periods after which a command is too old to be obeyed."""
    stale_drops: int = 3
    """Commands dropped in a row that damp the robot."""
    rearm_after: float = 0.5
    """Time that the link must be clean before a robot that damped itself arms."""
    clean_gap: float = 0.1
    """Longest silence of the operator on a clean link."""
    owner_timeout: float = 1.0
    """Silence after which another operator may connect to a robot that is not armed."""
    command_period: tuple[float, float] = (0.002, 0.050)
    """Shortest and longest time between two commands."""
    state_period: tuple[float, float] = (0.001, 1.0)
    """Shortest and longest time between two states; requests are clipped to them."""
    tilt: float = 1.0
    """Roll or pitch [rad] beyond which the robot damps itself."""
    voltage_time: float = 0.5
    """How long the voltage must be low: it sags briefly when motors start."""
    duty: float = 1.0
    """Largest duty that a PWM command may request; 0: the robot does not arm for duties."""
    first_torque: float = math.inf
    """Largest torque [N m] that the first command of a joint actuator may request, by its gain and present angle."""
    refusals: int = 10
    """Greatest number of refusals per second for each reason."""

    @classmethod
    def from_robot(cls, robot: RobotDescription) -> Limits:
        """Return the limits of a robot; those of battery, motors and silence are its data sheet's."""
        return cls(robot.battery.empty, robot.heat.limit, command_timeout=robot.timing.command_timeout)


def make_handshake(robot: RobotDescription, limits: Limits, firmware: str, servo_period: float) -> Handshake:
    """Return the handshake of a robot; the session is filled in when an operator connects.

    A command may request the robot's `command_range`. Gains are the data sheet's, whatever
    an emulated robot's motors have. `firmware` is its name and version; the servo steps every `servo_period` [s].
    """
    # Rounded as on the wire, so that a command of exactly these angles is within them.
    low, high = (angles.astype(np.float32).astype(np.float64) for angles in robot.command_range)
    return Handshake(
        session=0,
        robot=robot.name,
        firmware=firmware,
        motor_names=robot.motor_names,
        motor_signs=robot.motor_sign.astype(np.float64),
        servo_period=servo_period,
        servo_kp=np.broadcast_to(np.asarray(robot.actuator.kp, float), robot.num_motors),
        servo_kd=np.broadcast_to(np.asarray(robot.actuator.kd, float), robot.num_motors),
        command_period_min=limits.command_period[0],
        command_period_max=limits.command_period[1],
        angle_low=low,
        angle_high=high,
        tilt_limit=limits.tilt,
        voltage_min=limits.voltage,
        temperature_max=limits.temperature,
        command_timeout=limits.command_timeout,
        rearm_after=limits.rearm_after,
    )
