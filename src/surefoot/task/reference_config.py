"""Configuration of a reference gait: one dataclass for each kind, which makes the reference for a robot."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
import tyro

from surefoot.configuration import Within, check_bounds
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task.foot_kinematics import FootKinematics
from surefoot.task.gait_switch import GaitSwitch
from surefoot.task.leg_config import FootConfig, WaveConfig, check_names
from surefoot.task.periodic_references import FootReference, SineReference, TableReference, read_columns
from surefoot.task.reference import Feedforward, FollowingReference, Reference
from surefoot.task.stride_choice import StrideChoice

VelocityLead = Annotated[float, Within(0, 10)]


@dataclass(frozen=True)
class OverHolesConfig:
    """A gait over holes; units are those of the reference."""

    foot: FootConfig = field(default_factory=FootConfig)
    """Paths of the feet."""
    stride_gain: Annotated[float, Within(0, 3)] = 1.15
    """Length of a stride relative to the stride of a foot that does not slip."""
    frequency_rise: Annotated[float, Within(0, 3)] = 0.0
    """Frequency gained at the longest stride, relative to the frequency on the spot."""


class ReferenceConfig(ABC):
    """Open loop part of the gait, of any kind; the values here are those of kinds without such a field."""

    kind: str
    file: str | None = None
    foothold_radius: float = 0.0
    over_holes: OverHolesConfig | None = None
    relative: bool = False

    def __post_init__(self) -> None:
        """Reject values out of bounds."""
        check_bounds(self, "reference")

    @abstractmethod
    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> Reference:
        """Make the reference of a robot's legs.

        Args:
            robot: the robot.
            commands: limits of the commands, for kind follow.
            params: physical parameters with the actuators' gains, one row. Defaults to the nominal ones.

        Raises:
            SurefootError: an unknown leg, a table that does not fit, or a foot out of reach.
        """


@dataclass(frozen=True)
class NoReferenceConfig(ReferenceConfig):
    """No reference: zero at all times."""

    kind: Literal["none"] = "none"
    """Kind of the reference: none, sine, table, foot or follow. Each has keys of its own."""

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> SineReference:
        """Make a reference without amplitude."""
        return _waves(dict.fromkeys(robot.coordinates, WaveConfig()), robot)


@dataclass(frozen=True)
class SineReferenceConfig(ReferenceConfig):
    """Sinusoids in leg space."""

    kind: Literal["sine"] = "sine"
    """Kind of the reference: none, sine, table, foot or follow. Each has keys of its own."""
    abduction: WaveConfig = field(default_factory=WaveConfig)
    """Abduction of the legs, of robots that have it."""
    swing: WaveConfig = field(default_factory=WaveConfig)
    """Swing of the legs."""
    extension: WaveConfig = field(default_factory=WaveConfig)
    """Extension of the legs."""

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> SineReference:
        """Make the reference, of the coordinates that the robot's legs have."""
        if "abduction" not in robot.coordinates and self.abduction != WaveConfig():
            raise SurefootError(f"reference.abduction is not zero; the legs of {robot.name} have no abduction")
        return _waves({"abduction": self.abduction, "swing": self.swing, "extension": self.extension}, robot)


@dataclass(frozen=True)
class TableReferenceConfig(ReferenceConfig):
    """A table of poses in leg space that is gone through periodically."""

    kind: Literal["table"] = "table"
    """Kind of the reference: none, sine, table, foot or follow. Each has keys of its own."""
    file: str | None = None
    """CSV or NPZ file with columns COORDINATE_LEG, such as swing_front_left."""
    period: Annotated[float, Within(0, 3600, exclusive=True)] | None = None
    """Time [s] in which the table is gone through once."""
    rows: dict[str, dict[str, tuple[float, ...]]] | None = None
    """The table itself instead of `file`: under each coordinate of leg space, each leg's poses."""

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> TableReference:
        """Make the reference, of the rows if they are given, or read the file."""
        if self.rows is None and self.file is None:
            raise SurefootError("reference.file is missing; a reference of kind table needs a CSV or NPZ file")
        if self.period is None:
            raise SurefootError("reference.period is missing; a reference of kind table needs the time of its rows [s]")
        places = [(part, leg) for part in robot.coordinates for leg in robot.leg_names]
        if self.rows is not None:
            where = "reference.rows"
            check_names(self.rows, robot.coordinates, where)
            for part in robot.coordinates:
                check_names(self.rows[part], robot.leg_names, f"{where}.{part}")
            columns = [np.array(self.rows[part][leg]) for part, leg in places]
        else:
            where = self.file or ""
            columns = read_columns(Path(where), [f"{part}_{leg}" for part, leg in places])
        return TableReference.from_columns(robot, self.period, columns, where)


@dataclass(frozen=True)
class FootReferenceConfig(ReferenceConfig):
    """Paths of the feet in their legs' planes that repeat."""

    kind: Literal["foot"] = "foot"
    """Kind of the reference: none, sine, table, foot or follow. Each has keys of its own."""
    foot: FootConfig = field(default_factory=FootConfig)
    """Paths of the feet."""
    velocity_feedforward: VelocityLead = 0.0
    """Time [s] by which commands lead along the velocity of the reference."""
    relative: bool = False
    """Lengths of `foot` count lengths l of the straight leg, its frequency natural frequencies sqrt(g / l) / 2 pi, and
    `velocity_feedforward` the actuators' k_d / k_p, a mean over motors."""

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> FootReference:
        """Make the reference."""
        unit = _lead_units(robot, params)["velocity"] if self.relative else 1.0
        paths = self.foot.paths(robot, self.relative)
        return FootReference(paths, Feedforward(velocity=unit * self.velocity_feedforward))


@dataclass(frozen=True)
class FollowReferenceConfig(ReferenceConfig):
    """Paths of the feet with strides that follow the task's commands."""

    kind: Literal["follow"] = "follow"
    """Kind of the reference: none, sine, table, foot or follow. Each has keys of its own."""
    foot: FootConfig = field(default_factory=FootConfig)
    """Paths of the feet; `foot.stroke` is the longest stride."""
    stride_gain: Annotated[float, Within(0, 3)] = 1.15
    """Length of a stride relative to the stride of a foot that does not slip."""
    frequency_rise: Annotated[float, Within(0, 3)] = 0.0
    """Frequency gained at the longest stride, relative to the frequency on the spot."""
    turn_gain: Annotated[float, Within(0, 100)] = 1.0
    """Part of a stride for turning, relative to that of a foot that does not slip."""
    clearance_rise: Annotated[float, Within(-1, 3)] = 0.0
    """Clearance gained at the longest stride, relative to the clearance on the spot."""
    height_rise: Annotated[float, Within(-0.5, 0.5)] = 0.0
    """Height gained at the longest stride, relative to the height on the spot."""
    foothold_radius: Annotated[float, Within(0, 1)] = 0.0
    """Maximum distance [m] by which feet land beside the ends of their strides, where the map of heights has a gap, an
    edge or a wall there; 0: none."""
    touch_clearance: Annotated[float, Within(0, 1)] = 0.0
    """Maximum height [m] by which feet are lifted further that meet something in their swing."""
    velocity_feedforward: VelocityLead = 0.0
    """Time [s] by which commands lead along the velocity of the reference."""
    acceleration_feedforward: Annotated[float, Within(0, 10)] = 0.0
    """Square of the time [s^2] by which commands lead along the acceleration of the reference: an inertia over k_p
    makes up for it."""
    weight_feedforward: Annotated[float, Within(0, 100)] = 0.0
    """Angle by which commands of legs in stance lead, relative to the lever arm of the weight [rad/m]: m g / k_p makes
    up for what the weight bends actuators."""
    over_holes: OverHolesConfig | None = None
    """The gait while the map of heights has holes, with `foothold_radius`. Defaults to the same gait."""
    relative: bool = False
    """Lengths, with `foothold_radius` and `touch_clearance`, count lengths l of the straight leg, the frequency of
    `foot` natural frequencies sqrt(g / l) / 2 pi, `velocity_feedforward` the actuators' k_d / k_p,
    `acceleration_feedforward` rotors' inertia over k_p, and `weight_feedforward` m g over k_p. These are means over
    motors."""

    def __post_init__(self) -> None:
        """Reject values out of bounds, and a gait over holes without footholds."""
        super().__post_init__()
        if self.over_holes is not None and not self.foothold_radius:
            raise SurefootError("reference.over_holes is given and foothold_radius is 0; holes are found for footholds")

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> FollowingReference:
        """Make the reference, of two gaits if there is one over holes."""
        if commands is None:
            raise SurefootError("reference.kind is follow; it needs commands with a range, and the task has none")
        units = _lead_units(robot, params) if self.relative else {}
        names = ("velocity", "acceleration", "weight")
        ahead = Feedforward(**{name: units.get(name, 1.0) * getattr(self, f"{name}_feedforward") for name in names})
        own = self._choice(self, robot, commands, self.touch_clearance)
        if self.over_holes is None:
            return FollowingReference(own, ahead)
        other = FollowingReference(self._choice(self.over_holes, robot, commands, 0.0), ahead)
        return GaitSwitch(own, ahead, holes_gait=other)

    def _choice(
        self,
        gait: FollowReferenceConfig | OverHolesConfig,
        robot: RobotDescription,
        commands: CommandLimits,
        touch_clearance: float,
    ) -> StrideChoice:
        """Return the strides of one of the two gaits."""
        length = robot.leg_geometry.length if self.relative else 1.0
        kinematics = FootKinematics(
            robot,
            gait.foot.paths(robot, self.relative),
            self.clearance_rise,
            self.height_rise,
            foothold_radius=length * self.foothold_radius,
            touch_clearance=length * touch_clearance,
        )
        return StrideChoice(kinematics, commands, gait.stride_gain, gait.frequency_rise, self.turn_gain)


AnyReferenceConfig = (
    NoReferenceConfig | SineReferenceConfig | TableReferenceConfig | FootReferenceConfig | FollowReferenceConfig
)
REFERENCES: tuple[type[AnyReferenceConfig], ...] = get_args(AnyReferenceConfig)
"""Configurations that a `reference` can be, by its key `kind`; the first one is the default."""
ReferenceField = Annotated[AnyReferenceConfig, tyro.conf.AvoidSubcommands]
"""A field that holds one of them; its options are those of its default's kind."""


def _waves(waves: Mapping[str, WaveConfig], robot: RobotDescription) -> SineReference:
    legs = robot.leg_names
    return SineReference(legs, {part: waves[part].wave(f"reference.{part}", legs) for part in robot.coordinates})


def _lead_units(robot: RobotDescription, params: PhysicalParams | None) -> dict[str, float]:
    """Return the units of relative leads: k_d / k_p, rotors' inertia over k_p, m g / k_p; means over motors."""
    params = PhysicalParams.nominal(robot) if params is None else params
    kp, kd, inertia = (float(np.mean(one[0])) for one in (params.servo_kp, params.servo_kd, params.rotor_inertia))
    return {"velocity": kd / kp, "acceleration": inertia / kp, "weight": robot.weight / kp}
