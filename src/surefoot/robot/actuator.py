"""Actuator data of a robot's data sheet: DC motors with a servo, and torque-controlled joint actuators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import NotNegative, Positive, Within, from_mapping
from surefoot.errors import SurefootError, quote, suggest

_Each = Annotated[float | tuple[float, ...], Within(0, 1e9)]
"""One number for all motors, one per motor of a leg, or one per motor."""


MIN_PLACEHOLDER_TORQUE = 5.0
"""Torque limit [m g l] from which it is a placeholder: no leg motor can hold the robot at five leg lengths."""
HEAT_LOSS = 0.5
"""Heating power of a joint actuator at its full torque, relative to the product of full torque and
`full_torque_speed`; assumed."""


@dataclass(frozen=True)
class DcMotorData:
    """Nominal data of a voltage-driven motor and its servo, in the units of the data sheet's table `[actuator]`."""

    torque_constant: Positive
    resistance: Positive
    voltage: Positive
    voltage_clip: Positive
    kp: Annotated[float | tuple[float, ...], Within(0, 1e9, exclusive=True)]
    kd: _Each
    torque_table_current: tuple[float, ...]
    torque_table_torque: tuple[float, ...]
    overheat_torque: Positive
    overheat_time: NotNegative
    friction: _Each = 0.0
    viscous_friction: _Each = 0.0

    kind: ClassVar[str] = "dc"
    own_parameters: ClassVar[tuple[str, ...]] = ("torque_constant", "resistance", "voltage", "voltage_clip")
    """Physical parameters with the same names as fields of this class."""

    def __post_init__(self) -> None:
        """Reject a torque-current curve that does not rise from 0."""
        current, torque = self.torque_table_current, self.torque_table_torque
        if len(current) < 2 or len(current) != len(torque):
            raise SurefootError(
                f"actuator.torque_table_current has {len(current)} points and torque_table_torque {len(torque)}; "
                "both need the same, 2 or more"
            )
        if current[0] != 0 or torque[0] != 0 or np.any(np.diff(current) <= 0) or np.any(np.diff(torque) < 0):
            raise SurefootError(
                f"actuator.torque_table_current is {list(current)}; it must start at 0 A and 0 N m, and increase"
            )


@dataclass(frozen=True)
class JointActuatorData:
    """Nominal data of a torque-controlled joint actuator with a PD position controller, all at the joint output."""

    kp: Annotated[float | tuple[float, ...], Within(0, 1e9, exclusive=True)]
    """Proportional gain [N m/rad]."""
    kd: _Each
    """Derivative gain [N m s/rad]."""
    torque_limit: _Each
    """Maximum torque [N m] at low speed."""
    speed_limit: _Each = 1e9
    """No-load speed [rad/s], at which the driving torque is 0; the braking torque is full at any speed."""
    full_torque_speed: _Each = 0.0
    """Speed [rad/s] up to which full torque is available; from there it falls linearly to 0 at `speed_limit`."""
    rotor_inertia: _Each = 0.0
    """Inertia of rotor and gear [kg m2] reflected to the joint: rotor inertia times gear ratio squared."""
    friction: _Each = 0.0
    """Coulomb friction [N m]."""
    viscous_friction: _Each = 0.0
    """Viscous friction [N m s/rad]."""
    load_friction: _Each = 0.0
    """Friction that is proportional to the actuator's torque, as a ratio to it."""
    presliding: _Each = 0.0
    """Presliding angle [rad] over which friction builds up after the motor reverses, so that it sticks. With 0,
    friction depends only on speed, and a motor at rest creeps."""
    speed_filter: NotNegative = 0.0
    """Time constant [s] of the first-order filter on the speed that the PD controller uses."""
    overheat_torque: _Each = 1e9
    """Torque [N m] that a motor may exceed for `overheat_time` [s] before it overheats."""
    overheat_time: NotNegative = 1.0

    kind: ClassVar[str] = "joint"
    own_parameters: ClassVar[tuple[str, ...]] = (
        "speed_filter", "load_friction", "presliding", "rotor_inertia", "torque_limit"
    )  # fmt: skip
    """Physical parameters with the same names as fields of this class."""


ActuatorData = DcMotorData | JointActuatorData


def nominal_params(data: ActuatorData) -> dict[str, Array]:
    """Return the nominal physical parameters of motors and servos by name: one number, or one per motor."""
    names = {
        "servo_kp": "kp",
        "servo_kd": "kd",
        "motor_friction": "friction",
        "motor_viscous_friction": "viscous_friction",
    }
    names |= {name: name for name in data.own_parameters}
    return {name: np.asarray(getattr(data, key), float) for name, key in names.items()}


def read_actuator(table: Mapping[str, Any], order: Sequence[str], legs: Sequence[Sequence[str]]) -> ActuatorData:
    """Parse the table `[actuator]` of a data sheet.

    A list with one number per motor of a leg applies to every leg; it is expanded to one number per motor.

    Args:
        table: table `[actuator]` of the data sheet.
        order: names of all motors.
        legs: motor names of each leg.

    Raises:
        SurefootError: an unknown kind or key, or a list of the wrong length.
    """
    kinds: dict[str, type[DcMotorData] | type[JointActuatorData]] = {"dc": DcMotorData, "joint": JointActuatorData}
    kind = table.get("kind", "dc")
    if kind not in list(kinds):  # it may be unhashable
        raise SurefootError(f"actuator.kind is {quote(kind)}; {suggest(kind, kinds)}")
    data = from_mapping(kinds[kind], {key: value for key, value in table.items() if key != "kind"}, "actuator")
    place = {name: k for leg in legs for k, name in enumerate(leg)}
    changed: dict[str, Any] = {}
    for name, value in vars(data).items():
        if isinstance(value, tuple) and not name.startswith("torque_table") and len(value) != len(order):
            if len(value) != len(legs[0]):
                raise SurefootError(
                    f"actuator.{name} has {len(value)} numbers; it takes one, {len(legs[0])} for the motors of "
                    f"each leg, or {len(order)} in the motor order"
                )
            changed[name] = tuple(value[place[motor]] for motor in order)
    return replace(data, **changed)
