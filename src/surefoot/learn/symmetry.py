"""Left-right symmetry: mirror images of samples for symmetric robots.

The policy learns from every sample twice, unchanged and mirrored at the robot's sagittal plane (Mittal et al. 2024,
"Symmetry Considerations for Learning Task Symmetric Robot Policies").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.policy.contract import MEMORY
from surefoot.robot import RobotDescription, SerialLegs
from surefoot.robot.mirror import MAX_SIDE_DIFFERENCE, asymmetry, side_difference
from surefoot.task.commands import CommandState
from surefoot.task.env import LocomotionEnv
from surefoot.task.observation import PARTS

_SIGN_FLIPPED_COLUMNS = (
    *("roll", "roll_rate", "yaw_rate", "base_velocity_y", "gravity_y"),
    *("command_sideways", "command_yaw_rate", "foothold_y"),
)
"""Columns, or prefixes of columns before a point, that change sign in the mirror image."""
_ANGLE_COLUMNS = ("angle", "last_angle", "speed", "joint", "last_joint")
"""Prefixes of motor columns that change sign in the mirror image together with the motor angle."""
_PHASE = ("phase_sin", "phase_cos")
_NAMES_OR_NONE = "legs must be called left and right, or --ppo.no-symmetry learns without mirrored samples"
_BOUND_TOLERANCE = 0.02
"""Difference between bounds of feedback and their mirror images [rad or unit of leg space] that does not matter."""
_LEG_SPACE_GAIN = 4.0
"""Ratio of the difference of poses in leg space to the relative difference of leg lengths; bent legs magnify it."""


def mirror_name(name: str) -> str:
    """Return the name of a leg, motor or column on the other side."""
    return name.replace("left", "\0").replace("right", "left").replace("\0", "right")


def swap_halves(number: int) -> NDArray[np.int64]:
    """Return the indices that swap the first and the second half of a number of values; an odd last one stays."""
    half, places = number // 2, np.arange(number)
    places[:half] += half
    places[half : 2 * half] -= half
    return places


def mirror_motors(robot: RobotDescription) -> dict[str, tuple[str, float]]:
    """Return the motor on the other side for each motor, and the sign of its angle in the mirror image.

    In the mirror image, rotations about the base's x axis (abduction) change sign, and rotations about y keep it.

    Raises:
        SurefootError: a leg on one side without a leg on the other.
    """
    legs, mirror = {leg.name: leg for leg in robot.legs}, {}
    for place, leg in enumerate(robot.legs):
        other = legs.get(mirror_name(leg.name), leg)
        if other is leg and abs(robot.leg_mounts[place, 1]) > MAX_SIDE_DIFFERENCE * robot.leg_geometry.length:
            raise SurefootError(f"symmetry: leg {leg.name} has no counterpart; {_NAMES_OR_NONE}")
        for k, motors in enumerate(zip(leg.motors, other.motors, strict=True)):
            sign = 1.0
            if isinstance(robot.leg_geometry, SerialLegs):
                turn = robot.leg_geometry.turn[:, k]
                sign = float(turn[place] * turn[robot.legs.index(other)])
                sign = -sign if k == 0 and robot.leg_geometry.abducts else sign
            mirror[motors[0]] = (motors[1], sign)
    return mirror


def mirror_columns(
    columns: Sequence[str],
    half_period: bool = False,
    motors: Mapping[str, tuple[str, float]] | None = None,
    extra_flipped: Sequence[str] = (),
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the source column of each column in the mirror image, and its sign, (C,) each.

    Args:
        columns: names of the columns.
        half_period: whether the mirrored reference gait is the reference half a period later.
        motors: result of `mirror_motors`, for columns NAME.MOTOR.
        extra_flipped: columns of plug-ins that change sign.

    Raises:
        SurefootError: a column without a counterpart, or whose counterpart has another one or another sign.
    """
    places = {name: place for place, name in enumerate(columns)}
    motors = motors or {}

    memories = sum(name.startswith(f"{MEMORY}.") for name in columns)

    def other(name: str) -> str:
        prefix, _, motor = name.partition(".")
        if prefix == MEMORY:  # pairs, so that a policy can remember on which side something was
            return f"{MEMORY}.{swap_halves(memories)[int(motor)]}"
        return f"{prefix}.{motors[motor][0]}" if motor in motors else mirror_name(name)

    try:
        source = np.array([places[other(name)] for name in columns], np.int64)
    except KeyError as error:
        raise SurefootError(f"symmetry: column {error} has no counterpart; {_NAMES_OR_NONE}") from None
    flipped = {*_SIGN_FLIPPED_COLUMNS, *extra_flipped, *(_PHASE if half_period else ())}
    sign = [-1.0 if flipped & {name, name.partition(".")[0]} else 1.0 for name in columns]
    for place, name in enumerate(columns):
        prefix, _, motor = name.partition(".")
        if motor in motors and prefix in _ANGLE_COLUMNS:
            sign[place] = motors[motor][1]
    signs = np.array(sign, np.float32)
    if (odd := np.flatnonzero((source[source] != np.arange(len(source))) | (signs[source] != signs))).size:
        raise SurefootError(
            f"symmetry: the mirror image of {columns[source[odd[0]]]} is not {columns[odd[0]]} with the same sign; "
            "give both columns in `flipped` or none, or --ppo.no-symmetry learns without mirrored samples"
        )
    return source, signs


def mirror_note(robot: RobotDescription) -> str | None:
    """Return a one-line note on why a robot can't use mirrored samples, or None if it can."""
    if (reason := asymmetry(robot)) is None:
        return None
    return (
        f"{reason}: training does not use mirrored samples; if the real robot is symmetric, correct its URDF; "
        "--ppo.no-symmetry turns this note off"
    )


def is_half_period_shifted(env: LocomotionEnv) -> bool:
    """Return whether the mirrored reference gait is the reference half a period later, or False if it is the same.

    The tolerance includes differences of leg lengths up to `MAX_SIDE_DIFFERENCE`.

    Raises:
        SurefootError: a reference that is neither.
    """
    reference, legs = env.gait.reference, env.robot.leg_names
    tolerance = 1e-4 + _LEG_SPACE_GAIN * side_difference(env.robot).length / env.robot.leg_geometry.length
    period = reference.period or 1.0
    times = np.linspace(0, period, 64, endpoint=False)
    source, _ = mirror_columns(legs)
    command = np.zeros((64, 3))
    if limits := env.task.commands.limits(env.robot):
        fractions = np.linspace(0, 1, 64)[:, None] * [1, 2, 3] % 1.0
        command = limits.low + fractions * (limits.high - limits.low)
    for half in (False, True):
        later, cycles = times + half * period / 2, times / period
        here = reference.pose(times, CommandState(command, np.ones(64), cycles))
        there = reference.pose(later, CommandState(command * [1, -1, -1], np.ones(64), later / period))
        if np.allclose(here[..., source], there, atol=tolerance):
            return half
    raise SurefootError(
        "ppo.symmetry is set, but the task's reference gait is not left-right symmetric, neither directly nor half a "
        "period later; --ppo.no-symmetry learns without mirrored samples"
    )


class Reflection(NamedTuple):
    """Mirror image of a vector: component k of the image is component source[k] of the vector, times sign[k]."""

    source: torch.Tensor
    """Indices (C,)."""
    sign: torch.Tensor
    """1 or -1 (C,)."""

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """Return the mirror image of values (..., C)."""
        return values[..., self.source] * self.sign


class MirrorSamples:
    """Mirror images of the policy's observations and actions.

    Args:
        env: environment of the samples.

    Raises:
        SurefootError: a robot or a reference gait that is not symmetric.
    """

    def __init__(self, env: LocomotionEnv) -> None:
        half_period = is_half_period_shifted(env)
        columns = {
            "policy": (env.observer.columns, env.task.history),
            "actions": (env.gait.action_names, 1),
        }
        self.reflections: dict[str, Reflection] = {}
        """Reflections of the groups `policy` (observations) and `actions`."""
        motors = mirror_motors(env.robot)
        flipped = [column for name in env.observer.names for column in PARTS[name].flipped]
        for group, (names, times) in columns.items():
            source, sign = mirror_columns(names, half_period, motors, flipped)
            sources = np.concatenate([source + k * len(names) for k in range(times)])
            self.reflections[group] = Reflection(torch.from_numpy(sources), torch.from_numpy(np.tile(sign, times)))
        self._check_bounds(env)

    def _check_bounds(self, env: LocomotionEnv) -> None:
        """Check that mirrored feedback is within the bounds: actions are relative to their middle."""
        low, high, (source, sign) = env.gait.low, env.gait.high, self.reflections["actions"]
        flips = sign.numpy() < 0
        mirrored = np.where(flips, -high[source], low[source]), np.where(flips, -low[source], high[source])
        apart = np.maximum(np.abs(mirrored[0] - low), np.abs(mirrored[1] - high))
        if (odd := np.flatnonzero(apart > _BOUND_TOLERANCE)).size:
            name, own = env.gait.action_names[odd[0]], f"{low[odd[0]]:.3g} to {high[odd[0]]:.3g}"
            image = f"{mirrored[0][odd[0]]:.3g} to {mirrored[1][odd[0]]:.3g}"
            raise SurefootError(
                f"symmetry: {name} is bounded from {own}, and in the mirror image from {image}; bounds must be mirror "
                "images, or --ppo.no-symmetry learns without mirrored samples"
            )

    def mirror(self, group: str, values: torch.Tensor) -> torch.Tensor:
        """Return the mirror image of the values (B, C) of a group: policy or actions."""
        return self.reflections[group](values)
