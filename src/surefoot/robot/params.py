"""`PhysicalParams`: the physical parameters of robots, one row per robot."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError, suggest


class _Robot(Protocol):
    """The part of `RobotDescription` that parameters need."""

    @property
    def name(self) -> str: ...
    @property
    def num_motors(self) -> int: ...
    @property
    def motor_names(self) -> tuple[str, ...]: ...
    @property
    def actuator(self) -> Any: ...
    def nominal_params(self) -> dict[str, Any]: ...
    def check_allowed(self, name: str, values: Array) -> None: ...


GAINS = ("servo_kp", "servo_kd")
"""Gains of the servos."""
CONTROLLER_PARAMETERS = ("control_step", *GAINS)
"""Parameters that the policy defines instead of the robot: they are kept when the robot's other parameters are
replaced, unless the replacement names them."""
PARAMETER_GROUPS = ("body", "motors", "contact", "sensors")
"""Groups of parameters; latencies belong to the sensors."""


@dataclass(frozen=True)
class Parameter:
    """Declaration of a physical parameter."""

    group: str
    """One of `PARAMETER_GROUPS`."""
    label: str
    """Short display name, such as "latency of readings"."""
    unit: str
    """Unit; 1 for ratios. Two units, separated by ", ": for DC motors and for joint actuators."""
    meaning: str
    """Definition, for documentation."""
    bounds: tuple[float, float]
    """Default of the allowed range, which the data sheet's table [allowed] overrides."""
    per: str = ""
    """"motors" if each motor has a value; axis names such as "x, y, z" if each axis has one; empty for one number."""
    nominal: float = 0.0
    """Default nominal value, if the robot's description has none."""
    scalable: bool = True
    """Whether a range may be given as factors of the nominal value; false if that is 0 for most robots."""
    independent: bool = False
    """Whether randomization draws an independent value per motor or axis by default, instead of one for all."""
    actuator: str = ""
    """Actuator kind that has the parameter (it is 0 for the other kind); empty: all kinds."""
    engines: tuple[str, ...] = ()
    """Physics engines that model the parameter (it must be 0 in others); empty: all engines."""
    servo_only: bool = False
    """Whether constraint motors, which have no servo, ignore the parameter."""

    def belongs_to(self, robot: _Robot) -> bool:
        """Return whether the parameter applies to the robot's kind of actuator."""
        return self.actuator in ("", robot.actuator.kind)

    def unit_for(self, robot: _Robot) -> str:
        """Return the unit for the robot's kind of actuator; gains of DC motors and joint actuators differ in units."""
        dc, _, joint = self.unit.partition(", ")
        return joint if joint and robot.actuator.kind == "joint" else dc

    def element_names(self, motor_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the parameter's elements, which are motors or axes; empty for a scalar parameter."""
        return motor_names if self.per == "motors" else tuple(self.per.split(", ")) if self.per else ()


def _parameter(name: str, unit: str, meaning: str, bounds: tuple[float, float], per: str = "", **options: Any) -> Any:
    """Declare a parameter; `name` is "GROUP: LABEL". See `Parameter`."""
    group, _, label = name.partition(": ")
    return field(metadata={"parameter": Parameter(group, label, unit, meaning, bounds, per, **options)})


def _ratio(name: str, meaning: str, bounds: tuple[float, float] = (0.2, 5.0), per: str = "") -> Any:
    return _parameter(name, "1", meaning, bounds, per, nominal=1.0, independent=bool(per))


def _deviation(name: str, unit: str, meaning: str, bounds: tuple[float, float], per: str = "", **options: Any) -> Any:
    """Declare a parameter that is 0 for most robots, such as a bias."""
    return _parameter(name, unit, meaning, bounds, per, scalable=False, independent=bool(per), **options)


@dataclass(frozen=True)
class PhysicalParams:
    """Physical parameters of a batch of robots; each array's first axis is `num_envs`.

    Randomization draws them, identification fits them, a world applies them. Ratios multiply the value of the robot's
    description. Add new parameters at the end: random numbers are drawn in the order of this list.
    """

    base_mass_ratio: Array = _ratio(
        "body: body mass", "mass of the base with its fixed links, relative to the description"
    )
    leg_mass_ratio: Array = _ratio("body: leg mass", "mass of every moving link, relative to the description")
    motor_friction: Array = _parameter(
        "motors: Coulomb friction", "N m", "Coulomb friction in each motor", (0.0, 20.0), "motors"
    )
    base_inertia_ratio: Array = _ratio(
        "body: body inertia", "rotational inertia of the base, relative to the description"
    )
    leg_inertia_ratio: Array = _ratio(
        "body: leg inertia", "rotational inertia of every moving link, relative to the description"
    )
    motor_strength: Array = _ratio("motors: torque", "motor torque, relative to the motor model", (0.0, 2.0), "motors")
    control_step: Array = _parameter(
        "sensors: control step", "s", "time between two commands of the policy", (0.001, 0.05)
    )
    control_latency: Array = _parameter(
        "sensors: latency of readings", "s", "age of the readings that the policy observes", (0.0, 0.1)
    )
    voltage: Array = _parameter("motors: battery voltage", "V", "battery voltage", (5.0, 30.0), actuator="dc")
    contact_friction: Array = _parameter(
        "contact: friction coefficient", "1", "lateral friction coefficient of the feet", (0.05, 3.0)
    )
    imu_bias: Array = _deviation(
        "sensors: IMU bias", "rad", "constant error of roll and pitch", (-0.5, 0.5), "roll, pitch"
    )
    imu_noise: Array = _deviation(
        "sensors: IMU noise", "rad", "standard deviation of the white noise on roll and pitch", (0.0, 0.5)
    )
    torque_constant: Array = _parameter(
        "motors: torque constant",
        "N m/A",
        "torque constant K_t, also the back-EMF constant",
        (0.01, 1.0),
        actuator="dc",
    )
    resistance: Array = _parameter(
        "motors: armature resistance", "Ohm", "armature resistance R", (0.02, 5.0), actuator="dc"
    )
    servo_latency: Array = _parameter(
        "sensors: latency in the servos",
        "s",
        "age of the motor angles and speeds that the servo uses",
        (0.0, 0.02),
        servo_only=True,
    )
    contact_stiffness: Array = _parameter(
        "contact: stiffness of the feet", "N/m", "stiffness of the feet against the ground", (300.0, 100_000.0)
    )
    contact_spinning_friction: Array = _parameter(
        "contact: spinning friction",
        "m",
        "friction torque of a foot about the contact normal, relative to the normal force",
        (0.0, 0.5),
    )
    knee_friction: Array = _deviation(
        "motors: friction of the knees",
        "N m",
        "Coulomb friction in each knee joint; Bullet only",
        (0.0, 0.5),
        engines=("bullet",),
    )
    knee_play: Array = _deviation(
        "motors: play of the knees",
        "m",
        "radial clearance of the pins that close the loops; Bullet only",
        (0.0, 0.005),
        engines=("bullet",),
    )
    floor_unevenness: Array = _deviation(
        "contact: unevenness of the floor",
        "m",
        "standard deviation of the floor's height; Bullet only",
        (0.0, 0.02),
        engines=("bullet",),
    )
    imu_mount: Array = _deviation(
        "sensors: IMU mount",
        "rad",
        "roll, pitch and yaw of the IMU relative to the base",
        (-0.5, 0.5),
        "roll, pitch, yaw",
    )
    servo_kp: Array = _parameter(
        "motors: proportional gain",
        "1/rad, N m/rad",
        "proportional gain: duty of a DC motor's servo, torque of a joint actuator",
        (0.0, 2000.0),
        "motors",
    )
    servo_kd: Array = _parameter(
        "motors: derivative gain",
        "s/rad, N m s/rad",
        "derivative gain: duty of a DC motor's servo, torque of a joint actuator",
        (0.0, 100.0),
        "motors",
    )
    motor_viscous_friction: Array = _parameter(
        "motors: viscous friction", "N m s/rad", "viscous friction in each motor", (0.0, 10.0), "motors"
    )
    load_friction: Array = _parameter(
        "motors: friction over torque",
        "1",
        "friction of a joint actuator that is proportional to its torque, as a ratio",
        (0.0, 0.9),
        "motors",
        actuator="joint",
        servo_only=True,
    )
    speed_filter: Array = _parameter(
        "motors: filter on speeds",
        "s",
        "time constant of the first-order filter on a joint actuator's measured speed",
        (0.0, 0.1),
        actuator="joint",
        servo_only=True,
    )
    rotor_inertia: Array = _parameter(
        "motors: rotor inertia", "kg m2", "inertia of each rotor, at its joint", (0.0, 1.0), "motors", actuator="joint"
    )
    torque_limit: Array = _parameter(
        "motors: torque limit",
        "N m",
        "maximum torque of a joint actuator at low speed",
        (1e-6, 1e9),
        "motors",
        actuator="joint",
    )
    motor_offset: Array = _deviation(
        "sensors: offset of encoders",
        "rad",
        "angle that each encoder measures, minus the true angle",
        (-0.5, 0.5),
        "motors",
    )
    base_offset: Array = _deviation(
        "body: centre of mass", "m", "shift of the base's centre of mass from the description", (-0.1, 0.1), "x, y, z"
    )
    imu_yaw_drift: Array = _deviation(
        "sensors: drift of the yaw", "rad/s", "bias of the gyro about z, with which the IMU's yaw drifts", (-0.5, 0.5)
    )
    presliding: Array = _deviation(
        "motors: presliding angle",
        "rad",
        "angle over which a joint actuator's friction builds up after a reversal; 0: immediately",
        (0.0, 0.2),
        "motors",
        actuator="joint",
        servo_only=True,
    )
    contact_shear_ratio: Array = _ratio(
        "contact: shear stiffness", "tangential stiffness of the feet, relative to the normal stiffness", (0.01, 10.0)
    )
    torque_lag: Array = _deviation(
        "motors: lag of torques",
        "s",
        "time constant of the first-order lag between commanded and actual torque of a joint actuator",
        (0.0, 0.1),
        actuator="joint",
        servo_only=True,
    )
    voltage_clip: Array = _parameter(
        "motors: limit of the net voltage",
        "V",
        "maximum of terminal voltage minus back-EMF; over the resistance it is the controller's current limit",
        (0.5, 1000.0),
        actuator="dc",
        servo_only=True,
    )

    @property
    def num_envs(self) -> int:
        """Number of robots."""
        return len(self.base_mass_ratio)

    @classmethod
    def names(cls, robot: _Robot | None = None) -> list[str]:
        """Return the names of all parameters, or only of the parameters that apply to a robot's kind of actuator."""
        return [name for name, item in PARAMETERS.items() if robot is None or item.belongs_to(robot)]

    @classmethod
    def nominal(cls, robot: _Robot, num_envs: int = 1) -> PhysicalParams:
        """Return the nominal parameters of a robot's description for `num_envs` robots."""
        nominal, params = robot.nominal_params(), {}
        for name, declared in PARAMETERS.items():
            shape = (num_envs, len(declared.element_names(robot.motor_names))) if declared.per else (num_envs,)
            params[name] = np.broadcast_to(nominal[name], shape).astype(np.float64)
        return cls(**params)

    def with_values(self, robot: _Robot, **values: ArrayLike) -> PhysicalParams:
        """Return a copy with some parameters set.

        Args:
            robot: the robot that the parameters belong to.
            **values: values by parameter: a number for all; for a parameter with one value per motor or axis (N, M)
                also M values for every robot, N values for every motor if N differs from M, or all N rows of M; for
                other parameters (N,) also N values.

        Raises:
            SurefootError: no such parameter, or a value outside the range that the robot allows.
        """
        changed = {}
        for name, value in values.items():
            check_parameter(name, robot)
            now = getattr(self, name)
            array = np.asarray(value, dtype=np.float64)
            if array.ndim == 1 and now.ndim == 2 and len(array) == len(now) and len(array) != now.shape[1]:
                array = array[:, None]
            try:
                changed[name] = np.broadcast_to(array, now.shape).copy()
            except ValueError as error:
                raise SurefootError(f"{name} has shape {array.shape}; it must fit {now.shape}") from error
            robot.check_allowed(name, changed[name])
        return replace(self, **changed)

    def rows(self, index: ArrayLike) -> PhysicalParams:
        """Return the parameters of the robots at `index`."""
        return replace(self, **{name: getattr(self, name)[np.asarray(index)] for name in self.names()})

    def check(self, robot: _Robot) -> None:
        """Raise `SurefootError` if a value is outside the range that the robot allows."""
        for name in self.names(robot):
            robot.check_allowed(name, getattr(self, name))

    def set_rows(self, index: ArrayLike, params: PhysicalParams) -> None:
        """Replace the parameters of the robots at `index`, one row each."""
        for name in self.names():
            getattr(self, name)[index] = getattr(params, name)


PARAMETERS: dict[str, Parameter] = {item.name: item.metadata["parameter"] for item in fields(PhysicalParams)}
"""The declaration of every parameter, by name."""


def check_parameter(name: str, robot: _Robot | None = None) -> None:
    """Reject a name that is no physical parameter, or does not apply to a robot's kind of actuator."""
    if name not in PARAMETERS:
        raise SurefootError(f"'{name}' is not a physical parameter; {suggest(name, PARAMETERS)}")
    if robot is not None and not PARAMETERS[name].belongs_to(robot):
        kind = PARAMETERS[name].actuator
        raise SurefootError(
            f"{name} belongs to motors of kind {kind}; the motors of {robot.name} are {robot.actuator.kind}"
        )


def parse_settings(settings: list[str] | tuple[str, ...]) -> dict[str, float]:
    """Parse `name=value` arguments of a command line.

    Raises:
        SurefootError: an argument does not have this form, or names no physical parameter.
    """
    parsed = {}
    for setting in settings:
        name, _, text = setting.partition("=")
        check_parameter(name)
        try:
            parsed[name] = float(text)
        except ValueError:
            raise SurefootError(f"'{setting}' sets no number; write {name}=VALUE") from None
    return parsed
