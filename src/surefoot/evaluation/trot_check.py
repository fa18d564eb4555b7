"""Check of what a trot asks of a robot's motors, before anything is trained."""

from __future__ import annotations

import numpy as np

from surefoot.check_result import CheckResult, judge
from surefoot.errors import SurefootError
from surefoot.evaluation.runs import SATURATION
from surefoot.robot import RobotDescription
from surefoot.task.config import load_task
from surefoot.world.interface import WorldConfig
from surefoot.world.motor_load import available_torque, describe_torque, measure_load, unlimited

DURATION = 3.0
"""How long the robot trots [s]: six strides and more."""
_USUAL = 0.95
"""Share of the time for which the torque is below the one that is reported."""
_MOST = 0.5
"""Share of the time at the limit from which a fall is put down to the motor."""
_SUNK = 0.7
"""Height of the base, over that with any torque, below which a robot lies."""
REMEDY = "take stronger motors or a lighter robot, or trot slower with smaller strides (frequency, stroke of a task)"


def check_trot(robot: RobotDescription) -> CheckResult:
    """Run the reference of the task `trot` without feedback; compare the torque that it asks for with what is there.

    What it asks for is measured with motors that have any torque. It fails if the robot falls with its own motors, one
    of them at its limit for most of the time, and does not with those. Many robots fall without feedback, which
    training mends.
    """
    try:
        task, _ = load_task("trot", str(robot.folder))
        gait = task.gait(robot)
        zero = np.zeros((1, len(gait.action_names)))
        config = WorldConfig(rest=task.rest or gait.rest, actuator=task.actuator, threads=1)
        own, free = (
            measure_load(one, lambda time: gait.motor_targets([time], zero), DURATION, config, task.fall_angle)
            for one in (robot, unlimited(robot))
        )
    except SurefootError as error:
        return CheckResult("torque to trot", None, str(error), "training needs a task that fits this robot")
    shares, asked = own.saturation.mean(axis=0), np.quantile(np.abs(free.torque), _USUAL, axis=0)
    worst = int(
        np.argmax(shares if shares.any() else asked / [available_torque(robot, k) for k in range(robot.num_motors)])
    )
    share, fastest = float(shares[worst]), float(np.quantile(np.abs(own.speed[:, worst]), _USUAL))
    message = (
        f"{robot.motor_names[worst]} is asked for {asked[worst]:.3g} N m, {describe_torque(robot, worst, fastest)}"
        f"; at its limit in {share:.0%} of the time"
    )
    if share >= SATURATION:
        message += "; a slower trot with smaller strides asks for less"
    low, usual = (load.end.base_position_world[0, 2] for load in (own, free))
    down, able = not own.finished or bool(low < _SUNK * usual), free.finished or robot.actuator.kind == "dc"
    weak = down and able and share >= _MOST
    rule = "; the robot goes down, with stronger motors it does not"
    return judge("torque to trot", not weak, message, rule, REMEDY, share)
