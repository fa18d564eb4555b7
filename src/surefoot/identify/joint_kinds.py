"""Kinds of joints (hips, thighs, calves), by the position of a motor within its leg."""

from __future__ import annotations

import numpy as np

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS


def motors_by_joint_kind(robot: RobotDescription, prior: PhysicalParams, name: str) -> dict[str, tuple[int, ...]]:
    """Return the motors of each kind of joint by name, if the prior value of a parameter differs between kinds.

    The result is empty if all kinds have the same value, or if the parameter has no value per motor.
    """
    if name not in PARAMETERS or PARAMETERS[name].per != "motors":
        return {}
    values, places = getattr(prior, name)[0], robot.leg_motor_index.T
    means = [float(np.mean(values[motors])) for motors in places]
    if np.allclose(means, means[0]):
        return {}
    return {joint_kind_name(robot, k): tuple(motors.tolist()) for k, motors in enumerate(places)}


def joint_kind_name(robot: RobotDescription, place: int) -> str:
    """Return the name of the joints at a position within the legs: the common ending of their motors' names."""
    endings = [robot.motor_names[motor][::-1] for motor in robot.leg_motor_index[:, place]]
    common = next(
        (k for k in range(min(map(len, endings))) if len({end[: k + 1] for end in endings}) > 1), len(endings[0])
    )
    word = endings[0][:common][::-1].strip("_-. ").removesuffix("joint").removesuffix("Motor").strip("_-. ")
    return f"{word} joints" if word else f"joints {place + 1} of legs"
