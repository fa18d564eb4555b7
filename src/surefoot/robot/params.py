"""`PhysicalParams`: everything that may differ from the data sheet, one row per robot."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices


class _Described(Protocol):
    """What parameters ask of a robot's description."""

    @property
    def name(self) -> str: ...
    @property
    def num_motors(self) -> int: ...
    @property
    def actuator(self) -> Any: ...
    def nominal_params(self) -> dict[str, Any]: ...
    def check_allowed(self, name: str, values: Array) -> None: ...


def _row(unit: str, meaning: str, bounds: tuple[float, float], width: str = "one", actuator: str = "") -> Any:
    """Declare a parameter.

    `bounds` hold where a robot's sheet does not say what is allowed. With `actuator`, only robots with motors of that
    kind have it; for others it is 0.
    """
    return field(metadata={"unit": unit, "meaning": meaning, "width": width, "bounds": bounds, "actuator": actuator})


@dataclass(frozen=True)
class PhysicalParams:
    """Physical parameters of a batch of robots; each array's first axis is `num_envs`.

    Randomization draws them, identification fits them, a world applies them. Ratios multiply the
    description's value.
    """

    base_mass_ratio: Array = _row("1", "mass of the base with its fixed links, over the description's", (0.2, 5.0))
    leg_mass_ratio: Array = _row("1", "mass of every moving link, over the description's", (0.2, 5.0))
    base_inertia_ratio: Array = _row("1", "rotational inertia of the base, over the description's", (0.2, 5.0))
    leg_inertia_ratio: Array = _row("1", "rotational inertia of every moving link, over the description's", (0.2, 5.0))
    motor_strength: Array = _row("1", "motor torque, over the motor model's", (0.0, 2.0), "motors")
    motor_friction: Array = _row("N m", "Coulomb friction in each motor", (0.0, 20.0), "motors")
    motor_viscous_friction: Array = _row("N m s/rad", "viscous friction in each motor", (0.0, 10.0), "motors")
    torque_constant: Array = _row(
        "N m/A", "torque constant K_t, also the back-EMF constant", (0.01, 1.0), actuator="dc"
    )
    resistance: Array = _row("Ohm", "armature resistance R", (0.02, 5.0), actuator="dc")
    voltage: Array = _row("V", "battery voltage", (5.0, 30.0), actuator="dc")
    servo_kp: Array = _row(
        "1/rad, N m/rad",
        "proportional gain: duty of a DC motor's servo, torque of a joint actuator",
        (0.0, 2000.0),
        "motors",
    )
    servo_kd: Array = _row(
        "s/rad, N m s/rad",
        "derivative gain: duty of a DC motor's servo, torque of a joint actuator",
        (0.0, 100.0),
        "motors",
    )
    servo_latency: Array = _row("s", "age of the motor angles and speeds that the servo uses", (0.0, 0.020))
    control_latency: Array = _row("s", "age of the readings that the policy observes", (0.0, 0.100))
    control_step: Array = _row("s", "time between two commands of the policy", (0.001, 0.050))
    contact_friction: Array = _row("1", "lateral friction coefficient of the feet", (0.05, 3.0))
    contact_stiffness: Array = _row("N/m", "stiffness of the feet against the ground", (300.0, 100_000.0))
    contact_spinning_friction: Array = _row(
        "m", "friction torque of a foot about the contact normal, over the normal force", (0.0, 0.5)
    )
    knee_friction: Array = _row("N m", "Coulomb friction in each knee joint; Bullet only", (0.0, 0.5))
    knee_play: Array = _row("m", "radial clearance of the pins that close the loops; Bullet only", (0.0, 0.005))
    floor_unevenness: Array = _row("m", "standard deviation of the floor's height; Bullet only", (0.0, 0.02))
    imu_bias: Array = _row("rad", "constant error of roll and pitch", (-0.5, 0.5), "roll, pitch")
    imu_noise: Array = _row("rad", "standard deviation of the white noise on roll and pitch", (0.0, 0.5))
    imu_mount: Array = _row("rad", "roll, pitch and yaw of the IMU against the base", (-0.5, 0.5), "roll, pitch, yaw")
    load_friction: Array = _row("1", "friction of a joint actuator over its torque", (0.0, 0.9), "motors", "joint")
    speed_filter: Array = _row(
        "s",
        "time constant of the first-order filter on the speed that a joint actuator uses",
        (0.0, 0.1),
        actuator="joint",
    )
    rotor_inertia: Array = _row("kg m2", "inertia of each rotor, at its joint", (0.0, 1.0), "motors", "joint")
    torque_limit: Array = _row(
        "N m", "greatest torque of a joint actuator at low speed", (1e-6, 1e9), "motors", "joint"
    )
    presliding: Array = _row(
        "rad",
        "angle over which a joint actuator's friction builds up; 0: it depends on the speed alone",
        (0.0, 0.2),
        "motors",
        "joint",
    )
    motor_offset: Array = _row("rad", "angle that each motor's encoder tells, less the true one", (-0.5, 0.5), "motors")
    contact_shear_ratio: Array = _row("1", "stiffness of the feet along the ground, over that against it", (0.01, 10.0))
    base_offset: Array = _row("m", "centre of mass of the base, less the description's", (-0.1, 0.1), "x, y, z")
    imu_yaw_drift: Array = _row("rad/s", "bias of the gyro about z, with which the IMU's yaw drifts", (-0.5, 0.5))

    @property
    def num_envs(self) -> int:
        """Number of robots."""
        return len(self.base_mass_ratio)

    @classmethod
    def names(cls) -> list[str]:
        """Return the names of all parameters."""
        return [item.name for item in fields(cls)]

    @classmethod
    def unit(cls, name: str) -> str:
        """Return the unit of a parameter; 1 for ratios."""
        return str(cls.__dataclass_fields__[name].metadata["unit"])

    @classmethod
    def actuator_kind(cls, name: str) -> str:
        """Return the kind of motors that have a parameter; empty if all have it."""
        return str(cls.__dataclass_fields__[name].metadata["actuator"])

    @classmethod
    def nominal(cls, robot: _Described, num_envs: int = 1) -> PhysicalParams:
        """Return the parameters that the robot's description states, for `num_envs` robots."""
        nominal = robot.nominal_params()
        widths = {
            "one": (),
            "motors": (robot.num_motors,),
            "roll, pitch": (2,),
            "roll, pitch, yaw": (3,),
            "x, y, z": (3,),
        }
        shapes = {item.name: (num_envs, *widths[item.metadata["width"]]) for item in fields(cls)}
        return cls(**{name: np.broadcast_to(nominal[name], shape).astype(np.float64) for name, shape in shapes.items()})

    def with_values(self, robot: _Described, **values: ArrayLike) -> PhysicalParams:
        """Return a copy with some parameters set, each given for all robots or one row per robot.

        Raises:
            SurefootError: no such parameter, or a value outside what the robot's description allows.
        """
        changed = {}
        for name, value in values.items():
            if name not in self.names():
                raise SurefootError(f"'{name}' is not a physical parameter; choices: {choices(self.names())}")
            if (kind := self.actuator_kind(name)) not in ("", robot.actuator.kind):
                raise SurefootError(
                    f"{name} belongs to motors of kind {kind}; the motors of {robot.name} are {robot.actuator.kind}"
                )
            now = getattr(self, name)
            given = np.asarray(value, dtype=np.float64)
            if given.ndim == 1 and now.ndim == 2 and len(given) == len(now) and len(given) != now.shape[1]:
                given = given[:, None]
            try:
                changed[name] = np.broadcast_to(given, now.shape).copy()
            except ValueError as error:
                raise SurefootError(f"{name} has shape {given.shape}; it must fit {now.shape}") from error
            robot.check_allowed(name, changed[name])
        return replace(self, **changed)

    def rows(self, index: ArrayLike) -> PhysicalParams:
        """Return the parameters of some of the robots, by index."""
        return replace(self, **{name: getattr(self, name)[np.asarray(index)] for name in self.names()})

    def check(self, robot: _Described) -> None:
        """Raise `SurefootError` for a value outside what the robot's description allows."""
        for name in self.names():
            if self.actuator_kind(name) in ("", robot.actuator.kind):
                robot.check_allowed(name, getattr(self, name))

    def set_rows(self, index: ArrayLike, params: PhysicalParams) -> None:
        """Take other parameters for the robots at `index`, one row each."""
        for name in self.names():
            getattr(self, name)[index] = getattr(params, name)


def parse_settings(settings: list[str] | tuple[str, ...]) -> dict[str, float]:
    """Read `name=value` words as given on a command line.

    Raises:
        SurefootError: a word is not of that form, or names no physical parameter.
    """
    parsed = {}
    for setting in settings:
        name, _, text = setting.partition("=")
        if name not in PhysicalParams.names():
            raise SurefootError(f"'{name}' is not a physical parameter; choices: {choices(PhysicalParams.names())}")
        try:
            parsed[name] = float(text)
        except ValueError:
            raise SurefootError(f"'{setting}' sets no number; write {name}=VALUE") from None
    return parsed
