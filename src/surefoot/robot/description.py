"""A robot's description: its URDF and its data sheet, read and checked once.

A robot is a folder with a `robot.toml` and the URDF that it names. `RobotDescription.load` takes the name of
a robot that ships with surefoot or the path of such a folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.configuration import Within, from_mapping, read_toml
from surefoot.errors import SurefootError, check_name, choices, located, quoted
from surefoot.robot.actuator import ActuatorData, DcMotorData, JointActuatorData, per_motor
from surefoot.robot.experiments import Experiments, read_experiments
from surefoot.robot.leg import FiveBar, Legs
from surefoot.robot.params import PhysicalParams
from surefoot.robot.serial_leg import SerialLegs
from surefoot.robot.urdf import Urdf
from surefoot.robot.urdf_file import read_urdf

_HERE = Path(__file__).parent

DEFAULT_ROBOT = "minitaur"
"""The robot of tasks that name none: the paper's."""
GRAVITY = 9.81
"""Acceleration of free fall [m/s2]."""


_Positive = Annotated[float, Within(0, 1e9, above=True)]
_NotNegative = Annotated[float, Within(0, 1e9)]
_Voltage = Annotated[float, Within(1, 1e3)]
Range = tuple[float, float]
Point = tuple[float, float, float]

_ALONG = 1e-6
"""How far a leg's axes may be from the base's axes, as cosines."""
_REST = 0.75
"""Extension of a serial leg at rest, in lengths of the straight leg, where the sheet does not say."""
_EXTENSION = (0.35, 0.97)
"""Extension that a command may ask of a serial leg, where the sheet does not say; 1 is straight."""
_SWING = 1.0
_ABDUCTION = 0.5
"""Swing and abduction that a command may ask of a serial leg to either side [rad], where the sheet does not say."""
_VOLTAGE = 24.0
"""Nominal battery voltage [V] of joint actuators, where the sheet does not say."""
_SINK = 0.01
"""How far a foot sinks in under its share of the weight, in leg lengths, where the sheet gives no stiffness."""


@dataclass(frozen=True)
class Leg:
    """One leg: names of its motor joints, of joints without a motor, and of its foot's link.

    Motors of a five-bar leg are theta_1 and theta_2, those of a serial leg (abduction,) hip and knee.
    """

    motors: tuple[str, ...]
    foot: str
    knees: tuple[str, ...] = ()
    knee: Literal["forward", "backward"] = "backward"
    """Where the knee of a serial leg points."""
    name: str = ""
    """In the sheet it is the name of the leg's table."""


@dataclass(frozen=True)
class Loop:
    """A pin joint between two links: its place [m] in each link's frame."""

    links: tuple[str, str]
    points: tuple[Point, Point]


@dataclass(frozen=True)
class Timing:
    """Servo step, control step and both latencies [s], nominal."""

    servo_step: _Positive = 0.001
    control_step: _Positive = 0.010
    servo_latency: _NotNegative = 0.002
    control_latency: _NotNegative = 0.010


@dataclass(frozen=True)
class ContactData:
    """Foot against ground: friction coefficient, spinning friction [m], stiffness [N/m] and damping [N s/m].

    Also whether legs collide with each other and with the base: if not given, serial legs do.
    """

    stiffness: _Positive
    damping: _Positive
    friction: _Positive = 0.8
    spinning_friction: _NotNegative = 0.004
    self_collision: bool = False


@dataclass(frozen=True)
class Poses:
    """Poses between gaits, in leg space, of all legs alike."""

    sit: tuple[float, ...]
    """How the robot sits: low enough to fall from unharmed when its motors are let go."""
    spread: float | None = None
    """Swing [rad] of legs that lie beside the body, about as far as they slide when motors are let go; None: legs
    do not slide out from under the body."""


@dataclass(frozen=True)
class Battery:
    """Voltages of the battery [V]."""

    nominal: _Voltage
    """Nominal voltage."""
    warn: _Voltage
    """Voltage under load below which a deployment warns."""
    low: _Voltage
    """Voltage under load below which a robot sits down."""
    empty: _Voltage
    """Voltage below which a robot damps itself."""


@dataclass(frozen=True)
class _Motors:
    """Motor joints in order, and the sign of each: joint angle = sign * motor angle."""

    order: tuple[str, ...]
    sign: tuple[Literal[-1, 1], ...] = ()


@dataclass(frozen=True)
class _LegSpace:
    """What a command may ask of a leg, and where it rests; angles in rad."""

    abduction: Range | None = None
    swing: Range | None = None
    extension: Range | None = None
    rest: tuple[float, ...] | None = None


@dataclass(frozen=True)
class _Sheet:
    """A `robot.toml` as it stands; `legs` has the legs' `order` and a table for each."""

    name: str
    urdf: str
    base: str
    motors: _Motors
    legs: dict[str, Any]
    actuator: dict[str, Any]
    body_length: Annotated[float | None, Within(0, 1e9, above=True)] = None
    leg_geometry: FiveBar | None = None
    loops: tuple[Loop, ...] = ()
    leg_space: _LegSpace = field(default_factory=_LegSpace)
    timing: Timing = field(default_factory=Timing)
    contact: dict[str, Any] = field(default_factory=dict)
    poses: dict[str, Any] = field(default_factory=dict)
    battery: dict[str, Any] = field(default_factory=dict)
    experiments: dict[str, Any] = field(default_factory=dict)
    allowed: dict[str, Range] = field(default_factory=dict)


@dataclass(frozen=True)
class RobotDescription:
    """A robot. Angles are motor angles theta in the sheet's motor order unless stated otherwise."""

    name: str
    folder: Path
    urdf: Urdf
    base: str
    body_length: float
    motor_names: tuple[str, ...]
    motor_sign: Array
    legs: tuple[Leg, ...]
    leg_mounts: Array
    """Place (L, 3) of each leg's hip from the base's origin [m], x forward, y left, z up: between both motors of a
    five-bar leg, on the axis of abduction of a serial leg."""
    leg_geometry: Legs
    loops: tuple[Loop, ...]
    leg_space: dict[str, Range]
    """Least and greatest value of each coordinate of leg space that a command may ask of a leg, in order."""
    rest: tuple[float, ...]
    """Pose in leg space of every leg in which the robot settles before an episode."""
    actuator: ActuatorData
    timing: Timing
    contact: ContactData
    poses: Poses
    battery: Battery
    experiments: Experiments
    allowed: dict[str, tuple[float, float]]

    @classmethod
    def available(cls) -> list[str]:
        """Return the names of the robots that ship with surefoot."""
        return sorted(path.parent.name for path in _HERE.glob("*/robot.toml"))

    @classmethod
    def folder_of(cls, robot: str | Path) -> Path:
        """Return the folder of a robot that ships, by name, or the path that is given."""
        return _HERE / str(robot) if str(robot) in cls.available() else Path(robot)

    @classmethod
    def load(cls, robot: str | Path) -> RobotDescription:
        """Load a robot by name or by the path of its folder.

        Raises:
            SurefootError: no such robot, or an invalid description: states file, key and rule.
        """
        folder = cls.folder_of(robot)
        sheet_path = folder / "robot.toml"
        if not sheet_path.is_file():
            raise SurefootError(
                f"robot '{robot}': no such robot and no folder with a robot.toml; robots: {choices(cls.available())}"
            )
        data, _ = read_toml(sheet_path)
        with located(sheet_path):
            sheet = from_mapping(_Sheet, data)
            check_name("name", sheet.name)
        urdf = read_urdf(folder / sheet.urdf)
        with located(sheet_path):
            return cls._from_sheet(sheet, urdf, folder)

    @classmethod
    def _from_sheet(cls, sheet: _Sheet, urdf: Urdf, folder: Path) -> RobotDescription:
        links, turning = list(urdf.links), [name for name, joint in urdf.joints.items() if joint.kind != "fixed"]
        order = sheet.motors.order
        sign = sheet.motors.sign or (1,) * len(order)
        _check_names("base", (sheet.base,), links)
        _check_names("motors.order", order, turning)
        if len(sign) != len(order):
            raise SurefootError(f"motors.sign has {len(sign)} numbers; it must have {len(order)}")
        legs = _legs(sheet, urdf)
        hanging = [joint.child for joint in urdf.joints.values()]
        for index, loop in enumerate(sheet.loops):
            _check_names(f"loops[{index}].links", loop.links, hanging)
        for name in sheet.allowed:
            if name not in PhysicalParams.names():
                raise SurefootError(f"allowed.{name} is unknown; choices: {choices(PhysicalParams.names())}")
        motor_sign = np.array(sign, float)
        geometry = sheet.leg_geometry or _serial_legs(sheet.base, legs, order, motor_sign, urdf)
        space, rest = _leg_space(sheet.leg_space, geometry)
        for key, (low, high) in {
            **{f"leg_space.{name}": bounds for name, bounds in space.items()},
            **{f"allowed.{name}": bounds for name, bounds in sheet.allowed.items()},
        }.items():
            if not low <= high:
                raise SurefootError(f"{key} is [{low:g}, {high:g}]; the lower bound must come first")
        mounts = _mounts(sheet.base, legs, urdf)
        weight = GRAVITY * urdf.total_mass / len(legs)
        actuator = _actuator(sheet.actuator, order, legs)
        description = cls(
            name=sheet.name,
            base=sheet.base,
            body_length=sheet.body_length or float(np.ptp(mounts[:, 0])) or geometry.length,
            leg_geometry=geometry,
            loops=sheet.loops,
            actuator=actuator,
            timing=sheet.timing,
            contact=_contact({"self_collision": not sheet.loops} | sheet.contact, weight, geometry.length),
            poses=_poses(sheet.poses, space),
            battery=_battery(sheet.battery, float(sheet.actuator.get("voltage", _VOLTAGE))),
            experiments=read_experiments(sheet.experiments, space["extension"], actuator),
            folder=folder,
            urdf=urdf,
            motor_names=order,
            motor_sign=motor_sign,
            legs=legs,
            leg_mounts=mounts,
            leg_space=space,
            rest=rest,
            allowed={**{item.name: item.metadata["bounds"] for item in fields(PhysicalParams)}, **sheet.allowed},
        )
        description._check_legs()
        return description

    def _check_legs(self) -> None:
        legs, (*sides, extensions) = self.leg_geometry, self.leg_space.values()
        if not legs.closes(self._of_legs(self.resting_angles)).all():
            pose = ", ".join(f"{name} {value:g}" for name, value in zip(self.leg_space, self.rest, strict=True))
            raise SurefootError(
                f"leg_geometry: a leg can't have its resting pose ({pose}); "
                "the lower links of a loop must reach each other, a serial leg must be long enough"
            )
        middle = [0.0] * len(sides)
        for extension in np.linspace(*extensions, 201):
            if not legs.closes(self._of_legs(self.pose_angles(*middle, extension))).all():
                raise SurefootError(
                    f"leg_space.extension is {list(extensions)}, "
                    "and a leg can't have every extension in it; narrow it or check leg_geometry"
                )
        for name, value in self.nominal_params().items():
            if PhysicalParams.actuator_kind(name) in ("", self.actuator.kind):
                self.check_allowed(name, np.asarray(value), source="nominal ")

    @property
    def num_motors(self) -> int:
        """Number of motors."""
        return len(self.motor_names)

    @property
    def leg_names(self) -> tuple[str, ...]:
        """Names of the legs, in order."""
        return tuple(leg.name for leg in self.legs)

    @property
    def leg_motor_index(self) -> NDArray[np.int64]:
        """Index (legs, m) of each leg's motors in the motor order."""
        return np.array([[self.motor_names.index(name) for name in leg.motors] for leg in self.legs])

    @property
    def weight(self) -> float:
        """Weight of the whole robot [N]."""
        return GRAVITY * self.urdf.total_mass

    @property
    def torque_table(self) -> tuple[Array, Array]:
        """Points of a DC motor's torque-current curve: currents [A] and torques [N m]."""
        return np.array(self.dc_motor.torque_table_current), np.array(self.dc_motor.torque_table_torque)

    @property
    def dc_motor(self) -> DcMotorData:
        """The data of DC motors.

        Raises:
            SurefootError: the robot has other motors.
        """
        if not isinstance(self.actuator, DcMotorData):
            raise SurefootError(f"the motors of {self.name} are of kind {self.actuator.kind}; this takes DC motors")
        return self.actuator

    @property
    def five_bar(self) -> FiveBar:
        """The geometry of five-bar legs.

        Raises:
            SurefootError: the robot has other legs.
        """
        if not isinstance(self.leg_geometry, FiveBar):
            raise SurefootError(f"the legs of {self.name} are serial; this takes five-bar legs")
        return self.leg_geometry

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates of leg space: (abduction,) swing, extension."""
        return tuple(self.leg_space)

    def _of_legs(self, angles: Array) -> Array:
        """Return the angles (..., L, m) of each leg's motors for those of all motors (..., M)."""
        return angles[..., self.leg_motor_index]

    def to_motors(self, pose: ArrayLike) -> Array:
        """Return the motor angles (..., M) [rad] of poses in leg space (..., C, L)."""
        theta, index = self.leg_geometry.to_motors(pose), self.leg_motor_index
        angles = np.empty((*theta.shape[:-2], self.num_motors))
        angles[..., index] = theta
        return angles

    def to_pose(self, angles: ArrayLike) -> Array:
        """Return the poses in leg space (..., C, L) for motor angles (..., M) [rad]."""
        return self.leg_geometry.to_pose(self._of_legs(np.asarray(angles, float)))

    def pose_angles(self, *coordinates: ArrayLike) -> Array:
        """Return the motor angles (..., M) [rad] for each coordinate's values (..., L), or one number for all legs."""
        if len(coordinates) != len(self.coordinates):
            raise SurefootError(
                f"a pose has {len(coordinates)} numbers; legs of {self.name} have {choices(self.coordinates)}"
            )
        *values, _ = np.broadcast_arrays(*coordinates, np.zeros(len(self.legs)))
        return self.to_motors(np.stack(values, axis=-2))

    def angle_extent(self, *ranges: Range) -> tuple[Array, Array]:
        """Return the least and greatest motor angles (M,) [rad] over all poses in a range of each coordinate.

        Angles rise or fall with each coordinate but the extension, which is sampled.
        """
        *sides, (low, high) = ranges
        angles = [self.pose_angles(*pose) for pose in product(*sides, np.linspace(low, high, 17))]
        return np.min(angles, axis=0), np.max(angles, axis=0)

    @property
    def resting_angles(self) -> Array:
        """Motor angles (motors,) [rad] of the resting pose."""
        return self.pose_angles(*self.rest)

    @property
    def resting_joint_angles(self) -> dict[str, float]:
        """Angles [rad] of motor and knee joints in the resting pose, as the URDF has them, by name; loops closed."""
        return {name: float(values) for name, values in self.joint_angles(self.resting_angles).items()}

    def joint_angles(self, angles: ArrayLike) -> dict[str, Array]:
        """Return the angles (...) [rad] of motor and knee joints by name, as the URDF has them, for motors (..., M).

        NaN at the knees of a leg whose loop can't close.
        """
        theta = np.asarray(angles, float)
        joints = {name: self.motor_sign[k] * theta[..., k] for k, name in enumerate(self.motor_names)}
        knees = self.leg_geometry.knee_angles(self._of_legs(theta))
        for number, leg in enumerate(self.legs):
            joints |= {name: knees[..., number, k] for k, name in enumerate(leg.knees)}
        return joints

    def link_frames(self, angles: ArrayLike) -> dict[str, Array]:
        """Return the frames (..., 4, 4) of all links in the base's by name, loops closed, for motors (..., M) [rad].

        NaN below the knees of a leg whose loop can't close.
        """
        frames = self.urdf.frames(self.joint_angles(angles))
        in_base = np.linalg.inv(frames[self.base])
        return {link: in_base @ frame for link, frame in frames.items()}

    def nominal_params(self) -> dict[str, Any]:
        """Return the nominal value of every physical parameter, by name: a number, or one for each motor."""
        timing = self.timing
        return {
            **dict.fromkeys(PhysicalParams.names(), 0.0),
            **dict.fromkeys(("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio"), 1.0),
            "motor_strength": 1.0,
            "contact_shear_ratio": 1.0,
            **self.actuator.nominal_params(),
            "servo_latency": timing.servo_latency,
            "control_latency": timing.control_latency,
            "control_step": timing.control_step,
            "contact_friction": self.contact.friction,
            "contact_stiffness": self.contact.stiffness,
            "contact_spinning_friction": self.contact.spinning_friction,
        }

    def check_allowed(self, name: str, values: Array, source: str = "") -> None:
        """Refuse values of a physical parameter outside what the sheet allows.

        Raises:
            SurefootError: with the value, the parameter and the bounds.
        """
        low, high = self.allowed[name]
        bad = np.asarray(values)[~((values >= low) & (values <= high))]
        if bad.size:
            unit = PhysicalParams.unit(name)
            raise SurefootError(
                f"{source}{name} is {bad.flat[0]:g}; {self.name} allows {low:g} to {high:g} (unit: {unit})"
            )


def _legs(sheet: _Sheet, urdf: Urdf) -> tuple[Leg, ...]:
    """Return the legs of a sheet, in order; refuse names that the URDF does not have, and legs that differ in kind."""
    links, turning = list(urdf.links), [name for name, joint in urdf.joints.items() if joint.kind != "fixed"]
    order, tables = sheet.motors.order, dict(sheet.legs)
    names = tables.pop("order", None)
    if not isinstance(names, list) or sorted(map(str, names)) != sorted(tables):
        raise SurefootError(f"legs.order is {quoted(names)}; it must name each leg once: {choices(tables)}")
    legs = tuple(replace(from_mapping(Leg, tables[name], f"legs.{name}"), name=name) for name in names)
    if not legs:
        raise SurefootError("legs.order is empty; a robot has legs")
    counts = (2,) if sheet.leg_geometry else (2, 3)
    for leg in legs:
        _check_names(f"legs.{leg.name}.motors", leg.motors, order)
        _check_names(f"legs.{leg.name}.knees", leg.knees, turning)
        _check_names(f"legs.{leg.name}.foot", (leg.foot,), links)
        if len(leg.motors) not in counts or len(leg.motors) != len(legs[0].motors):
            rule = "two motors and two knees" if sheet.leg_geometry else "2 or 3 motors, as many as the other legs"
            raise SurefootError(f"legs.{leg.name}.motors has {len(leg.motors)} names; a leg has {rule}")
        if len(leg.knees) != (2 if sheet.leg_geometry else 0):
            rule = "two, with leg_geometry" if sheet.leg_geometry else "none: joints without a motor need leg_geometry"
            raise SurefootError(f"legs.{leg.name}.knees has {len(leg.knees)} names; a leg has {rule}")
        feet = [shape.kind for shape in urdf.links[leg.foot].collisions]
        if feet != ["sphere"]:
            raise SurefootError(
                f"legs.{leg.name}.foot: link '{leg.foot}' has as collision shapes: {choices(feet) or 'none'}; "
                "a foot has one, a sphere"
            )
    used = [name for leg in legs for name in leg.motors]
    if sorted(used) != sorted(order):
        raise SurefootError(
            f"motors.order names {len(order)} motors; each must belong to one leg; legs use {choices(used)}"
        )
    return legs


def _mounts(base: str, legs: Sequence[Leg], urdf: Urdf) -> Array:
    """Return where legs are mounted (L, 3) [m]; see `RobotDescription.leg_mounts`."""
    frames = urdf.frames()
    inverse = np.linalg.inv(frames[base])

    def place(joint: str) -> Array:
        return (inverse @ frames[urdf.joints[joint].child])[:3, 3]

    found = []
    for leg in legs:
        places = np.array([place(name) for name in leg.motors])
        if leg.knees:
            found.append(places.mean(axis=0))
        elif len(leg.motors) == 3:
            found.append(np.array([places[1, 0], *places[0, 1:]]))
        else:
            foot = (inverse @ frames[leg.foot])[:3, 3]
            found.append(np.array([places[0, 0], foot[1], places[0, 2]]))
    return np.array(found)


def _serial_legs(base: str, legs: Sequence[Leg], order: Sequence[str], sign: Array, urdf: Urdf) -> SerialLegs:
    """Return the kinematics of serial legs, from the places of their joints at zero.

    Raises:
        SurefootError: axes that are not along the base's x (abduction) and y (hip, knee), or a link without length.
    """
    frames = urdf.frames()
    inverse = np.linalg.inv(frames[base])
    rows: dict[str, list[Any]] = {name: [] for name in SerialLegs.__dataclass_fields__}
    for leg in legs:
        along = (0, 1, 1)[-len(leg.motors) :]
        turn, places = [], []
        for motor, wanted in zip(leg.motors, along, strict=True):
            joint = urdf.joints[motor]
            frame = inverse @ frames[joint.child]
            turned = frame[:3, :3] @ joint.axis
            if abs(abs(turned[wanted]) - 1.0) > _ALONG:
                rule = f"axis at zero is ({turned[0]:.3g}, {turned[1]:.3g}, {turned[2]:.3g}) in the base frame"
                raise SurefootError(f"legs.{leg.name}: {motor}: its {rule}; it must be along {'xy'[wanted]}")
            turn.append(float(np.sign(turned[wanted]) * sign[list(order).index(motor)]))
            places.append(frame[:3, 3])
        *first, hip, knee = places
        foot = (inverse @ frames[leg.foot])[:3, 3]
        upper, lower = (knee - hip)[[0, 2]], (foot - knee)[[0, 2]]
        for name, link in (("hip to knee", upper), ("knee to foot", lower)):
            if not np.linalg.norm(link) > 1e-3:
                raise SurefootError(f"legs.{leg.name}: {name} is {np.linalg.norm(link):.3g} m long; a leg has links")
        pivot = first[0] if first else np.array([0.0, foot[1], hip[2]])
        rows["turn"].append(turn)
        rows["side"].append(1.0 if foot[1] >= 0 else -1.0)
        rows["hip"].append([foot[1] - pivot[1], hip[2] - pivot[2]])
        for name, link in (("upper", upper), ("lower", lower)):
            rows[name].append(np.linalg.norm(link))
            rows[f"{name}_angle"].append(np.arctan2(-link[0], -link[1]))
        rows["knee"].append(1.0 if leg.knee == "forward" else -1.0)
    return SerialLegs(**{name: np.array(values, float) for name, values in rows.items()})


def _leg_space(given: _LegSpace, legs: Legs) -> tuple[dict[str, Range], tuple[float, ...]]:
    """Return the range of each coordinate and the resting pose: the sheet's, or usual ones for serial legs."""
    usual = {"abduction": (-_ABDUCTION, _ABDUCTION), "swing": (-_SWING, _SWING), "extension": _EXTENSION}
    names = legs.coordinates
    if "abduction" not in names and given.abduction is not None:
        raise SurefootError("leg_space.abduction is given; these legs have no abduction")
    space = {name: getattr(given, name) or usual[name] for name in names}
    rest = given.rest or (*[0.0] * (len(names) - 1), _REST)
    if legs.units[-1] == "rad" and not (given.swing and given.extension and given.rest):
        raise SurefootError("leg_space has no swing, extension or rest; legs with leg_geometry need them")
    if len(rest) != len(names):
        raise SurefootError(f"leg_space.rest has {len(rest)} numbers; it must have {choices(names)}")
    return space, rest


def _poses(table: dict[str, Any], space: dict[str, Range]) -> Poses:
    """Return the poses between gaits; robots sit with legs straight down, as short as commands allow."""
    poses = from_mapping(Poses, {"sit": [*[0.0] * (len(space) - 1), space["extension"][0]]} | table, "poses")
    if len(poses.sit) != len(space):
        raise SurefootError(f"poses.sit has {len(poses.sit)} numbers; it must have {choices(space)}")
    for (name, (low, high)), value in zip(space.items(), poses.sit, strict=True):
        if not low <= value <= high:
            raise SurefootError(f"poses.sit has {name} {value:g}; leg_space allows {low:g} to {high:g}")
    return poses


def _battery(table: dict[str, Any], voltage: float) -> Battery:
    """Return the battery's voltages: cells of 3.7 V are low at 3.3 V and empty at 2.9 V."""
    given = from_mapping(Battery, {item.name: voltage for item in fields(Battery)} | table, "battery")
    usual = {"warn": 0.9 * given.nominal, "low": 0.88 * given.nominal, "empty": 0.78 * given.nominal}
    battery = replace(given, **{key: value for key, value in usual.items() if key not in table})
    if not battery.empty <= battery.low <= battery.warn:
        raise SurefootError(
            f"battery: empty is {battery.empty:g} V, low {battery.low:g} V, warn {battery.warn:g} V; they must rise"
        )
    return battery


def _actuator(table: dict[str, Any], order: Sequence[str], legs: Sequence[Leg]) -> ActuatorData:
    """Return the motors' data; a list with one number for each motor of a leg holds for every leg."""
    data = dict(table)
    kind = data.pop("kind", "dc")
    kinds: dict[str, type[DcMotorData] | type[JointActuatorData]] = {"dc": DcMotorData, "joint": JointActuatorData}
    if kind not in kinds:
        raise SurefootError(f"actuator.kind is {quoted(kind)}; choices: {choices(kinds)}")
    return per_motor(from_mapping(kinds[kind], data, "actuator"), order, [leg.motors for leg in legs])


def _contact(table: dict[str, Any], weight: float, length: float) -> ContactData:
    """Return the feet's contact; stiffness and damping from a foot's share of the weight [N] and the leg's length [m].

    A foot sinks in by 1 % of the leg's length under its share, and its damping is that of a quarter of the robot on
    this spring at a damping ratio of .5.
    """
    given = from_mapping(ContactData, {"stiffness": weight / (_SINK * length), "damping": 1.0} | table, "contact")
    usual = float(np.sqrt(given.stiffness * weight / GRAVITY))
    return given if "damping" in table else replace(given, damping=usual)


def _check_names(key: str, given: Sequence[str], valid: Sequence[str]) -> None:
    """Refuse names that the robot does not have, and names that stand twice."""
    for name in given:
        if name not in valid:
            raise SurefootError(f"{key} names '{name}', which the robot does not have; choices: {choices(valid)}")
    if len(set(given)) != len(given):
        raise SurefootError(f"{key} is {quoted(list(given))}; names must not repeat")
