"""Check of a robot's motors against the speed and torque of a trot, before a training."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, pass_if, warn_if
from surefoot.errors import SurefootError
from surefoot.evaluation.runs import MIN_LIMITING_SATURATION
from surefoot.robot import RobotDescription
from surefoot.robot.actuator import JointActuatorData
from surefoot.task.config import load_task
from surefoot.task.reference_config import FootReferenceConfig
from surefoot.world.interface import WorldConfig
from surefoot.world.motor_load import available_torque, describe_torque, measure_load, without_torque_limits

DURATION = 3.0
"""Duration of the trot [s], at least six strides."""
_TYPICAL_QUANTILE = 0.95
"""Quantile over time of the torque and speed that are reported."""
_MIN_SPEED_RATIO = 0.4
"""Ratio of a motor's speed limit to the trot's speed below which the robot can't trot. At 0.75, ANYmal C trots a tenth
slower."""
_MAX_JOINT_SPEED = 80.0
"""Speed [rad/s] that no leg joint reaches."""
_MIN_SATURATED_FRACTION = 0.5
"""Fraction of the time at its limit from which a motor counts as the cause of a fall."""
_MIN_HEIGHT_RATIO = 0.7
"""Base height, relative to the height with unlimited torque, below which a robot has collapsed."""
TROT_REMEDY = (
    "take stronger motors or a lighter robot, or trot slower with smaller strides (frequency, stroke of a task)"
)


def check_trot(robot: RobotDescription) -> Iterator[CheckResult]:
    """Run the open-loop reference of the task `trot`, and compare its speed and torque with the motors' limits.

    The speed follows from the reference; the check warns or fails if a motor can't reach it. The torque is measured
    with motors of unlimited torque and speed. The check fails if the robot falls with its own motors, one of them at
    its limit for most of the time, and does not fall with unlimited ones. A fall by itself is no failure: many robots
    need the trained feedback to stay upright.
    """
    try:
        task, _ = load_task("trot", str(robot.folder))
        gait = task.gait(robot)
        zero = np.zeros((1, len(gait.action_names)))
        config = WorldConfig(rest=task.rest or gait.rest, actuator=task.actuator, threads=1)
        own, free = (
            measure_load(one, lambda time: gait.motor_targets([time], zero), DURATION, config, task.fall_angle)
            for one in (robot, without_torque_limits(robot))
        )
    except SurefootError as error:
        yield CheckResult("torque to trot", None, str(error), "training needs a task that fits this robot")
        return
    if isinstance(robot.actuator, JointActuatorData):
        # Without velocity feedforward, the targets are the motion of the legs.
        assert isinstance(task.reference, FootReferenceConfig)
        plain = replace(task, reference=replace(task.reference, velocity_feedforward=0.0)).gait(robot)
        times = np.arange(0.0, DURATION, robot.timing.control_step)
        targets = np.concatenate([plain.motor_targets([time], zero) for time in times])
        speeds = np.abs(np.diff(targets, axis=0)) / robot.timing.control_step
        yield _check_speed(robot, robot.actuator, np.quantile(speeds, _TYPICAL_QUANTILE, axis=0))
    saturation, required = own.saturation.mean(axis=0), np.quantile(np.abs(free.torque), _TYPICAL_QUANTILE, axis=0)
    worst = int(
        np.argmax(
            saturation if saturation.any() else required / [available_torque(robot, k) for k in range(robot.num_motors)]
        )
    )
    fraction, fastest = float(saturation[worst]), float(np.quantile(np.abs(own.speed[:, worst]), _TYPICAL_QUANTILE))
    message = (
        f"{robot.motor_names[worst]} needs {required[worst]:.3g} N m, {describe_torque(robot, worst, fastest)}"
        f"; at its limit {fraction:.0%} of the time"
    )
    if fraction >= MIN_LIMITING_SATURATION:
        message += "; a slower trot with smaller strides needs less"
    low, usual = (load.end.base_position_world[0, 2] for load in (own, free))
    down, able = not own.finished or bool(low < _MIN_HEIGHT_RATIO * usual), free.finished or robot.actuator.kind == "dc"
    weak = down and able and fraction >= _MIN_SATURATED_FRACTION
    rule = "; the robot falls, and does not with stronger motors"
    yield pass_if("torque to trot", not weak, message, rule, TROT_REMEDY, fraction)


def _check_speed(robot: RobotDescription, data: JointActuatorData, required: Array) -> CheckResult:
    """Compare the speeds that a trot requires (M,) [rad/s] with the motors' limits."""
    limits = np.broadcast_to(np.asarray(data.speed_limit, float), required.shape)
    worst = int(np.argmax(required / limits))
    need, limit = float(required[worst]), float(limits[worst])
    message = f"a trot turns {robot.motor_names[worst]} at up to {need:.2g} rad/s, and its limit is {limit:.3g} rad/s"
    remedy = "put the drive's no-load speed into actuator.speed_limit, in rad/s at the joint, or trot slower"
    if 1.2 * need <= math.tau * limit <= _MAX_JOINT_SPEED:
        remedy += f"; if these are revolutions per second, it is {math.tau * limit:.3g} rad/s"
    if limit < _MIN_SPEED_RATIO * need:
        return CheckResult("speed to trot", False, message, remedy, need)
    return warn_if("speed to trot", message if limit < need else None, message, remedy, need)
