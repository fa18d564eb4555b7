"""Motor loads of a simulated motion, and the torque that motors can deliver."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from surefoot.actuator import motor_current, motor_torque
from surefoot.actuator.motor import joint_limit_kernel
from surefoot.arrays import Array
from surefoot.robot import RobotDescription
from surefoot.robot.actuator import DcMotorData, JointActuatorData
from surefoot.world.interface import SimState, WorldConfig
from surefoot.world.sim_world import SimWorld

_UNLIMITED = 1e6
"""Torque [N m] and speed [rad/s] that no motor reaches."""


@dataclass(frozen=True)
class MotorLoad:
    """Motor load of a simulated robot with M motors over T control steps."""

    torque: Array
    """Torque at the end of each control step (T, M) [N m]."""
    speed: Array
    """Speed at the end of each control step (T, M) [rad/s]."""
    saturation: Array
    """Fraction of each control step at the motor's limit (T, M)."""
    end: SimState
    """State at the end."""
    finished: bool
    """Whether the motion was completed: the robot neither tilted too far nor diverged."""


def measure_load(
    robot: RobotDescription, target: Callable[[float], Array], duration: float, config: WorldConfig, max_tilt: float
) -> MotorLoad:
    """Simulate a robot, and stop when it tilts too far or diverges.

    Args:
        robot: the robot.
        target: function that returns the commanded motor angles (M,) or (1, M) [rad] at a time [s].
        duration: duration of the simulation [s].
        config: configuration of the simulated world.
        max_tilt: maximum roll or pitch [rad].

    Raises:
        SurefootError: a robot that does not settle.
    """
    world, rows, finished = SimWorld(robot, 1, config=config), [], True
    for k in range(max(round(duration / robot.timing.control_step), 1)):
        world.step(np.reshape(target(k * robot.timing.control_step), (1, -1)))
        truth = world.truth()
        rows.append((truth.motor_torque[0], truth.motor_velocity[0], truth.motor_saturation[0]))
        if truth.diverged[0] or np.abs(truth.roll_pitch_yaw[0, :2]).max() > max_tilt:
            finished = False
            break
    torque, speed, saturation = (np.array(column) for column in zip(*rows, strict=True))
    return MotorLoad(torque, speed, saturation, truth, finished)


def without_torque_limits(robot: RobotDescription) -> RobotDescription:
    """Return the robot with unlimited torque and speed of joint actuators; DC motors are not changed."""
    if not isinstance(robot.actuator, JointActuatorData):
        return robot
    limits = {"torque_limit": _UNLIMITED, "full_torque_speed": _UNLIMITED, "speed_limit": 2 * _UNLIMITED}
    return replace(robot, actuator=replace(robot.actuator, **limits))


def available_torque(robot: RobotDescription, motor: int, speed: float = 0.0) -> float:
    """Return the maximum driving torque of a motor [N m] at a speed [rad/s]."""
    data = robot.actuator
    if isinstance(data, DcMotorData):
        current = motor_current(1.0, abs(speed), data.voltage, data.torque_constant, data.resistance, data.voltage_clip)
        return float(motor_torque(max(current, 0.0), 1.0, *robot.torque_table))
    limit, full, none = (
        float(np.broadcast_to(values, robot.num_motors)[motor])
        for values in (data.torque_limit, data.full_torque_speed, data.speed_limit)
    )
    return float(joint_limit_kernel(math.inf, abs(speed), limit, full, none))


def continuous_torque(robot: RobotDescription, motor: int) -> float:
    """Return the continuous torque of a motor [N m]; infinite if the data sheet has none."""
    torque = float(np.broadcast_to(robot.actuator.overheat_torque, robot.num_motors)[motor])
    return torque if torque < _UNLIMITED else math.inf


def describe_torque(robot: RobotDescription, motor: int, speed: float = 0.0) -> str:
    """Describe the torque of a motor at rest, at a speed [rad/s], and continuously."""
    rest, moving, continuous = (
        available_torque(robot, motor),
        available_torque(robot, motor, speed),
        continuous_torque(robot, motor),
    )
    at_speed = f", {moving:.3g} at {abs(speed):.2g} rad/s" if moving < 0.995 * rest else ""
    return f"has {rest:.3g} N m{at_speed}{f', {continuous:.3g} continuously' if continuous < rest else ''}"
