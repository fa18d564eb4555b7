"""The data sheet of a robot, `robot.toml`: its tables, and defaults for missing entries."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from surefoot.configuration import NotNegative, Positive, Within, from_mapping, is_number
from surefoot.errors import SurefootError, choices, quote, suggest
from surefoot.robot.leg import FiveBar, Legs
from surefoot.robot.urdf import Urdf

GRAVITY = 9.81
"""Gravitational acceleration [m/s2]."""
Range = tuple[float, float]
Point = tuple[float, float, float]
_Voltage = Annotated[float, Within(1, 1e3)]

_DEFAULT_LEG_SPACE = {"abduction": (-0.5, 0.5), "swing": (-1.0, 1.0), "extension": (0.35, 0.97)}
"""Default command ranges of serial legs: angles [rad], and extension relative to the straight leg's length."""
_DEFAULT_REST_EXTENSION = 0.75
"""Default resting extension of serial legs relative to the straight leg's length."""
_SINKAGE_RATIO = 0.01
"""Static sinkage of a foot that carries its fraction of the weight, relative to the leg length."""


@dataclass(frozen=True)
class Leg:
    """Names of one leg's motor joints, passive knee joints and foot link.

    The motors of a five-bar leg are theta_1 and theta_2, the motors of a serial leg (abduction,) hip and knee.
    """

    motors: tuple[str, ...]
    foot: str
    knees: tuple[str, ...] = ()
    knee: Literal["forward", "backward"] = "backward"
    """Direction in which the knee of a serial leg points."""
    name: str = ""
    """Name of the leg's table in the data sheet."""


@dataclass(frozen=True)
class Loop:
    """A pin joint that closes a loop between two links: its position [m] in each link's frame."""

    links: tuple[str, str]
    points: tuple[Point, Point]


@dataclass(frozen=True)
class Timing:
    """Nominal servo step, control step and latencies [s]."""

    servo_step: Positive = 0.001
    control_step: Positive = 0.010
    servo_latency: NotNegative = 0.002
    control_latency: NotNegative = 0.010
    command_timeout: Positive = 0.050
    """Time without a command after which the board of an armed robot damps the motors [s]; at least three control
    steps."""


@dataclass(frozen=True)
class ContactData:
    """Contact of foot and ground: friction coefficient, spinning friction [m], stiffness [N/m], damping [N s/m]."""

    stiffness: Positive
    damping: Positive
    friction: Positive = 0.8
    spinning_friction: NotNegative = 0.004
    self_collision: bool = False
    """Whether legs collide with each other and with the base; defaults to true for robots without closed loops."""


@dataclass(frozen=True)
class Poses:
    """Poses between gaits in leg space, the same for all legs."""

    sit: tuple[float, ...]
    """Sitting pose, low enough that the robot drops unharmed when its motors are released."""
    spread: float | None = None
    """Swing [rad] of legs that lie next to the body, about as far as they slide when the motors are released; None:
    legs do not slide out from under the body."""


@dataclass(frozen=True)
class Battery:
    """Battery voltages [V], and the model of an emulated battery."""

    nominal: _Voltage
    warn: _Voltage
    """Voltage under load below which a deployment warns."""
    low: _Voltage
    """Voltage under load below which the robot sits down."""
    empty: _Voltage
    """Voltage below which the robot damps its motors."""
    capacity: Positive = 3.0
    """Charge [A h]."""
    drop: Positive = 2.8
    """Drop of the open-circuit voltage [V] from full to empty; the default is four cells from 4.2 to 3.5 V."""
    resistance: NotNegative = 0.015
    """Internal resistance [Ohm]; the default is four lithium cells of about 3.5 mOhm each, and their leads."""

    def __post_init__(self) -> None:
        """Reject voltages that do not rise from empty to warn."""
        if not self.empty <= self.low <= self.warn:
            raise SurefootError(
                f"battery: empty is {self.empty:g} V, low {self.low:g} V, warn {self.warn:g} V; they must increase"
            )


@dataclass(frozen=True)
class Heat:
    """Temperature limits of the hottest motor [degC], and the thermal model of an emulated motor."""

    warn: Positive = 70.0
    """Temperature at which a deployment warns once; by default a walking robot reaches `high` some minutes later."""
    high: Positive = 80.0
    """Temperature at which the robot sits down; the default is what magnets and glue of small outrunners withstand."""
    limit: Positive = 90.0
    """Temperature at which the robot damps its motors."""
    capacity: Positive = 80.0
    """Heat capacity of one motor [J/K]; the default is about 200 g of copper and iron at 0.4 J/(g K)."""
    resistance: Positive = 1.5
    """Thermal resistance from winding to air [K/W]; with the default capacity, a time constant of two minutes."""

    def __post_init__(self) -> None:
        """Reject temperatures that do not rise from warn to limit."""
        if not self.warn <= self.high <= self.limit:
            raise SurefootError(
                f"heat: warn is {self.warn:g} degC, high {self.high:g} degC, limit {self.limit:g} degC; "
                "they must increase"
            )


@dataclass(frozen=True)
class Motors:
    """Names of the motor joints in order, and their signs (joint angle = sign * motor angle); by default all 1."""

    order: tuple[str, ...]
    sign: tuple[Literal[-1, 1], ...] = ()


@dataclass(frozen=True)
class LegSpace:
    """Command ranges of the legs, and their resting pose; angles in rad."""

    abduction: Range | None = None
    swing: Range | None = None
    extension: Range | None = None
    rest: tuple[float, ...] | None = None


@dataclass(frozen=True)
class DataSheet:
    """Content of a `robot.toml`; `legs` has the list `order` and one table per leg."""

    name: str
    urdf: str
    base: str
    motors: Motors
    legs: dict[str, Any]
    actuator: dict[str, Any]
    body_length: Annotated[float | None, Within(0, 1e9, exclusive=True)] = None
    leg_geometry: FiveBar | None = None
    visuals: str | None = None
    loops: tuple[Loop, ...] = ()
    leg_space: LegSpace = field(default_factory=LegSpace)
    timing: Timing = field(default_factory=Timing)
    contact: dict[str, Any] = field(default_factory=dict)
    poses: dict[str, Any] = field(default_factory=dict)
    battery: dict[str, Any] = field(default_factory=dict)
    heat: Heat = field(default_factory=Heat)
    experiments: dict[str, Any] = field(default_factory=dict)
    allowed: dict[str, Range] = field(default_factory=dict)
    priors: dict[str, NotNegative] = field(default_factory=dict)

    def read_legs(self, urdf: Urdf) -> tuple[Leg, ...]:
        """Parse the legs in order; reject names that the URDF does not have, and legs of different kinds."""
        hinges = [name for name, joint in urdf.joints.items() if joint.kind != "fixed"]
        motors, tables = self.motors.order, dict(self.legs)
        order = tables.pop("order", None)
        if not isinstance(order, list) or not order or sorted(map(str, order)) != sorted(tables):
            raise SurefootError(f"legs.order is {quote(order)}; it must name each leg once: {choices(tables)}")
        legs = tuple(replace(from_mapping(Leg, tables[name], f"legs.{name}"), name=name) for name in order)
        check_names("base", (self.base,), urdf.links)
        check_names("motors.order", motors, hinges)
        if self.motors.sign and len(self.motors.sign) != len(motors):
            raise SurefootError(f"motors.sign has {len(self.motors.sign)} numbers; it must have {len(motors)}")
        for index, loop in enumerate(self.loops):
            check_names(f"loops[{index}].links", loop.links, [joint.child for joint in urdf.joints.values()])
        for leg in legs:
            where = f"legs.{leg.name}"
            check_names(f"{where}.motors", leg.motors, motors)
            check_names(f"{where}.knees", leg.knees, hinges)
            check_names(f"{where}.foot", (leg.foot,), urdf.links)
            allowed, knees = ((2,), 2) if self.leg_geometry else ((2, 3), 0)
            if len(leg.motors) not in allowed or len(leg.motors) != len(legs[0].motors) or len(leg.knees) != knees:
                rule = (
                    "2 motors and 2 knees, with leg_geometry"
                    if knees
                    else "2 or 3 motors, as many as the other legs, and no knees"
                )
                counts = f"{len(leg.motors)} motors and {len(leg.knees)} knees"
                raise SurefootError(f"{where} has {counts}; a leg must have {rule}")
            feet = [shape.kind for shape in urdf.links[leg.foot].collisions]
            if feet != ["sphere"]:
                raise SurefootError(
                    f"{where}.foot: link '{leg.foot}' has these collision shapes: {choices(feet) or 'none'}; "
                    "a foot must have exactly one, a sphere"
                )
        used = [name for leg in legs for name in leg.motors]
        if sorted(used) != sorted(motors):
            raise SurefootError(
                f"motors.order names {len(motors)} motors; each must belong to one leg; legs use {choices(used)}"
            )
        return legs

    def complete_leg_space(self, legs: Legs) -> tuple[dict[str, Range], tuple[float, ...]]:
        """Return the range of each coordinate and the resting pose, with defaults for serial legs."""
        names, table = legs.coordinates, self.leg_space
        if "abduction" not in names and table.abduction is not None:
            raise SurefootError("leg_space.abduction is given, but these legs have no abduction")
        if legs.units[-1] == "rad" and not (table.swing and table.extension and table.rest):
            raise SurefootError("leg_space has no swing, extension or rest; legs with leg_geometry need them")
        space = {name: getattr(table, name) or _DEFAULT_LEG_SPACE[name] for name in names}
        check_ranges("leg_space", space)
        rest = table.rest or (*[0.0] * (len(names) - 1), _DEFAULT_REST_EXTENSION)
        if len(rest) != len(names):
            raise SurefootError(f"leg_space.rest has {len(rest)} numbers; it must have {choices(names)}")
        return space, rest

    def complete_poses(self, space: Mapping[str, Range]) -> Poses:
        """Return the poses between gaits; by default robots sit with legs straight down, as short as allowed."""
        sit = [*[0.0] * (len(space) - 1), space["extension"][0]]
        poses = from_mapping(Poses, {"sit": sit, **self.poses}, "poses")
        if len(poses.sit) != len(space):
            raise SurefootError(f"poses.sit has {len(poses.sit)} numbers; it must have {choices(space)}")
        for (name, (low, high)), value in zip(space.items(), poses.sit, strict=True):
            if not low <= value <= high:
                raise SurefootError(f"poses.sit has {name} {value:g}; leg_space allows {low:g} to {high:g}")
        return poses

    def complete_battery(self, voltage: float) -> Battery:
        """Return the battery; by default cells of 3.7 V are low at 3.3 V and empty at 2.9 V."""
        nominal = _number_or_default(self.battery, "nominal", voltage)
        defaults = {"nominal": nominal, "warn": 0.9 * nominal, "low": 0.88 * nominal, "empty": 0.78 * nominal}
        return from_mapping(Battery, {**defaults, **self.battery}, "battery")

    def complete_contact(self, weight: float, length: float) -> ContactData:
        """Return the contact of the feet, with defaults from the weight per foot [N] and the leg length [m].

        By default a foot sinks in by 1 % of the leg length under its fraction of the weight, and the damping ratio of
        that mass on this spring is 0.5.
        """
        stiffness = _number_or_default(self.contact, "stiffness", weight / (_SINKAGE_RATIO * length))
        damping = math.sqrt(max(stiffness, 0.0) * weight / GRAVITY)
        defaults = {"stiffness": stiffness, "damping": damping, "self_collision": not self.loops}
        return from_mapping(ContactData, {**defaults, **self.contact}, "contact")


def check_names(key: str, names: Sequence[str], valid: Iterable[str]) -> None:
    """Reject names that the robot does not have, and duplicate names."""
    for name in names:
        if name not in valid:
            raise SurefootError(f"{key} names '{name}', which the robot does not have; {suggest(name, valid)}")
    if len(set(names)) != len(names):
        raise SurefootError(f"{key} is {quote(list(names))}; names must not repeat")


def check_ranges(where: str, ranges: Mapping[str, Range]) -> None:
    """Reject ranges whose bounds are in the wrong order."""
    for name, (low, high) in ranges.items():
        if not low <= high:
            raise SurefootError(f"{where}.{name} is [{low:g}, {high:g}]; the lower bound must come first")


def _number_or_default(table: Mapping[str, Any], key: str, default: float) -> float:
    """Return a number of a table, which is validated later, or the default if the key is missing."""
    return float(table[key]) if is_number(table.get(key)) else default
