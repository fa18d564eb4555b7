"""Observations: named parts of sensor readings and commands, concatenated in the order that the contract states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, suggest
from surefoot.policy.contract import MEMORY
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS
from surefoot.rotations import up_direction
from surefoot.task.height_scan import POLICY_GRID
from surefoot.task.state import RobotState


@dataclass(frozen=True)
class ObservationPart:
    """One named part of an observation."""

    unit: str
    frame: str
    columns: Callable[[RobotDescription], list[str]]
    """Function that returns the names of its columns."""
    read: Callable[[RobotState], Array]
    """Function that returns its values (N, width)."""
    flipped: tuple[str, ...] = ()
    """Columns of a plug-in that change sign in the mirror image. Built-in columns are in `learn.symmetry`."""


def phase(time: Array, period: float | None) -> Array:
    """Return sine and cosine (N, 2) of a reference's phase.

    Args:
        time: time since the episode's start (N,) [s].
        period: period of the reference [s].

    Raises:
        SurefootError: a reference without a period.
    """
    if period is None:
        raise SurefootError("observation 'reference_phase' needs a periodic reference; this task's has no period")
    angle = 2 * np.pi * time / period
    return np.stack([np.sin(angle), np.cos(angle)], -1)


def gait_phase(state: RobotState) -> Array:
    """Return sine and cosine (N, 2) of the gait's phase, scaled by the stepping amplitude if there are commands."""
    if state.gait_state is None:
        return phase(state.readings.time, state.gait.reference.period)
    return state.gait_state.activity[:, None] * phase(state.gait_state.phase, 1.0)


def gravity(roll_pitch_yaw: Array) -> Array:
    """Return the unit vector of gravity in the base frame (N, 3): (0, 0, -1) for a level base."""
    return -up_direction(roll_pitch_yaw)


def _command(state: RobotState) -> Array:
    """Return the commands (N, 3) that the gait follows."""
    if state.gait_state is None:
        raise SurefootError("observation 'command' needs commands with a range; this task has none")
    return state.gait_state.command


def _footholds(state: RobotState) -> Array:
    """Return foothold offsets from nominal stride positions in units of `foothold_radius`, x then y (N, 2 L)."""
    reference, feet = state.gait.reference, state.gait_state
    if feet is None or feet.landing is None:
        raise SurefootError("observation 'footholds' needs reference.foothold_radius; it is 0 here")
    return np.concatenate(np.moveaxis(feet.landing / reference.foothold_radius, -1, 0), axis=1)


def _over_holes(state: RobotState) -> Array:
    """Return the blend weight of the gait over holes (N, 1), 0 to 1."""
    if state.gait_state is None or state.gait_state.over_holes is None:
        raise SurefootError("observation 'over_holes' needs reference.foothold_radius; it is 0 here")
    return state.gait_state.over_holes[:, None]


def _heights(state: RobotState) -> Array:
    """Return the map's terrain heights (N, K) [m]."""
    if state.heights is None:
        raise SurefootError("observation 'height_scan' needs a map of the ground's heights; there is none here")
    return state.heights


def _base_velocity(state: RobotState) -> Array:
    """Return the estimated velocity of the base in its frame (N, 3) [m/s]."""
    if state.base_velocity is None:
        raise SurefootError(f"observation '{BASE_VELOCITY}' needs an estimate of the velocity; there is none here")
    return state.base_velocity


def _motor_columns(prefix: str) -> Callable[[RobotDescription], list[str]]:
    return lambda robot: [f"{prefix}.{name}" for name in robot.motor_names]


def _angular_velocity(axis: int) -> Callable[[RobotState], Array]:
    return lambda state: state.readings.angular_velocity_base[:, axis : axis + 1]


OVER_HOLES = "over_holes"
"""Name of the observation of the blend weight of the gait over holes, and of its column."""
BASE_VELOCITY = "base_velocity"
"""Name of the observation of the estimated velocity of the base, and prefix of its columns."""

PARTS: dict[str, ObservationPart] = {
    "roll": ObservationPart("rad", "base in world", lambda _: ["roll"], lambda m: m.readings.roll_pitch_yaw[:, 0:1]),
    "pitch": ObservationPart("rad", "base in world", lambda _: ["pitch"], lambda m: m.readings.roll_pitch_yaw[:, 1:2]),
    "gravity": ObservationPart(
        "1", "base", lambda _: ["gravity_x", "gravity_y", "gravity_z"], lambda m: gravity(m.readings.roll_pitch_yaw)
    ),
    "roll_rate": ObservationPart("rad/s", "base, about x", lambda _: ["roll_rate"], _angular_velocity(0)),
    "pitch_rate": ObservationPart("rad/s", "base, about y", lambda _: ["pitch_rate"], _angular_velocity(1)),
    "motor_angles": ObservationPart("rad", "motor", _motor_columns("angle"), lambda m: m.readings.motor_angle),
    "motor_speeds": ObservationPart("rad/s", "motor", _motor_columns("speed"), lambda m: m.readings.motor_velocity),
    "yaw_rate": ObservationPart("rad/s", "base, about z", lambda _: ["yaw_rate"], _angular_velocity(2)),
    "reference_phase": ObservationPart("1", "reference gait", lambda _: ["phase_sin", "phase_cos"], gait_phase),
    "command": ObservationPart(
        "m/s, m/s, rad/s", "heading: x forward, y left", lambda _: [f"command_{name}" for name in COMMANDS], _command
    ),
    BASE_VELOCITY: ObservationPart(
        "m/s", "base", lambda _: [f"{BASE_VELOCITY}_{axis}" for axis in "xyz"], _base_velocity
    ),
    "height_scan": ObservationPart(
        "m", "heading, from the base's origin: x forward, y left, z up", lambda _: POLICY_GRID.columns(), _heights
    ),
    "footholds": ObservationPart(
        "foothold_radius",
        "heading: x forward, y left",
        lambda robot: [f"foothold_{axis}.{leg}" for axis in "xy" for leg in robot.leg_names],
        _footholds,
    ),
    OVER_HOLES: ObservationPart("1", "share of the gait over holes", lambda _: [OVER_HOLES], _over_holes),
    "last_action": ObservationPart(
        "rad",
        "leg space",
        lambda robot: [f"last_{part}.{leg}" for part in robot.coordinates for leg in robot.leg_names],
        lambda m: m.feedback[:, : m.feedback.shape[1] - m.gait.memory],
    ),
    "memory": ObservationPart(
        "as the policy gave it",
        "policy",
        lambda _: [],
        lambda m: m.feedback[:, m.feedback.shape[1] - m.gait.memory :],
    ),
}
"""Available observations by name."""

IMU_4D = ("roll", "pitch", "roll_rate", "pitch_rate")
"""The paper's small space (Tan et al. 2018, section VI-B)."""
IMU_AND_MOTORS_12D = (*IMU_4D, "motor_angles")
"""The paper's large space (section IV-B)."""


class Observer:
    """Builder of a robot's observations.

    Args:
        robot: the robot.
        names: names of observations from `PARTS`, in order, without repetition.
        actions: names of the feedback's columns. Defaults to coordinates of leg space.

    Raises:
        SurefootError: no names, unknown or repeated names.
    """

    def __init__(self, robot: RobotDescription, names: tuple[str, ...], actions: Sequence[str] | None = None) -> None:
        if not names:
            raise SurefootError(f"observations is empty; choices: {choices(PARTS)}")
        for name in names:
            if name not in PARTS:
                raise SurefootError(f"observation '{name}' does not exist; {suggest(name, PARTS)}")
        if len(set(names)) != len(names):
            raise SurefootError(f"observations are {choices(names)}; names must not repeat")
        self.names = names
        columns = {name: PARTS[name].columns(robot) for name in names}
        memory = [action for action in actions or () if action.startswith(f"{MEMORY}.")]
        if actions is not None and "last_action" in columns:
            columns["last_action"] = [f"last_{action}" for action in actions if action not in memory]
        if "memory" in columns:
            columns["memory"] = memory
        self.columns = [column for name in names for column in columns[name]]
        if len(set(self.columns)) != len(self.columns):
            raise SurefootError(f"columns of the observation are {choices(self.columns)}; names must not repeat")

    @property
    def width(self) -> int:
        """Number of columns of an observation."""
        return len(self.columns)

    def observe(self, state: RobotState) -> Array:
        """Return the observations (N, width) in SI units, without normalization."""
        return np.concatenate([PARTS[name].read(state) for name in self.names], axis=1)

    def describe(self) -> list[dict[str, str]]:
        """Return the name, unit and frame of each part, for the contract."""
        return [{"name": name, "unit": PARTS[name].unit, "frame": PARTS[name].frame} for name in self.names]
