"""A robot's description: its URDF and its data sheet, read and checked once.

A robot is a folder with a `robot.toml` and the URDF that it names. `RobotDescription.load` takes the name of
a robot that ships with surefoot or the path of such a folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.configuration import Within, from_mapping, read_toml
from surefoot.errors import SurefootError, check_name, choices, located, quoted
from surefoot.robot.leg import FiveBar, leg_to_motor, motor_to_leg
from surefoot.robot.params import PhysicalParams
from surefoot.robot.urdf import Urdf, read_urdf

_HERE = Path(__file__).parent

GRAVITY = 9.81
"""Acceleration of free fall [m/s2]."""


_Positive = Annotated[float, Within(0, 1e9, above=True)]
_NotNegative = Annotated[float, Within(0, 1e9)]
Range = tuple[float, float]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Leg:
    """One leg: names of its motor joints (theta_1, theta_2), knee joints and foot link."""

    motors: tuple[str, str]
    knees: tuple[str, str]
    foot: str
    name: str = ""
    """In the sheet it is the name of the leg's table."""


@dataclass(frozen=True)
class Loop:
    """A pin joint between two links: its place [m] in each link's frame."""

    links: tuple[str, str]
    points: tuple[Point, Point]


@dataclass(frozen=True)
class ActuatorData:
    """Motor and servo, nominal. Units as in `robot.toml`."""

    torque_constant: _Positive
    resistance: _Positive
    voltage: _Positive
    voltage_clip: _Positive
    kp: _NotNegative
    kd: _NotNegative
    friction: _NotNegative
    torque_table_current: tuple[float, ...]
    torque_table_torque: tuple[float, ...]
    overheat_torque: _Positive
    overheat_time: _NotNegative
    viscous_friction: _NotNegative = 0.0

    def __post_init__(self) -> None:
        """Refuse a torque-current curve that does not rise from 0."""
        current, torque = self.torque_table_current, self.torque_table_torque
        if len(current) < 2 or len(current) != len(torque):
            raise SurefootError(
                f"actuator.torque_table_current has {len(current)} points and torque_table_torque {len(torque)}; "
                "both need the same, 2 or more"
            )
        if current[0] != 0 or torque[0] != 0 or np.any(np.diff(current) <= 0) or np.any(np.diff(torque) < 0):
            raise SurefootError(
                f"actuator.torque_table_current is {list(current)}; it must start at 0 A and 0 N m, and rise"
            )


@dataclass(frozen=True)
class Timing:
    """Servo step, control step and both latencies [s], nominal."""

    servo_step: _Positive
    control_step: _Positive
    servo_latency: _NotNegative
    control_latency: _NotNegative


@dataclass(frozen=True)
class ContactData:
    """Foot against ground: friction coefficient, spinning friction [m], stiffness [N/m] and damping [N s/m]."""

    friction: _Positive
    spinning_friction: _NotNegative
    stiffness: _Positive
    damping: _Positive


@dataclass(frozen=True)
class _Motors:
    """Motor joints in order, and the sign of each: joint angle = sign * motor angle."""

    order: tuple[str, ...]
    sign: tuple[Literal[-1, 1], ...]


@dataclass(frozen=True)
class _LegSpace:
    """What a command may ask of a leg, and where it rests [rad]."""

    swing: Range
    extension: Range
    rest: Range


@dataclass(frozen=True)
class _Sheet:
    """A `robot.toml` as it stands; `legs` has the legs' `order` and a table for each."""

    name: str
    urdf: str
    base: str
    body_length: _Positive
    motors: _Motors
    legs: dict[str, Any]
    leg_geometry: FiveBar
    loops: tuple[Loop, ...]
    leg_space: _LegSpace
    actuator: ActuatorData
    timing: Timing
    contact: ContactData
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
    leg_geometry: FiveBar
    loops: tuple[Loop, ...]
    swing_range: tuple[float, float]
    extension_range: tuple[float, float]
    rest: tuple[float, float]
    actuator: ActuatorData
    timing: Timing
    contact: ContactData
    allowed: dict[str, tuple[float, float]]

    @classmethod
    def available(cls) -> list[str]:
        """Return the names of the robots that ship with surefoot."""
        return sorted(path.parent.name for path in _HERE.glob("*/robot.toml"))

    @classmethod
    def load(cls, robot: str | Path) -> RobotDescription:
        """Load a robot by name or by the path of its folder.

        Raises:
            SurefootError: no such robot, or an invalid description: states file, key and rule.
        """
        folder = _HERE / str(robot) if str(robot) in cls.available() else Path(robot)
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
        order, sign = sheet.motors.order, sheet.motors.sign
        _check_names("base", (sheet.base,), links)
        _check_names("motors.order", order, turning)
        if len(sign) != len(order):
            raise SurefootError(f"motors.sign has {len(sign)} numbers; it must have {len(order)}")
        tables = dict(sheet.legs)
        names = tables.pop("order", None)
        if not isinstance(names, list) or sorted(map(str, names)) != sorted(tables):
            raise SurefootError(f"legs.order is {quoted(names)}; it must name each leg once: {choices(tables)}")
        legs = tuple(replace(from_mapping(Leg, tables[name], f"legs.{name}"), name=name) for name in names)
        for leg in legs:
            _check_names(f"legs.{leg.name}.motors", leg.motors, order)
            _check_names(f"legs.{leg.name}.knees", leg.knees, turning)
            _check_names(f"legs.{leg.name}.foot", (leg.foot,), links)
        used = [name for leg in legs for name in leg.motors]
        if sorted(used) != sorted(order):
            raise SurefootError(
                f"motors.order names {len(order)} motors; each must belong to one leg; legs use {choices(used)}"
            )
        hanging = [joint.child for joint in urdf.joints.values()]
        for index, loop in enumerate(sheet.loops):
            _check_names(f"loops[{index}].links", loop.links, hanging)
        for name in sheet.allowed:
            if name not in PhysicalParams.names():
                raise SurefootError(f"allowed.{name} is unknown; choices: {choices(PhysicalParams.names())}")
        space = sheet.leg_space
        ranges = {"leg_space.swing": space.swing, "leg_space.extension": space.extension}
        ranges |= {f"allowed.{name}": bounds for name, bounds in sheet.allowed.items()}
        for key, (low, high) in ranges.items():
            if not low <= high:
                raise SurefootError(f"{key} is [{low:g}, {high:g}]; the lower bound must come first")
        as_stated = ("name", "base", "body_length", "leg_geometry", "loops", "actuator", "timing", "contact")
        description = cls(
            **{name: getattr(sheet, name) for name in as_stated},
            folder=folder,
            urdf=urdf,
            motor_names=order,
            motor_sign=np.array(sign, float),
            legs=legs,
            swing_range=space.swing,
            extension_range=space.extension,
            rest=space.rest,
            allowed={**{item.name: item.metadata["bounds"] for item in fields(PhysicalParams)}, **sheet.allowed},
        )
        description._check_legs()
        return description

    def _check_legs(self) -> None:
        if not self.leg_geometry.closes(*leg_to_motor(*self.rest)):
            raise SurefootError(
                "leg_geometry: a loop can't close at the resting pose "
                f"(swing {self.rest[0]:g}, extension {self.rest[1]:g}); the lower links must reach each other"
            )
        extension = np.linspace(*self.extension_range, 201)
        if not self.leg_geometry.closes(*leg_to_motor(0.0, extension)).all():
            raise SurefootError(
                f"leg_space.extension is {list(self.extension_range)}, "
                "and a loop can't close everywhere in it; narrow it or check leg_geometry"
            )
        for name, value in self.nominal_params().items():
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
        """Index (legs, 2) of each leg's theta_1 and theta_2 in the motor order."""
        return np.array([[self.motor_names.index(name) for name in leg.motors] for leg in self.legs])

    @property
    def leg_mounts(self) -> Array:
        """Place (legs, 3) of each leg's motors from the base's origin, between both [m]; x forward, y left, z up.

        Parts fixed to the base are taken to be mounted without turning, as a Minitaur's rails are.
        """
        above = {joint.child: joint for joint in self.urdf.joints.values()}

        def place(name: str) -> Array:
            joint, total = self.urdf.joints[name], np.zeros(3)
            while True:
                total += joint.origin
                if joint.parent == self.base or joint.parent not in above:
                    return total
                joint = above[joint.parent]

        return np.array([np.mean([place(name) for name in leg.motors], axis=0) for leg in self.legs])

    @property
    def torque_table(self) -> tuple[Array, Array]:
        """Points of the torque-current curve: currents [A] and torques [N m]."""
        return np.array(self.actuator.torque_table_current), np.array(self.actuator.torque_table_torque)

    def leg_to_motor_angles(self, swing: ArrayLike, extension: ArrayLike) -> Array:
        """Return the motor angles (..., motors) [rad] for swing and extension (..., legs) or () [rad]."""
        theta_1, theta_2 = leg_to_motor(swing, extension)
        index = self.leg_motor_index
        angles = np.empty((*theta_1.shape[:-1], self.num_motors))
        angles[..., index[:, 0]] = theta_1
        angles[..., index[:, 1]] = theta_2
        return angles

    def motor_to_leg_pose(self, angles: ArrayLike) -> tuple[Array, Array]:
        """Return the swing and extension (..., legs) [rad] for motor angles (..., motors) [rad]."""
        theta, index = np.asarray(angles, float), self.leg_motor_index
        return motor_to_leg(theta[..., index[:, 0]], theta[..., index[:, 1]])

    @property
    def resting_angles(self) -> Array:
        """Motor angles (motors,) [rad] of the resting pose."""
        return self.leg_to_motor_angles(*self.rest)

    @property
    def resting_joint_angles(self) -> dict[str, float]:
        """Angles [rad] of motor and knee joints in the resting pose, as the URDF has them, by name; loops closed."""
        angles = self.resting_angles
        joints = dict(zip(self.motor_names, (self.motor_sign * angles).tolist(), strict=True))
        for leg in self.legs:
            theta = [angles[self.motor_names.index(name)] for name in leg.motors]
            joints |= zip(leg.knees, map(float, self.leg_geometry.knee_angles(*theta)), strict=True)
        return joints

    def nominal_params(self) -> dict[str, float]:
        """Return the nominal value of every physical parameter, by name."""
        data, timing = self.actuator, self.timing
        return {
            **dict.fromkeys(("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio"), 1.0),
            "motor_strength": 1.0,
            "motor_friction": data.friction,
            "motor_viscous_friction": data.viscous_friction,
            "torque_constant": data.torque_constant,
            "resistance": data.resistance,
            "voltage": data.voltage,
            "servo_kp": data.kp,
            "servo_kd": data.kd,
            "servo_latency": timing.servo_latency,
            "control_latency": timing.control_latency,
            "control_step": timing.control_step,
            "contact_friction": self.contact.friction,
            "contact_stiffness": self.contact.stiffness,
            "contact_spinning_friction": self.contact.spinning_friction,
            **dict.fromkeys(("knee_friction", "knee_play", "floor_unevenness"), 0.0),
            **dict.fromkeys(("imu_bias", "imu_noise", "imu_mount"), 0.0),
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


def _check_names(key: str, given: Sequence[str], valid: Sequence[str]) -> None:
    """Refuse names that the robot does not have, and names that stand twice."""
    for name in given:
        if name not in valid:
            raise SurefootError(f"{key} names '{name}', which the robot does not have; choices: {choices(valid)}")
    if len(set(given)) != len(given):
        raise SurefootError(f"{key} is {quoted(list(given))}; names must not repeat")
