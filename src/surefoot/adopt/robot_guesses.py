"""What surefoot guesses of the robot that an adopted policy was trained on, as changes of the simulated robot.

Age of the readings, rotor inertia and friction stand in no configuration of a policy. A policy that follows commands on
a robot with other values of these does not show a mistake in its configuration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from surefoot.arrays import Array
from surefoot.robot import PhysicalParams

_AGES = (0.0, 0.01, 0.02)
"""Ages of the readings that trainings have [s]."""
_FACTORS = (0.5, 1.0, 2.0)
"""Factors of rotor inertia and of friction in the joints."""
_GROUND = (0.6, 1.5)
"""Factors of the friction of the feet."""
_JOINT_FRICTION = ("motor_friction", "motor_viscous_friction", "load_friction")


@dataclass(frozen=True)
class RobotVariant:
    """A robot that differs from the simulated one in what surefoot guesses."""

    latency: float | None = None
    """Age of the readings [s]; None: as it is."""
    rotor: float = 1.0
    """Factor of the inertia of the rotors."""
    friction: float = 1.0
    """Factor of the friction in the joints."""
    ground: float = 1.0
    """Factor of the friction of the feet."""

    @property
    def count(self) -> int:
        """Number of differences."""
        return (self.latency is not None) + sum(one != 1.0 for one in (self.rotor, self.friction, self.ground))

    @property
    def text(self) -> str:
        """The change in words."""
        parts = [] if self.latency is None else [f"readings {1e3 * self.latency:g} ms old"]
        factors = {"rotor inertia": self.rotor, "friction of the joints": self.friction}
        factors["friction of the feet"] = self.ground
        parts += [f"{factor:g} times the {name}" for name, factor in factors.items() if factor != 1.0]
        return " and ".join(parts)

    def params(self, nominal: PhysicalParams) -> dict[str, Array]:
        """Return the parameters that differ, for the robots of `nominal`."""
        changed = {} if self.latency is None else {"control_latency": nominal.control_latency * 0 + self.latency}
        if self.rotor != 1.0:
            changed["rotor_inertia"] = nominal.rotor_inertia * self.rotor
        if self.friction != 1.0:
            changed |= {name: getattr(nominal, name) * self.friction for name in _JOINT_FRICTION}
        if self.ground != 1.0:
            changed["contact_friction"] = nominal.contact_friction * self.ground
        return changed


def robot_variants(latency: float) -> Sequence[RobotVariant]:
    """Return the robots to try for a policy whose readings are simulated with an age `latency` [s]."""
    ages = [age for age in _AGES if abs(age - latency) > 1e-3]
    bases = (None, ages[0] if ages[0] == 0.0 else None)
    guesses = [RobotVariant(age) for age in ages]
    guesses += [RobotVariant(*one) for one in product(bases, _FACTORS, _FACTORS)]
    guesses += [RobotVariant(age, ground=ground) for age, ground in product(bases, _GROUND)]
    return [guess for guess in dict.fromkeys(guesses) if guess != RobotVariant()]
