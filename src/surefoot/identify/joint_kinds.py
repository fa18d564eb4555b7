"""Kinds of joints: hips, thighs and calves, by the place of a motor in its leg."""

from __future__ import annotations

import numpy as np

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS


def motors_by_joint_kind(robot: RobotDescription, prior: PhysicalParams, name: str) -> dict[str, tuple[int, ...]]:
    """Return the motors of each kind of joint by its name, where the prior has a number for each kind; else none."""
    if name not in PARAMETERS or PARAMETERS[name].per != "motors":
        return {}
    values, places = getattr(prior, name)[0], robot.leg_motor_index.T
    means = [float(np.mean(values[motors])) for motors in places]
    if np.allclose(means, means[0]):
        return {}
    return {joint_kind_name(robot, k): tuple(motors.tolist()) for k, motors in enumerate(places)}


def joint_kind_name(robot: RobotDescription, place: int) -> str:
    """Return the name of the joints at a place of every leg: what their motors' names have in common at the end."""
    ends = [robot.motor_names[motor][::-1] for motor in robot.leg_motor_index[:, place]]
    common = next((k for k in range(min(map(len, ends))) if len({end[: k + 1] for end in ends}) > 1), len(ends[0]))
    word = ends[0][:common][::-1].strip("_-. ").removesuffix("joint").removesuffix("Motor").strip("_-. ")
    return f"{word} joints" if word else f"joints {place + 1} of legs"
