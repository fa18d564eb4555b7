"""Data of motors as a sheet states them: DC motors with a servo, and torque-controlled joint actuators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import NotNegative, Positive, Within, from_mapping
from surefoot.errors import SurefootError, quote, suggest

_Each = Annotated[float | tuple[float, ...], Within(0, 1e9)]
"""One number for all motors, one for each motor of a leg, or one for each motor."""


MIN_PLACEHOLDER_TORQUE = 5.0
"""A torque limit over this many m g l is a placeholder: no motor lifts the robot by five legs' lengths."""
HEAT_LOSS = 0.5
"""Heat of a joint actuator at its full torque, over torque times the speed up to which it has it; assumed."""


@dataclass(frozen=True)
class DcMotorData:
    """Voltage-driven motor and servo, nominal. Units as in a sheet's `[actuator]`."""

    torque_constant: Positive
    resistance: Positive
    voltage: Positive
    voltage_clip: Positive
    kp: Annotated[float | tuple[float, ...], Within(0, 1e9, above=True)]
    kd: _Each
    torque_table_current: tuple[float, ...]
    torque_table_torque: tuple[float, ...]
    overheat_torque: Positive
    overheat_time: NotNegative
    friction: _Each = 0.0
    viscous_friction: _Each = 0.0

    kind: ClassVar[str] = "dc"
    own_parameters: ClassVar[tuple[str, ...]] = ("torque_constant", "resistance", "voltage")
    """Physical parameters that are called like their fields."""

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
class JointActuatorData:
    """Torque-controlled joint actuator with a PD controller of the joint's angle, nominal; all at the joint."""

    kp: Annotated[float | tuple[float, ...], Within(0, 1e9, above=True)]
    """N m/rad"""
    kd: _Each
    """N m s/rad"""
    torque_limit: _Each
    """Greatest torque [N m] at low speed."""
    speed_limit: _Each = 1e9
    """Speed [rad/s] at which a motor can drive no further; braking has the full torque."""
    full_torque_speed: _Each = 0.0
    """Speed [rad/s] up to which the full torque is there; from it to `speed_limit` the torque falls to 0."""
    rotor_inertia: _Each = 0.0
    """Inertia of rotor and gear [kg m2], at the joint: gear ratio squared times the rotor's."""
    friction: _Each = 0.0
    """Coulomb friction [N m]."""
    viscous_friction: _Each = 0.0
    """N m s/rad"""
    load_friction: _Each = 0.0
    """Friction over the actuator's torque."""
    presliding: _Each = 0.0
    """Angle [rad] over which friction builds up when a motor turns back: it sticks; 0: friction depends on the speed
    alone, and a motor at rest creeps."""
    speed_filter: NotNegative = 0.0
    """Time constant [s] of the first-order filter on the speed that the PD controller uses."""
    overheat_torque: _Each = 1e9
    """Torque [N m] that a motor may give for `overheat_time` only."""
    overheat_time: NotNegative = 1.0

    kind: ClassVar[str] = "joint"
    own_parameters: ClassVar[tuple[str, ...]] = (
        "speed_filter", "load_friction", "presliding", "rotor_inertia", "torque_limit"
    )  # fmt: skip
    """Physical parameters that are called like their fields."""


ActuatorData = DcMotorData | JointActuatorData


def nominal_params(data: ActuatorData) -> dict[str, Array]:
    """Return the nominal physical parameters of motors and servos by name: one number, or one for each motor."""
    names = {
        "servo_kp": "kp",
        "servo_kd": "kd",
        "motor_friction": "friction",
        "motor_viscous_friction": "viscous_friction",
    }
    names |= {name: name for name in data.own_parameters}
    return {name: np.asarray(getattr(data, key), float) for name, key in names.items()}


def read_actuator(table: Mapping[str, Any], order: Sequence[str], legs: Sequence[Sequence[str]]) -> ActuatorData:
    """Return the motors' data of a sheet's table.

    A list with one number for each motor of a leg holds for every leg; it becomes one with a number for each motor.

    Args:
        table: `[actuator]` of the sheet.
        order: names of all motors.
        legs: names of each leg's motors.
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
