"""Prior distributions of the parameters that logs can identify: how much robots deviate from their data sheets.

Gains that are sent with every command are not a property of the robot, and are unknown unless the log or the user
states them. The data sheet of a robot with fixed gains on its own board, or with better known parameters, narrows the
priors:

    [priors]
    servo_kp = 0.1          # relative standard deviation; 0: use the data sheet's value unless --fit names it
    motor_offset = 0.008    # standard deviation [rad]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from surefoot.errors import SurefootError, suggest
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.params import GAINS

DAMPING_RATIO = "damping_ratio"
"""Ratio of servo_kd to servo_kp [s], which determines how far a joint lags behind its command."""
CLOCK = "clock"
"""Scale of the log's clock: true seconds per second of the log."""
COMMAND_SHIFT = "command_shift"
"""Delay [s] between the logged and the true time of sending a command."""
RATIOS = {
    "friction_ratio": "motor_friction",
    "viscous_ratio": "motor_viscous_friction",
    "inertia_ratio": "rotor_inertia",
}
"""Ratios of a single motor to the value of its kind of joint, and the parameter that each multiplies."""
STRICTLY_POSITIVE = (
    "servo_kp",
    "leg_mass_ratio",
    "base_mass_ratio",
    "torque_limit",
    "contact_stiffness",
    "contact_friction",
)
"""Parameters that are never near 0."""
MAX_FACTOR = 8.0
"""Bounds of parameters with a relative prior: at most 8 times, and if strictly positive at least 1/8 of their scale."""


@dataclass(frozen=True)
class Prior:
    """Prior distribution of a parameter, and the step of its finite differences."""

    deviation: float
    """Standard deviation, absolute or relative to `prior_scale`."""
    relative: bool = True
    """Whether the standard deviation is relative."""
    individual: bool = False
    """Whether each motor or axis has its own value."""
    step: float = 0.02
    """Step of finite differences, in the unit of `deviation`."""
    start: float | None = None
    """Mean. Defaults to the parameter before the fit."""
    needs_contact: bool = False
    """Whether only a robot on the ground shows it."""
    by_default: bool = True
    """Whether it is identified by default; otherwise only if [priors] of the data sheet or the user names it."""


PRIORS = {
    "servo_kp": Prior(1.0),
    DAMPING_RATIO: Prior(0.5, by_default=False),
    "servo_kd": Prior(1.0),
    "motor_friction": Prior(1.0),
    "friction_ratio": Prior(0.3, individual=True, step=0.05),
    "load_friction": Prior(1.0, by_default=False),
    "presliding": Prior(1.0, by_default=False),
    "motor_viscous_friction": Prior(1.0, step=0.1),
    "viscous_ratio": Prior(0.3, individual=True, step=0.05),
    "speed_filter": Prior(1.0, by_default=False),
    "torque_lag": Prior(1.0, by_default=False),
    "rotor_inertia": Prior(0.7),
    "inertia_ratio": Prior(0.2, individual=True, step=0.05),
    "torque_limit": Prior(0.2, step=0.05, by_default=False),
    "control_latency": Prior(1.0),
    "motor_offset": Prior(0.03, relative=False, individual=True, step=0.004),
    "base_mass_ratio": Prior(0.01, needs_contact=True),
    "base_offset": Prior(0.005, relative=False, individual=True, step=0.002, needs_contact=True),
    "leg_mass_ratio": Prior(0.1),
    "contact_friction": Prior(0.3, needs_contact=True),
    "contact_stiffness": Prior(0.5, step=0.05, needs_contact=True),
    "contact_shear_ratio": Prior(0.7, step=0.05, start=0.2, needs_contact=True),
}
"""Parameters that logs can identify, with priors as wide as actuators differ. Published masses of a Go2's legs differ
by more than 10 %. Legs bend sideways, so the feet start out softer along the ground than normal to it."""
_DEFAULT_SCALES = {
    "motor_friction": 0.01,
    "motor_viscous_friction": 0.003,
    "rotor_inertia": 0.003,
}
"""Scale of motor parameters that are 0 in the data sheet, relative to m g l, m g l s, or m l^2."""
_ABSOLUTE_SCALES = {
    "control_latency": 0.005,
    "load_friction": 0.1,
    "speed_filter": 0.005,
    "torque_lag": 0.005,
    "presliding": 0.01,
}
"""Scale of other parameters that are 0 in the data sheet, in their units."""


def robot_priors(robot: RobotDescription) -> dict[str, Prior]:
    """Return the priors of a robot: `PRIORS`, with the standard deviations of its data sheet.

    Raises:
        SurefootError: the data sheet names an unknown parameter.
    """
    priors = dict(PRIORS)
    for name, deviation in robot.priors.items():
        if name not in priors:
            raise SurefootError(f"priors.{name} of {robot.name} is unknown; {suggest(name, priors)}")
        by_default = deviation > 0
        priors[name] = replace(priors[name], deviation=deviation or priors[name].deviation, by_default=by_default)
    return priors


def gains_are_commanded(robot: RobotDescription) -> bool:
    """Return whether a robot receives its gains with every command: its data sheet has no prior for them."""
    return not {*GAINS, DAMPING_RATIO} & set(robot.priors)


def default_names(robot: RobotDescription, rack: bool) -> tuple[str, ...]:
    """Return the parameters that logs identify by default; `rack`: whether the robot hangs in all logs."""
    priors = robot_priors(robot).items()
    return tuple(name for name, prior in priors if prior.by_default and not (rack and prior.needs_contact))


def drop_known(names: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return the names without known parameters and their ratios."""
    fixed = {*known, DAMPING_RATIO} if "servo_kd" in known else set(known)
    return [name for name in names if RATIOS.get(name, name) not in fixed]


def prior_scale(robot: RobotDescription, name: str, value: float) -> float:
    """Return the scale of a parameter: its value, or a typical value if it is 0 in the data sheet."""
    if value > 0:
        return value
    mass, length = robot.urdf.total_mass, robot.leg_geometry.length
    if name in _DEFAULT_SCALES:
        return _DEFAULT_SCALES[name] * mass * length * (length if name == "rotor_inertia" else GRAVITY)
    return _ABSOLUTE_SCALES.get(name, 1e-6)
