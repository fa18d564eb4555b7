"""Lines of an imported robot's data sheet: numbers of the file and estimates of missing ones, with their origins."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.robot.actuator import MIN_PLACEHOLDER_TORQUE
from surefoot.robot.data_sheet import GRAVITY
from surefoot.robot.importing.imported import ImportedRobot
from surefoot.robot.importing.resting_poses import is_standing
from surefoot.robot.importing.rules import GUESS_PREFIX, Rule, actuator_rules, damping_rule, one_line
from surefoot.robot.importing.units import MIN_PLACEHOLDER_SPEED, explain_speeds

_MAX_SPREAD = 0.06
"""Maximum deviation of a leg's pose in a keyframe from the mean over legs, in leg space."""


def motor_order(robot: ImportedRobot) -> str:
    """Return the line with the motor order."""
    if robot.motor_order:
        return f"order = {json.dumps(robot.motor_order)}  # the order of the actuators in {one_line(robot.path.name)}"
    names: tuple[str, ...] = sum(robot.joints, ())
    return f"order = {json.dumps(names)}  # {GUESS_PREFIX}leg by leg; take the order of the robot's own interface"


def leg_space(robot: ImportedRobot) -> list[str]:
    """Return lines with the command ranges: abduction and extension within the limits of their joints, usual swing."""
    upper, lower = np.linalg.norm(robot.links, axis=-1)
    bends = np.sort(np.abs(robot.knee_bends), axis=1)
    bends[np.prod(robot.knee_bends, axis=1) < 0, 0] = 0.0  # the straight leg is in the knee's range
    reach = np.hypot(upper + lower * np.cos(bends.T), lower * np.sin(bends.T)) / (upper + lower)
    low = float(np.fmax.reduce(reach[1] + 0.02, initial=0.35))
    high = float(np.fmin.reduce(reach[0] - 0.01, initial=0.97))
    abducts = len(robot.joints[0]) == 3
    abduction = float(np.fmin.reduce(np.abs(robot.limits[:, 0]), axis=None, initial=0.5))
    rest = [*[0.0] * (1 + abducts), round(min(max(0.75, low + 0.05), high - 0.05), 3)]
    origin = f"{GUESS_PREFIX}stands with legs straight down"
    lows, highs = [-abduction, -1.0, low][-len(rest) :], [abduction, 1.0, high][-len(rest) :]
    if (standing := standing_pose(robot)) is not None:
        source, pose = standing
        if (pose >= lows).all() and (pose <= highs).all():
            rest, origin = [round(float(value), 3) + 0.0 for value in pose], f"{source} of {robot.path.name}"
    return [
        *([f"abduction = [{-abduction:.3g}, {abduction:.3g}]"] if abducts else []),
        "swing = [-1.0, 1.0]",
        f"extension = [{low:.3g}, {high:.3g}]",
        f"rest = {rest}  # {one_line(origin)}",
    ]


def standing_pose(robot: ImportedRobot) -> tuple[str, Array] | None:
    """Return source and mean leg pose of the first keyframe in which the robot stands with equal legs, or None."""
    for source, angles in robot.poses:
        if not source.startswith("keyframe") or not is_standing(source) or not np.isfinite(angles).all():
            continue
        poses = robot.to_leg_space(angles)
        if np.abs(poses - poses.mean(axis=0)).max() <= _MAX_SPREAD:
            return source, poses.mean(axis=0)
    return None


def actuator(robot: ImportedRobot) -> list[str]:
    """Return lines with actuator data: the file's numbers, and estimates for missing numbers and placeholders."""
    mass, length, shape = robot.mass, robot.length, robot.torque.shape
    rules, file = actuator_rules(mass, length), f"from {robot.path.name}"

    def line(key: str, values: ArrayLike, comment: str) -> str:
        """Return a line with one number for all motors, one per motor of a leg, or one per motor."""
        numbers = np.array([[float(f"{value:.4g}") for value in row] for row in np.broadcast_to(values, shape)])
        if np.ptp(numbers, axis=0).any():
            # Values in the motor order.
            by_name = dict(zip(sum(robot.joints, ()), numbers.ravel().tolist(), strict=True))
            value = [by_name[name] for name in robot.motor_order or by_name]
        else:
            value = numbers[0].tolist()
        text = value if np.ptp(numbers) else value[0]
        return f"{key} = {text}  # {one_line(comment)}"

    def stated(key: str, values: Array, real: NDArray[np.bool_], rule: Rule, why: str = "") -> str:
        numbers = np.where(real, values, rule.value)
        if real.all():
            return line(key, numbers, f"{rule.unit}, {file}")
        some = "" if not real.any() else f" for {_names(robot, ~real)}, else {file}"
        return line(key, numbers, f"{GUESS_PREFIX}{rule.text}{why}{some} ({rule.unit})")

    has_kp, has_kd = np.isfinite(robot.kp), np.isfinite(robot.kd)
    kp = np.where(has_kp, robot.kp, rules["kp"].value)
    kd_rule = damping_rule(float(kp.mean()), length)
    stiffness = mass * GRAVITY * length
    real_torque = (robot.torque > 0) & (robot.torque < MIN_PLACEHOLDER_TORQUE * stiffness)
    real_speed = (robot.speed > 0) & (robot.speed < MIN_PLACEHOLDER_SPEED)
    speed = np.where(real_speed, robot.speed, rules["speed_limit"].value)
    why_speed = explain_speeds(robot.speed[~real_speed]) if not real_speed.all() else ""
    return [
        stated("kp", robot.kp, has_kp, rules["kp"]),
        stated("kd", robot.kd, has_kd, kd_rule),
        stated("torque_limit", robot.torque, real_torque, rules["torque_limit"], "; the file has no real limit"),
        stated("speed_limit", robot.speed, real_speed, rules["speed_limit"], f"; {why_speed}"),
        line("full_torque_speed", 0.5 * speed, f"{GUESS_PREFIX}half of the speed limit (rad/s)"),
        stated("rotor_inertia", robot.rotor_inertia, robot.rotor_inertia > 0, rules["rotor_inertia"]),
        line("friction", robot.friction, f"N m, Coulomb, {_friction_origin(robot, robot.friction)}"),
        line("viscous_friction", robot.damping, f"N m s/rad, {_friction_origin(robot, robot.damping)}"),
    ]


def _friction_origin(robot: ImportedRobot, values: Array) -> str:
    """Return the origin of friction values as text."""
    if values.any():
        return f"from {robot.path.name}"
    is_kd = values is robot.damping and robot.damping_is_kd
    return f"the damping in {robot.path.name} is the controller's kd" if is_kd else f"{robot.path.name} has none"


def _names(robot: ImportedRobot, which: NDArray[np.bool_]) -> str:
    """Return the names of selected joints as text, at most three and the number of the others."""
    names: Sequence[str] = [name for name, chosen in zip(sum(robot.joints, ()), which.ravel(), strict=True) if chosen]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
