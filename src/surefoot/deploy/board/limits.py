"""Limits of a robot's microcontroller, and the handshake that states them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from surefoot.deploy.messages import NAME_BYTES, Handshake
from surefoot.errors import SurefootError

if TYPE_CHECKING:
    from surefoot.robot import RobotDescription  # not imported on a board, which needs neither URDF nor data sheets


@dataclass(frozen=True)
class Limits:
    """Limits at which a microcontroller damps its motors, and conditions for arming again. Times in s."""

    voltage: float
    """Battery voltage below which the robot damps its motors [V]."""
    temperature: float
    """Motor temperature above which the robot damps its motors [degC]."""
    command_timeout: float = 0.050
    """Time without a command after which an armed robot damps its motors."""
    stale_after: float = 3.0
    """Maximum age of a command [command periods]."""
    stale_drops: int = 3
    """Number of consecutive dropped commands after which the motors are damped."""
    rearm_after: float = 0.5
    """Time that the link must be clean before the robot can be armed after a fault."""
    clean_gap: float = 0.1
    """Maximum gap between packets on a clean link."""
    owner_timeout: float = 1.0
    """Silence of the operator after which another one may connect, if the robot is not armed."""
    command_period: tuple[float, float] = (0.002, 0.050)
    """Minimum and maximum period of commands."""
    state_period: tuple[float, float] = (0.001, 1.0)
    """Minimum and maximum period of states; requests are clipped to them."""
    tilt: float = 1.0
    """Roll or pitch beyond which the robot damps its motors [rad]."""
    voltage_time: float = 0.5
    """Time for which the voltage must be low; it sags briefly when motors start."""
    duty: float = 1.0
    """Maximum duty of a PWM command; 0: the robot does not support PWM mode."""
    first_torque: float = math.inf
    """Maximum torque of the first command to a joint actuator, from its gain and present angle [N m]."""
    refusals: int = 10
    """Maximum number of rejections per second for each reason."""

    @classmethod
    def from_robot(cls, robot: RobotDescription) -> Limits:
        """Return the limits of a robot, with battery, temperature and command timeout from its data sheet."""
        return cls(robot.battery.empty, robot.heat.limit, command_timeout=robot.timing.command_timeout)


def make_handshake(robot: RobotDescription, limits: Limits, firmware: str, servo_period: float) -> Handshake:
    """Return the handshake of a robot; its session is set when an operator connects.

    Angle limits are the robot's `command_range`. Gains are the data sheet's, even if the motors of an emulated robot
    have others.

    Args:
        robot: description of the robot.
        limits: limits of the microcontroller.
        firmware: name and version of the firmware.
        servo_period: period of the servo [s].

    Raises:
        SurefootError: a name of the robot or of a motor is too long for a message.
    """
    for name in (robot.name, *robot.motor_names):
        if len(name.encode()) > NAME_BYTES:
            raise SurefootError(
                f"the name '{name}' has {len(name.encode())} bytes; at most {NAME_BYTES} fit into messages: shorten it "
                "in the robot's description"
            )
    # Rounded as on the wire, so that a command of exactly these angles is within the limits.
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
