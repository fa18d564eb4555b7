"""Configuration of sinusoids and foot trajectories, with one value for all legs or one per leg."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import Within
from surefoot.errors import SurefootError, choices, suggest
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.task.foot_paths import LENGTHS, FootPaths
from surefoot.task.periodic_references import Wave

PerLeg = float | dict[str, float]
"""One value for all legs, or a table with one value per leg."""
Length = Annotated[PerLeg, Within(0, 10)]


@dataclass(frozen=True)
class WaveConfig:
    """A sinusoid for each leg: amplitude sin(2 pi frequency t + phase) + offset."""

    amplitude: PerLeg = 0.0
    """rad"""
    frequency: Annotated[PerLeg, Within(0, 1e6)] = 0.0
    """Hz"""
    phase: PerLeg = 0.0
    """rad"""
    offset: PerLeg = 0.0
    """rad"""

    def wave(self, where: str, legs: tuple[str, ...]) -> Wave:
        """Return the sinusoids of the legs; `where` names the configuration in error messages."""
        return Wave(**_values_by_leg(self, where, legs))


@dataclass(frozen=True)
class FootConfig:
    """Foot trajectories in the legs' planes. A duty factor of 0 or 1 would need an infinite foot speed."""

    frequency: Annotated[float, Within(0.01, 50)] = 2.0
    """Cycles a second [Hz]."""
    stroke: Annotated[PerLeg, Within(-10, 10)] = 0.1
    """Distance that a foot moves backward in stance, relative to the base [m]; negative: forward."""
    clearance: Length = 0.03
    """Lift of a foot in the middle of its swing [m]."""
    duty_factor: Annotated[PerLeg, Within(0.05, 0.95)] = 0.5
    """Fraction of the cycle that a foot is on the ground."""
    phase: Annotated[PerLeg, Within(-1000, 1000)] = 0.0
    """Phase offset of a foot's cycle, which begins at touchdown [cycles]."""
    height: Length = 0.22
    """Height of the motor axis above the end of the foot at touchdown and lift-off [m]."""
    offset: Annotated[PerLeg, Within(-10, 10)] = 0.0
    """Position of the middle of the stroke, forward from the motor axis [m]."""
    depth: Length = 0.0
    """Depth below `height` to which a foot is commanded in the middle of its stance [m]."""

    def paths(self, robot: RobotDescription, relative: bool = False) -> FootPaths:
        """Return the foot trajectories of a robot.

        Args:
            robot: the robot.
            relative: whether lengths are in lengths l of the straight leg, and the frequency in sqrt(g / l) / 2 pi.
        """
        values = _values_by_leg(self, "reference.foot", robot.leg_names)
        frequency = np.array(values.pop("frequency")[0])
        if relative:
            length = robot.leg_geometry.length
            frequency = frequency * np.sqrt(GRAVITY / length) / (2 * np.pi)
            values |= {name: values[name] * length for name in LENGTHS}
        return FootPaths(robot.leg_names, robot.leg_geometry, frequency, **values)


def check_names(table: Mapping[str, Any], names: tuple[str, ...], where: str) -> None:
    """Reject a table whose keys are not exactly `names`."""
    for key in table:
        if key not in names:
            raise SurefootError(f"{where}.{key} is not a key; {suggest(key, names)}")
    missing = [name for name in names if name not in table]
    if missing:
        raise SurefootError(f"{where} lacks {choices(missing)}; it needs {choices(names)}")


def _values_by_leg(config: WaveConfig | FootConfig, where: str, legs: tuple[str, ...]) -> dict[str, Array]:
    """Return each quantity as an array with one value per leg (L,)."""
    values = {}
    for name, value in vars(config).items():
        if not isinstance(value, Mapping):
            value = dict.fromkeys(legs, value)
        check_names(value, legs, f"{where}.{name}")
        values[name] = np.array([value[leg] for leg in legs], float)
    return values
