"""A robot's description: its URDF and its data sheet, read and checked once.

A robot is a folder with a `robot.toml` and the URDF that it names. `RobotDescription.load` takes the name of
a robot that ships with surefoot or the path of such a folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.configuration import read_toml
from surefoot.errors import SurefootError, check_name, choices
from surefoot.robot.leg import FiveBar, leg_to_motor, motor_to_leg
from surefoot.robot.params import PhysicalParams
from surefoot.robot.sheet import Sheet
from surefoot.robot.urdf import Urdf, read_urdf

_HERE = Path(__file__).parent

GRAVITY = 9.81
"""Acceleration of free fall [m/s2]."""


@dataclass(frozen=True)
class Leg:
    """One leg: names of its motor joints (theta_1, theta_2), knee joints and foot link."""

    name: str
    motors: tuple[str, str]
    knees: tuple[str, str]
    foot: str


@dataclass(frozen=True)
class Loop:
    """A pin joint between two links: its place [m] in each link's frame."""

    links: tuple[str, str]
    points: tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class ActuatorData:
    """Motor and servo, nominal. Units as in `robot.toml`."""

    torque_constant: float
    resistance: float
    voltage: float
    voltage_clip: float
    kp: float
    kd: float
    friction: float
    torque_table_current: tuple[float, ...]
    torque_table_torque: tuple[float, ...]
    overheat_torque: float
    overheat_time: float
    viscous_friction: float = 0.0


@dataclass(frozen=True)
class Timing:
    """Servo step, control step and both latencies [s], nominal."""

    servo_step: float
    control_step: float
    servo_latency: float
    control_latency: float


@dataclass(frozen=True)
class ContactData:
    """Foot against ground: friction coefficient, spinning friction [m], stiffness [N/m] and damping [N s/m]."""

    friction: float
    spinning_friction: float
    stiffness: float
    damping: float


@dataclass(frozen=True)
class RobotDescription:
    """What a machine is. Angles are motor angles theta in the sheet's motor order unless said otherwise."""

    name: str
    folder: Path
    urdf: Urdf
    base: str
    body_length: float
    motor_names: tuple[str, ...]
    motor_sign: NDArray[np.float64]
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
        """Names of the robots that ship with surefoot."""
        return sorted(path.parent.name for path in _HERE.glob("*/robot.toml"))

    @classmethod
    def load(cls, robot: str | Path) -> RobotDescription:
        """Load a robot by name or by the path of its folder.

        Raises:
            SurefootError: no such robot, or a description that does not fit: says file, key and rule.
        """
        folder = _HERE / str(robot) if str(robot) in cls.available() else Path(robot)
        sheet_path = folder / "robot.toml"
        if not sheet_path.is_file():
            raise SurefootError(
                f"robot '{robot}': no such robot and no folder with a robot.toml; robots: {choices(cls.available())}"
            )
        try:
            data, _ = read_toml(sheet_path)
        except OSError as error:
            raise SurefootError(f"{sheet_path}: can't be read: {error.strerror}") from error
        description = cls._from_sheet(Sheet(sheet_path, data), folder)
        description._check_legs(sheet_path)
        return description

    @classmethod
    def _from_sheet(cls, sheet: Sheet, folder: Path) -> RobotDescription:
        sheet.allow_only(
            *("name", "urdf", "base", "body_length", "motors", "legs", "leg_geometry", "loops"),
            *("leg_space", "actuator", "timing", "contact", "allowed"),
        )
        check_name(f"{sheet.path}: name", sheet.text("name"))
        urdf = read_urdf(folder / sheet.text("urdf"))
        links, joints = list(urdf.links), list(urdf.joints)
        base = sheet.one_of("base", links)

        motors = sheet.table("motors", "order", "sign")
        turning = [name for name in joints if urdf.joints[name].kind != "fixed"]
        order = motors.names("order", turning)
        sign = np.array(motors.numbers("sign", len(order)))
        if not np.all(np.abs(sign) == 1):
            raise motors.error("sign", f"is {motors.data['sign']}", "each must be 1 or -1")

        legs_table = sheet.table("legs")
        leg_names = legs_table.strings("order")
        legs_table.allow_only("order", *leg_names)
        legs = []
        for leg_name in leg_names:
            leg = legs_table.table(leg_name, "motors", "knees", "foot")
            pair, knees = leg.names("motors", order, 2), leg.names("knees", turning, 2)
            legs.append(Leg(leg_name, (pair[0], pair[1]), (knees[0], knees[1]), leg.one_of("foot", links)))
        used = [name for leg in legs for name in leg.motors]
        if sorted(used) != sorted(order):
            raise motors.error(
                "order",
                f"names {len(order)} motors",
                f"each must belong to one leg; legs use {choices(used)}",
            )

        geometry = sheet.table("leg_geometry", "upper", "lower", "foot", "foot_radius")
        lower = geometry.numbers("lower", 2)
        try:
            bars = FiveBar(
                geometry.number("upper"),
                (lower[0], lower[1]),
                geometry.number("foot"),
                geometry.number("foot_radius"),
            )
        except SurefootError as error:
            raise SurefootError(f"{sheet.path}: {error}") from None

        loops = []
        for index, loop in enumerate(sheet.tables("loops", "links", "points")):
            ends = loop.names("links", links, 2)
            loops.append(Loop((ends[0], ends[1]), loop.two_points("points", index)))

        space = sheet.table("leg_space", "swing", "extension", "rest")
        rest = space.numbers("rest", 2)
        body_length = sheet.number("body_length")
        if not body_length > 0:
            raise sheet.error("body_length", f"is {body_length:g}", "it must be over 0 m")
        allowed, defaults = sheet.table("allowed"), PhysicalParams.default_bounds()
        allowed.allow_only(*PhysicalParams.names(), optional=tuple(defaults))
        return cls(
            name=sheet.text("name"),
            folder=folder,
            urdf=urdf,
            base=base,
            body_length=body_length,
            motor_names=tuple(order),
            motor_sign=sign,
            legs=tuple(legs),
            leg_geometry=bars,
            loops=tuple(loops),
            swing_range=space.range("swing"),
            extension_range=space.range("extension"),
            rest=(rest[0], rest[1]),
            actuator=_read_actuator(sheet),
            timing=sheet.table("timing").dataclass(Timing, positive=("servo_step", "control_step")),
            contact=sheet.table("contact").dataclass(ContactData, positive=("friction", "stiffness", "damping")),
            allowed={
                name: allowed.range(name) if name in allowed.data else defaults[name] for name in PhysicalParams.names()
            },
        )

    def _check_legs(self, sheet_path: Path) -> None:
        for loop in self.loops:
            for link in loop.links:
                if not any(joint.child == link for joint in self.urdf.joints.values()):
                    raise SurefootError(f"{sheet_path}: loops: '{link}' hangs on no joint, so no loop can close there")
        if not self.leg_geometry.closes(*leg_to_motor(*self.rest)):
            raise SurefootError(
                f"{sheet_path}: leg_geometry: a loop can't close at the resting pose "
                f"(swing {self.rest[0]:g}, extension {self.rest[1]:g}); the lower links must reach each other"
            )
        extension = np.linspace(*self.extension_range, 201)
        if not self.leg_geometry.closes(*leg_to_motor(0.0, extension)).all():
            raise SurefootError(
                f"{sheet_path}: leg_space.extension is {list(self.extension_range)}, "
                "and a loop can't close everywhere in it; narrow it or check leg_geometry"
            )
        for name, value in self.nominal_params().items():
            self.check_allowed(name, np.asarray(value), source=f"{sheet_path}: nominal ")

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
    def leg_mounts(self) -> NDArray[np.float64]:
        """Place (legs, 3) of each leg's motors from the base's origin, between both [m]; x forward, y left, z up.

        Parts fixed to the base are taken to be mounted without turning, as a Minitaur's rails are.
        """
        above = {joint.child: joint for joint in self.urdf.joints.values()}

        def place(name: str) -> NDArray[np.float64]:
            joint, total = self.urdf.joints[name], np.zeros(3)
            while True:
                total += joint.origin
                if joint.parent == self.base or joint.parent not in above:
                    return total
                joint = above[joint.parent]

        return np.array([np.mean([place(name) for name in leg.motors], axis=0) for leg in self.legs])

    @property
    def torque_table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points of the torque-current curve: currents [A] and torques [N m]."""
        return np.array(self.actuator.torque_table_current), np.array(self.actuator.torque_table_torque)

    def leg_to_motor_angles(self, swing: ArrayLike, extension: ArrayLike) -> NDArray[np.float64]:
        """Motor angles (..., motors) [rad] for swing and extension (..., legs) [rad]."""
        theta_1, theta_2 = leg_to_motor(swing, extension)
        index = self.leg_motor_index
        angles = np.empty((*theta_1.shape[:-1], self.num_motors))
        angles[..., index[:, 0]] = theta_1
        angles[..., index[:, 1]] = theta_2
        return angles

    def motor_to_leg_pose(self, angles: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Swing and extension (..., legs) [rad] for motor angles (..., motors) [rad]."""
        theta, index = np.asarray(angles, float), self.leg_motor_index
        return motor_to_leg(theta[..., index[:, 0]], theta[..., index[:, 1]])

    @property
    def resting_angles(self) -> NDArray[np.float64]:
        """Motor angles (motors,) [rad] of the resting pose."""
        legs = len(self.legs)
        return self.leg_to_motor_angles(np.full(legs, self.rest[0]), np.full(legs, self.rest[1]))

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
        """Nominal value of every physical parameter, by name."""
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

    def check_allowed(self, name: str, values: NDArray[np.float64], source: str = "") -> None:
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


def _read_actuator(sheet: Sheet) -> ActuatorData:
    table = sheet.table("actuator")
    data: ActuatorData = table.dataclass(
        ActuatorData, positive=("torque_constant", "resistance", "voltage", "voltage_clip", "overheat_torque")
    )
    current, torque = data.torque_table_current, data.torque_table_torque
    if len(current) < 2 or len(current) != len(torque):
        raise table.error(
            "torque_table_current",
            f"has {len(current)} points and torque_table_torque {len(torque)}",
            "both need the same, 2 or more",
        )
    if current[0] != 0 or torque[0] != 0 or np.any(np.diff(current) <= 0) or np.any(np.diff(torque) < 0):
        raise table.error("torque_table_current", f"is {list(current)}", "it must start at 0 A and 0 N m, and rise")
    return data
