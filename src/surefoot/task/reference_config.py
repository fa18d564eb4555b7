"""Configuration of a reference gait, and the reference that it makes for a robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import Within, check_bounds
from surefoot.errors import SurefootError, choices, suggest
from surefoot.files import check_readable
from surefoot.npz import read_npz
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task.foot_kinematics import FootKinematics
from surefoot.task.foot_paths import LENGTHS, FootPaths
from surefoot.task.gait_switch import GaitSwitch
from surefoot.task.periodic_references import FootReference, SineReference, TableReference, Wave
from surefoot.task.reference import Feedforward, FollowingReference, Reference
from surefoot.task.stride_choice import StrideChoice

PerLeg = float | dict[str, float]
"""One number, or one for each leg by name."""
Length = Annotated[PerLeg, Within(0, 10)]


@dataclass(frozen=True)
class WaveConfig:
    """A sinusoid for each leg: amplitude sin(2 pi frequency t + phase) + offset."""

    amplitude: PerLeg = 0.0
    """rad"""
    frequency: Annotated[PerLeg, Within(0, 1e6)] = 0.0
    """Hz"""
    phase: PerLeg = 0.0
    """rad"""
    offset: PerLeg = 0.0
    """rad"""


@dataclass(frozen=True)
class FootConfig:
    """Paths of the feet in their legs' planes. A duty factor of 0 or 1 would ask for an infinite speed."""

    frequency: Annotated[float, Within(0.01, 50)] = 2.0
    """Cycles a second [Hz]."""
    stroke: Annotated[PerLeg, Within(-10, 10)] = 0.1
    """How far a foot goes backward in stance, relative to the base [m]; below 0: forward."""
    clearance: Length = 0.03
    """How far a foot is lifted in the middle of its swing [m]."""
    duty_factor: Annotated[PerLeg, Within(0.05, 0.95)] = 0.5
    """Part of the cycle that a foot is on the ground."""
    phase: Annotated[PerLeg, Within(-1000, 1000)] = 0.0
    """When a foot's cycle begins, with its touchdown [cycles]."""
    height: Length = 0.22
    """Of the motor axis over the foot's end at touchdown and lift-off [m]."""
    offset: Annotated[PerLeg, Within(-10, 10)] = 0.0
    """Of the middle of the stroke, forward from the motor axis [m]."""
    depth: Length = 0.0
    """How far a foot is pressed below that height in the middle of its stance [m]."""


@dataclass(frozen=True)
class OverHolesConfig:
    """A gait over holes; units are those of the reference."""

    foot: FootConfig = field(default_factory=FootConfig)
    """Paths of the feet."""
    stride_gain: Annotated[float, Within(0, 3)] = 1.15
    """Stride over that of a foot that does not slip."""
    frequency_rise: Annotated[float, Within(0, 3)] = 0.0
    """Frequency gained at the longest stride, over the frequency on the spot."""


@dataclass(frozen=True)
class ReferenceConfig:
    """The open loop part of the gait."""

    kind: Literal["none", "sine", "table", "foot", "follow"] = "none"
    """none: zero at all times; sine: `swing` and `extension`; table: poses out of `file`, every `period`;
    foot: paths of the feet, `foot`; follow: the same with strides that follow the task's commands."""
    abduction: WaveConfig = field(default_factory=WaveConfig)
    """Abduction of the legs, for kind sine; of robots that have it."""
    swing: WaveConfig = field(default_factory=WaveConfig)
    """Swing of the legs, for kind sine."""
    extension: WaveConfig = field(default_factory=WaveConfig)
    """Extension of the legs, for kind sine."""
    file: str | None = None
    """CSV or NPZ file with columns swing_LEG and extension_LEG, for kind table."""
    period: Annotated[float, Within(0, 3600, above=True)] | None = None
    """Time [s] in which the table is gone through once."""
    foot: FootConfig = field(default_factory=FootConfig)
    """Paths of the feet, for kinds foot and follow."""
    stride_gain: Annotated[float, Within(0, 3)] = 1.15
    """Stride over that of a foot that does not slip, for kind follow; `foot.stroke` is the longest."""
    frequency_rise: Annotated[float, Within(0, 3)] = 0.0
    """Frequency gained at the longest stride, over the frequency on the spot, for kind follow."""
    turn_gain: Annotated[float, Within(0, 100)] = 1.0
    """What a stride has for turning, over that of a foot that does not slip, for kind follow."""
    clearance_rise: Annotated[float, Within(-1, 3)] = 0.0
    """Clearance gained at the longest stride, over that on the spot, for kind follow."""
    height_rise: Annotated[float, Within(-0.5, 0.5)] = 0.0
    """Height gained at the longest stride, over that on the spot, for kind follow."""
    foothold_radius: Annotated[float, Within(0, 1)] = 0.0
    """Greatest distance [m] by which feet land beside the ends of their strides, where the map of heights has a gap, an
    edge or a wall there, for kind follow; 0: none."""
    touch_clearance: Annotated[float, Within(0, 1)] = 0.0
    """Greatest height [m] by which feet are lifted further that meet something in their swing, for kind follow."""
    velocity_feedforward: Annotated[float, Within(0, 10)] = 0.0
    """Time [s] by which commands lead along the velocity of the reference, for kinds foot and follow."""
    acceleration_feedforward: Annotated[float, Within(0, 10)] = 0.0
    """Square of the time [s^2] by which commands lead along the acceleration of the reference, for kind follow: an
    inertia over k_p makes up for it."""
    weight_feedforward: Annotated[float, Within(0, 100)] = 0.0
    """Angle by which commands of legs in stance lead, over the lever arm of the weight [rad/m], for kind follow:
    m g / k_p makes up for what the weight bends actuators."""
    over_holes: OverHolesConfig | None = None
    """The gait while the map of heights has holes, for kind follow with `foothold_radius`; the same one, if not
    given."""
    relative: bool = False
    """Lengths of `foot` count lengths l of the straight leg, its frequency natural frequencies sqrt(g / l) / 2 pi,
    `velocity_feedforward` the actuators' k_d / k_p, `acceleration_feedforward` rotors' inertia over k_p, and
    `weight_feedforward` m g over k_p. These are means over motors."""
    rows: dict[str, dict[str, tuple[float, ...]]] | None = None
    """The table itself, in place of `file`: under each coordinate of leg space, each leg's poses."""

    def __post_init__(self) -> None:
        """Refuse values out of bounds."""
        check_bounds(self, "reference")


def make_reference(
    config: ReferenceConfig,
    robot: RobotDescription,
    commands: CommandLimits | None = None,
    params: PhysicalParams | None = None,
) -> Reference:
    """Make the reference of a robot's legs.

    Args:
        config: what it is; of kind none a sinusoid without amplitude.
        robot: the robot.
        commands: what the robot can be commanded, for kind follow.
        params: with the actuators' gains, one row; nominal, if not given.

    Raises:
        SurefootError: an unknown leg, a table that does not fit, or a foot out of reach.
    """
    if config.kind == "table":
        return _table_reference(config, robot)
    if config.kind == "foot":
        return FootReference(_foot_paths(config.foot, robot, config.relative), _feedforward(config, robot, params))
    if config.kind == "follow":
        if commands is None:
            raise SurefootError("reference.kind is follow; it needs commands with a range, and the task has none")
        return _following_reference(config, robot, commands, params)
    waves = {"abduction": config.abduction, "swing": config.swing, "extension": config.extension}
    if config.kind == "none":
        waves = dict.fromkeys(waves, WaveConfig())
    if "abduction" not in robot.coordinates and waves["abduction"] != WaveConfig():
        raise SurefootError(f"reference.abduction is not zero; the legs of {robot.name} have no abduction")
    legs = robot.leg_names
    return SineReference(
        legs, {part: Wave(**_values_by_leg(waves[part], f"reference.{part}", legs)) for part in robot.coordinates}
    )


def _values_by_leg(config: WaveConfig | FootConfig, where: str, legs: tuple[str, ...]) -> dict[str, Array]:
    """Return each quantity of all legs (L,), of one number or of numbers by leg."""
    values = {}
    for name, value in vars(config).items():
        if not isinstance(value, Mapping):
            value = dict.fromkeys(legs, value)
        _check_names(value, legs, f"{where}.{name}")
        values[name] = np.array([value[leg] for leg in legs], float)
    return values


def _check_names(table: Mapping[str, Any], names: tuple[str, ...], where: str) -> None:
    """Refuse a table whose keys are not exactly `names`."""
    for key in table:
        if key not in names:
            raise SurefootError(f"{where}.{key} is not a key; {suggest(key, names)}")
    missing = [name for name in names if name not in table]
    if missing:
        raise SurefootError(f"{where} lacks {choices(missing)}; it needs {choices(names)}")


def _mean_actuator(robot: RobotDescription, params: PhysicalParams | None) -> tuple[float, float, float]:
    """Return the means over motors of the actuators' k_p, k_d and rotor inertia [kg m2]."""
    params = PhysicalParams.nominal(robot) if params is None else params
    kp, kd, inertia = (float(np.mean(one[0])) for one in (params.servo_kp, params.servo_kd, params.rotor_inertia))
    return kp, kd, inertia


def _foot_paths(config: FootConfig, robot: RobotDescription, relative: bool) -> FootPaths:
    values = _values_by_leg(config, "reference.foot", robot.leg_names)
    frequency = np.array(values.pop("frequency")[0])
    if relative:
        length = robot.leg_geometry.length
        frequency = frequency * np.sqrt(GRAVITY / length) / (2 * np.pi)
        values |= {name: values[name] * length for name in LENGTHS}
    return FootPaths(robot.leg_names, robot.leg_geometry, frequency, **values)


def _feedforward(config: ReferenceConfig, robot: RobotDescription, params: PhysicalParams | None) -> Feedforward:
    velocity, acceleration, weight = 1.0, 1.0, 1.0
    if config.relative:
        kp, kd, inertia = _mean_actuator(robot, params)
        velocity, acceleration, weight = kd / kp, inertia / kp, robot.weight / kp
    return Feedforward(
        velocity * config.velocity_feedforward,
        acceleration * config.acceleration_feedforward,
        weight * config.weight_feedforward,
    )


def _following_reference(
    config: ReferenceConfig, robot: RobotDescription, commands: CommandLimits, params: PhysicalParams | None
) -> FollowingReference:
    length = robot.leg_geometry.length if config.relative else 1.0

    def choice(foot: FootConfig, stride_gain: float, frequency_rise: float, touch_clearance: float) -> StrideChoice:
        kinematics = FootKinematics(
            robot,
            _foot_paths(foot, robot, config.relative),
            config.clearance_rise,
            config.height_rise,
            foothold_radius=length * config.foothold_radius,
            touch_clearance=length * touch_clearance,
        )
        return StrideChoice(kinematics, commands, stride_gain, frequency_rise, config.turn_gain)

    own = choice(config.foot, config.stride_gain, config.frequency_rise, config.touch_clearance)
    ahead, over = _feedforward(config, robot, params), config.over_holes
    if over is None:
        return FollowingReference(own, ahead)
    other = FollowingReference(choice(over.foot, over.stride_gain, over.frequency_rise, 0.0), ahead)
    return GaitSwitch(own, ahead, holes_gait=other)


def _table_reference(config: ReferenceConfig, robot: RobotDescription) -> TableReference:
    legs, coordinates = robot.leg_names, robot.coordinates
    if config.rows is not None:
        where = "reference.rows"
        _check_names(config.rows, coordinates, where)
        for part in coordinates:
            _check_names(config.rows[part], legs, f"{where}.{part}")
        columns = {f"{part}_{leg}": np.array(config.rows[part][leg]) for part in coordinates for leg in legs}
    elif config.file is not None:
        where = config.file
        columns = _read_table(Path(config.file), [f"{part}_{leg}" for part in coordinates for leg in legs])
    else:
        raise SurefootError("reference.file is missing; a reference of kind table needs a CSV or NPZ file")
    if config.period is None:
        raise SurefootError("reference.period is missing; a reference of kind table needs the time of its rows [s]")
    lengths = sorted({len(column) for column in columns.values()})
    if len(lengths) != 1:
        raise SurefootError(f"{where}: columns differ in length ({choices(map(str, lengths))}); make them equal")
    if lengths[0] < 2:
        raise SurefootError(f"{where}: the table has {lengths[0]} row(s); a periodic reference needs 2 or more")
    rows = np.stack(list(columns.values()), axis=1)
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise SurefootError(
            f"{where}: row {int(np.argmax(bad)) + 1} of the table is not finite; every pose must be a number"
        )
    return TableReference(legs, config.period, coordinates, rows.reshape(len(rows), len(coordinates), len(legs)))


def _read_table(path: Path, names: list[str]) -> dict[str, Array]:
    """Return the named columns of a CSV or NPZ file."""
    rule = f"a table has columns {choices(names)}"
    if path.suffix not in (".csv", ".npz"):
        raise SurefootError(f"{path}: is not a .csv or .npz file; {rule}")
    try:
        if path.suffix == ".npz":
            table = {name: np.atleast_1d(values).astype(float) for name, values in read_npz(path).items()}
        else:
            check_readable(path)
            read = np.genfromtxt(path, delimiter=",", names=True, dtype=float)
            table = {name: np.atleast_1d(read[name]) for name in read.dtype.names or ()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:  # Of empty and other files.
        raise SurefootError(f"{path}: can't be read as a table: {' '.join(str(error).split())}; {rule}") from error
    for name in names:
        if name not in table:
            raise SurefootError(f"{path}: has no column {name}; {rule}")
    return {name: table[name] for name in names}
