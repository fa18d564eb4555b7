"""Variants of the simulated robot in properties of an adopted policy's training that are unknown.

No policy configuration contains the latency of readings, rotor inertia or friction. If a policy follows commands on a
robot with other values, its configuration may be right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from surefoot.arrays import Array
from surefoot.robot import PhysicalParams

_LATENCIES = (0.0, 0.01, 0.02)
"""Usual latencies of readings in training [s]."""
_FACTORS = (0.5, 1.0, 2.0)
"""Factors of rotor inertia and joint friction."""
_GROUND_FRICTION_FACTORS = (0.6, 1.5)
"""Factors of foot friction."""
_JOINT_FRICTION = ("motor_friction", "motor_viscous_friction", "load_friction")


@dataclass(frozen=True)
class RobotVariant:
    """A robot that differs from the simulated robot in properties that surefoot can only guess."""

    latency: float | None = None
    """Latency of the readings [s]; None: unchanged."""
    rotor: float = 1.0
    """Factor of the rotor inertia."""
    friction: float = 1.0
    """Factor of the joint friction."""
    ground: float = 1.0
    """Factor of the foot friction."""

    @property
    def count(self) -> int:
        """Number of differences."""
        return (self.latency is not None) + sum(one != 1.0 for one in (self.rotor, self.friction, self.ground))

    @property
    def text(self) -> str:
        """Description of the differences."""
        parts = [] if self.latency is None else [f"readings {1e3 * self.latency:g} ms old"]
        factors = {"rotor inertia": self.rotor, "friction of the joints": self.friction}
        factors["friction of the feet"] = self.ground
        parts += [f"{factor:g} times the {name}" for name, factor in factors.items() if factor != 1.0]
        return " and ".join(parts)

    def params(self, nominal: PhysicalParams) -> dict[str, Array]:
        """Return the physical parameters that differ, for the robots in `nominal`."""
        changed = {} if self.latency is None else {"control_latency": nominal.control_latency * 0 + self.latency}
        if self.rotor != 1.0:
            changed["rotor_inertia"] = nominal.rotor_inertia * self.rotor
        if self.friction != 1.0:
            changed |= {name: getattr(nominal, name) * self.friction for name in _JOINT_FRICTION}
        if self.ground != 1.0:
            changed["contact_friction"] = nominal.contact_friction * self.ground
        return changed


def robot_variants(latency: float) -> Sequence[RobotVariant]:
    """Return the variants to try for a simulated robot whose readings have the given latency [s]."""
    ages = [age for age in _LATENCIES if abs(age - latency) > 1e-3]
    bases = (None, ages[0] if ages[0] == 0.0 else None)
    variants = [RobotVariant(age) for age in ages]
    variants += [RobotVariant(*one) for one in product(bases, _FACTORS, _FACTORS)]
    variants += [RobotVariant(age, ground=ground) for age, ground in product(bases, _GROUND_FRICTION_FACTORS)]
    return [variant for variant in dict.fromkeys(variants) if variant != RobotVariant()]
