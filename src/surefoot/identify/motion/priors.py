"""Prior distributions of what logs can identify: how far robots differ from their sheet before anybody looks at a log.

Gains that come with every command are no property of a robot: nothing is known of them unless the log or the user says
so. A robot whose gains are fixed on its own board, or that is known better, says so in its sheet:

    [priors]
    servo_kp = 0.1          # standard deviation, relative; 0: as on the sheet, unless --fit names it
    motor_offset = 0.008    # rad
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from surefoot.errors import SurefootError, suggest
from surefoot.robot import GRAVITY, RobotDescription

DAMPING_RATIO = "damping_ratio"
"""servo_kd over servo_kp [s], which determines how far a joint lags behind its command."""
CLOCK = "clock"
"""Seconds that a second of the log's clock takes."""
COMMAND_SHIFT = "command_shift"
"""Time [s] by which commands were sent later than their log says."""
RATIOS = {
    "friction_ratio": "motor_friction",
    "viscous_ratio": "motor_viscous_friction",
    "inertia_ratio": "rotor_inertia",
}
"""Ratio of one motor to its kind of joint, and the parameter that it multiplies."""
GAINS = ("servo_kp", "servo_kd")
STRICTLY_POSITIVE = (
    "servo_kp",
    "leg_mass_ratio",
    "base_mass_ratio",
    "torque_limit",
    "contact_stiffness",
    "contact_friction",
)
"""Numbers that are never near 0."""
MAX_FACTOR = 8.0
"""Bound of numbers with a relative prior, as a factor of their scale."""


@dataclass(frozen=True)
class Prior:
    """Prior distribution of a number, and the step of its finite differences."""

    deviation: float
    """Standard deviation; relative to the sheet's value, or to what is usual where that is 0, if `relative`."""
    relative: bool = True
    each: bool = False
    """Whether each motor or axis has its own value."""
    step: float = 0.02
    """Of finite differences, in the unit of `deviation`."""
    start: float | None = None
    """Mean; the parameter before the fit, if not given."""
    contact: bool = False
    """Whether only a robot on the ground shows it."""
    usual: bool = True
    """Whether it is identified by default; else only where a sheet's [priors] or the user names it."""


PRIORS = {
    "servo_kp": Prior(1.0),
    DAMPING_RATIO: Prior(0.5, usual=False),
    "servo_kd": Prior(1.0),
    "motor_friction": Prior(1.0),
    "friction_ratio": Prior(0.3, each=True, step=0.05),
    "load_friction": Prior(1.0, usual=False),
    "presliding": Prior(1.0, usual=False),
    "motor_viscous_friction": Prior(1.0, step=0.1),
    "viscous_ratio": Prior(0.3, each=True, step=0.05),
    "speed_filter": Prior(1.0, usual=False),
    "torque_lag": Prior(1.0, usual=False),
    "rotor_inertia": Prior(0.7),
    "inertia_ratio": Prior(0.2, each=True, step=0.05),
    "torque_limit": Prior(0.2, step=0.05, usual=False),
    "control_latency": Prior(1.0),
    "motor_offset": Prior(0.03, relative=False, each=True, step=0.004),
    "base_mass_ratio": Prior(0.01, contact=True),
    "base_offset": Prior(0.005, relative=False, each=True, step=0.002, contact=True),
    "leg_mass_ratio": Prior(0.1),
    "contact_friction": Prior(0.3, contact=True),
    "contact_stiffness": Prior(0.5, step=0.05, contact=True),
    "contact_shear_ratio": Prior(0.7, step=0.05, start=0.2, contact=True),
}
"""Numbers that logs can identify, with priors as wide as drives differ. Published masses of a Go2's legs differ by more
than 10 %. Legs bend sideways: feet start softer along the ground."""
_DEFAULT_SCALES = {
    "motor_friction": 0.01,
    "motor_viscous_friction": 0.003,
    "rotor_inertia": 0.003,
}
"""Scale of motors' parameters that a sheet has as 0, relative to m g l, m g l s, or m l^2."""
_ABSOLUTE_SCALES = {"load_friction": 0.1, "speed_filter": 0.005, "torque_lag": 0.005, "presliding": 0.01}
"""The same of others, in their units."""


def robot_priors(robot: RobotDescription) -> dict[str, Prior]:
    """Return the priors of a robot: `PRIORS`, with the deviations of its sheet.

    Raises:
        SurefootError: a sheet with another name.
    """
    priors = dict(PRIORS)
    for name, deviation in robot.priors.items():
        if name not in priors:
            raise SurefootError(f"priors.{name} of {robot.name} is unknown; {suggest(name, priors)}")
        usual = deviation > 0
        priors[name] = replace(priors[name], deviation=deviation or priors[name].deviation, usual=usual)
    return priors


def gains_are_commanded(robot: RobotDescription) -> bool:
    """Return whether a robot gets its gains with every command: its sheet does not say how well they are known."""
    return not {*GAINS, DAMPING_RATIO} & set(robot.priors)


def default_names(robot: RobotDescription, rack: bool) -> tuple[str, ...]:
    """Return what logs of a robot identify by default; `rack`: none of them is of a robot on the ground."""
    return tuple(name for name, prior in robot_priors(robot).items() if prior.usual and not (rack and prior.contact))


def drop_known(names: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return the names that known parameters do not fix."""
    fixed = {*known, DAMPING_RATIO} if "servo_kd" in known else set(known)
    return [name for name in names if RATIOS.get(name, name) not in fixed]


def prior_scale(robot: RobotDescription, name: str, value: float) -> float:
    """Return the size of a number: its value, or what is usual where a sheet has 0."""
    if value > 0:
        return value
    mass, length = robot.urdf.total_mass, robot.leg_geometry.length
    if name in _DEFAULT_SCALES:
        return _DEFAULT_SCALES[name] * mass * length * (length if name == "rotor_inertia" else GRAVITY)
    return _ABSOLUTE_SCALES.get(name, 1e-6)
