"""Configuration of reference gaits: one dataclass per kind, with a method that makes the reference for a robot."""

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
from surefoot.task.gait_switch import GaitSwitch
from surefoot.task.leg_config import FootConfig, WaveConfig, check_names
from surefoot.task.periodic_references import FootReference, SineReference, TableReference, read_columns
from surefoot.task.reference import Feedforward, FollowingReference, Reference
from surefoot.task.stepping_kinematics import SteppingKinematics
from surefoot.task.stride_choice import StrideChoice

VelocityLead = Annotated[float, Within(0, 10)]


@dataclass(frozen=True)
class OverHolesConfig:
    """Second gait for terrain with holes, in the units of the reference."""

    foot: FootConfig = field(default_factory=FootConfig)
    """Foot trajectories."""
    stride_gain: Annotated[float, Within(0, 3)] = 1.15
    """Stride length relative to the stride of a foot that does not slip."""
    frequency_rise: Annotated[float, Within(0, 3)] = 0.0
    """Increase of the frequency at the maximum stride, relative to the frequency when stepping in place."""


class ReferenceConfig(ABC):
    """Base class of reference configurations, with default values for kinds that lack a field."""

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
        """Make the reference for a robot.

        Args:
            robot: the robot.
            commands: limits of the commands, for kind follow.
            params: physical parameters with the actuators' gains, as one row. Defaults to nominal values.

        Raises:
            SurefootError: an unknown leg, a table that does not fit, or a foot out of reach.
        """


@dataclass(frozen=True)
class NoReferenceConfig(ReferenceConfig):
    """No reference: all coordinates are zero."""

    kind: Literal["none"] = "none"
    """Kind of reference: none, sine, table, foot or follow. Each kind has its own keys."""

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> SineReference:
        """Make a reference without amplitude."""
        return _waves(dict.fromkeys(robot.coordinates, WaveConfig()), robot)


@dataclass(frozen=True)
class SineReferenceConfig(ReferenceConfig):
    """Sinusoids in leg space."""

    kind: Literal["sine"] = "sine"
    """Kind of reference: none, sine, table, foot or follow. Each kind has its own keys."""
    abduction: WaveConfig = field(default_factory=WaveConfig)
    """Abduction of the legs, for robots with abduction."""
    swing: WaveConfig = field(default_factory=WaveConfig)
    """Swing of the legs."""
    extension: WaveConfig = field(default_factory=WaveConfig)
    """Extension of the legs."""

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> SineReference:
        """Make the reference for the coordinates of the robot's legs."""
        if "abduction" not in robot.coordinates and self.abduction != WaveConfig():
            raise SurefootError(f"reference.abduction is not zero; the legs of {robot.name} have no abduction")
        return _waves({"abduction": self.abduction, "swing": self.swing, "extension": self.extension}, robot)


@dataclass(frozen=True)
class TableReferenceConfig(ReferenceConfig):
    """A periodic table of poses in leg space."""

    kind: Literal["table"] = "table"
    """Kind of reference: none, sine, table, foot or follow. Each kind has its own keys."""
    file: str | None = None
    """CSV or NPZ file with columns COORDINATE_LEG, such as swing_front_left."""
    period: Annotated[float, Within(0, 3600, exclusive=True)] | None = None
    """Period of the table [s]."""
    rows: dict[str, dict[str, tuple[float, ...]]] | None = None
    """The table itself instead of `file`: for each coordinate of leg space, the poses of each leg over time."""

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> TableReference:
        """Make the reference from `rows`, or from the file."""
        if self.rows is None and self.file is None:
            raise SurefootError("reference.file is missing; a reference of kind table needs a CSV or NPZ file")
        if self.period is None:
            raise SurefootError("reference.period is missing; a reference of kind table needs its period [s]")
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
    """Periodic foot trajectories in the legs' planes."""

    kind: Literal["foot"] = "foot"
    """Kind of reference: none, sine, table, foot or follow. Each kind has its own keys."""
    foot: FootConfig = field(default_factory=FootConfig)
    """Foot trajectories."""
    velocity_feedforward: VelocityLead = 0.0
    """Feedforward gain on the velocity of the reference [s]."""
    relative: bool = False
    """Use relative units, so that the reference fits any robot: lengths in lengths l of the straight leg, the frequency
    in sqrt(g / l) / 2 pi, and `velocity_feedforward` in k_d / k_p of the actuators (mean over motors)."""

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> FootReference:
        """Make the reference."""
        unit = _lead_units(robot, params)["velocity"] if self.relative else 1.0
        paths = self.foot.paths(robot, self.relative)
        return FootReference(paths, Feedforward(velocity=unit * self.velocity_feedforward))


@dataclass(frozen=True)
class FollowReferenceConfig(ReferenceConfig):
    """Foot trajectories whose strides follow the task's commands."""

    kind: Literal["follow"] = "follow"
    """Kind of reference: none, sine, table, foot or follow. Each kind has its own keys."""
    foot: FootConfig = field(default_factory=FootConfig)
    """Foot trajectories. `foot.stroke` is the maximum stride."""
    stride_gain: Annotated[float, Within(0, 3)] = 1.15
    """Stride length relative to the stride of a foot that does not slip."""
    frequency_rise: Annotated[float, Within(0, 3)] = 0.0
    """Increase of the frequency at the maximum stride, relative to the frequency when stepping in place."""
    turn_gain: Annotated[float, Within(0, 100)] = 1.0
    """Gain on the part of a stride that turns the robot."""
    clearance_rise: Annotated[float, Within(-1, 3)] = 0.0
    """Increase of the clearance at the maximum stride, relative to the clearance when stepping in place."""
    height_rise: Annotated[float, Within(-0.5, 0.5)] = 0.0
    """Increase of the base height at the maximum stride, relative to the height when stepping in place."""
    foothold_radius: Annotated[float, Within(0, 1)] = 0.0
    """Maximum distance [m] of footholds from the ends of strides, if the map of heights has a gap, an edge or a wall
    there; 0: no foothold choice."""
    touch_clearance: Annotated[float, Within(0, 1)] = 0.0
    """Maximum additional lift [m] of feet that hit an obstacle in swing; 0: no contact reflex."""
    velocity_feedforward: VelocityLead = 0.0
    """Feedforward gain on the velocity of the reference [s]."""
    acceleration_feedforward: Annotated[float, Within(0, 10)] = 0.0
    """Feedforward gain on the acceleration of the reference [s^2]; inertia / k_p compensates for an inertia."""
    weight_feedforward: Annotated[float, Within(0, 100)] = 0.0
    """Feedforward gain on the lever arm of the weight, for legs in stance [rad/m]; m g / k_p compensates for the
    deflection of actuators under the weight."""
    over_holes: OverHolesConfig | None = None
    """Second gait while the map of heights shows holes; needs `foothold_radius`. Defaults to the same gait."""
    relative: bool = False
    """Use relative units, so that the reference fits any robot: lengths (also `foothold_radius` and `touch_clearance`)
    in lengths l of the straight leg, the frequency in sqrt(g / l) / 2 pi, `velocity_feedforward` in k_d / k_p of the
    actuators, `acceleration_feedforward` in rotor inertia / k_p, and `weight_feedforward` in m g / k_p (means over
    motors)."""

    def __post_init__(self) -> None:
        """Reject values out of bounds, and a gait over holes without footholds."""
        super().__post_init__()
        if self.over_holes is not None and not self.foothold_radius:
            raise SurefootError(
                "reference.over_holes is given, but foothold_radius is 0; holes are detected only to choose footholds"
            )

    def make(
        self, robot: RobotDescription, commands: CommandLimits | None = None, params: PhysicalParams | None = None
    ) -> FollowingReference:
        """Make the reference, with two gaits if there is one for holes."""
        if commands is None:
            raise SurefootError("reference.kind is follow; it needs commands with a range, and the task has none")
        units = _lead_units(robot, params) if self.relative else {}
        names = ("velocity", "acceleration", "weight")
        gains = Feedforward(**{name: units.get(name, 1.0) * getattr(self, f"{name}_feedforward") for name in names})
        own = self._choice(self, robot, commands, self.touch_clearance)
        if self.over_holes is None:
            return FollowingReference(own, gains)
        other = FollowingReference(self._choice(self.over_holes, robot, commands, 0.0), gains)
        return GaitSwitch(own, gains, holes_gait=other)

    def _choice(
        self,
        gait: FollowReferenceConfig | OverHolesConfig,
        robot: RobotDescription,
        commands: CommandLimits,
        touch_clearance: float,
    ) -> StrideChoice:
        """Return the stride choice of one of the two gaits."""
        length = robot.leg_geometry.length if self.relative else 1.0
        kinematics = SteppingKinematics(
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
"""Configuration classes of `reference`, chosen by its key `kind`. The first one is the default."""
ReferenceField = Annotated[AnyReferenceConfig, tyro.conf.AvoidSubcommands]
"""Type of a field with a reference configuration. Its command-line options depend on the kind of its default."""


def _waves(waves: Mapping[str, WaveConfig], robot: RobotDescription) -> SineReference:
    legs = robot.leg_names
    return SineReference(legs, {part: waves[part].wave(f"reference.{part}", legs) for part in robot.coordinates})


def _lead_units(robot: RobotDescription, params: PhysicalParams | None) -> dict[str, float]:
    """Return the units of relative feedforward gains: k_d / k_p, rotor inertia / k_p, m g / k_p; means over motors."""
    params = PhysicalParams.nominal(robot) if params is None else params
    kp, kd, inertia = (float(np.mean(one[0])) for one in (params.servo_kp, params.servo_kd, params.rotor_inertia))
    if not kp > 0:
        raise SurefootError(f"reference.relative needs a servo_kp over 0, by which its gains are scaled; it is {kp:g}")
    return {"velocity": kd / kp, "acceleration": inertia / kp, "weight": robot.weight / kp}
