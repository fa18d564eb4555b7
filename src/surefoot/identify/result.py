"""What an identification found: estimates with intervals, what data do not tell, and how well it holds elsewhere.

How well a simulator can know a robot at all bounds every interval: a recording of a robot that is emulated in Bullet,
fitted in MuJoCo, gives values that are off by more than the noise of its readings explains, since two engines close
loops differently, and voltage and time are sampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS

NORMAL_95 = 1.959964
"""Standard deviations on either side that hold 95 % of a normal distribution."""
RELATIVE = 0.005
"""Least deviation of what fits find, as a share of a value."""
LESS_SURE = {
    "torque_constant": 0.01,
    "servo_kp": 0.01,
    "leg_mass_ratio": 0.01,
    "leg_inertia_ratio": 0.02,
    "base_inertia_ratio": 0.02,
}
"""The same of values that the engines disagree about more."""
ABSOLUTE = {"servo_latency": 6e-5, "control_latency": 6e-5, "motor_friction": 2e-4, "motor_viscous_friction": 1e-4}
"""Least deviation of values that may be near 0, in their units."""


def indexed_name(name: str, index: int | None) -> str:
    """Return a number's name, with its index in brackets if it has one."""
    return name if index is None else f"{name}[{index}]"


def with_floor(name: str, value: float, deviation: float) -> float:
    """A deviation that counts the simulator's own accuracy."""
    floor = ABSOLUTE.get(name, 0.0)
    return float((deviation**2 + (LESS_SURE.get(name, RELATIVE) * value) ** 2 + floor**2) ** 0.5)


@dataclass(frozen=True)
class ParameterEstimate:
    """A number that was found."""

    name: str
    """Physical parameter, or another name."""
    value: float
    deviation: float
    """Standard deviation of what is not known about it."""
    unit: str
    index: int | None = None
    """Which motor or axis, if it is not one for all."""
    identifiable: bool = True
    """Whether the data tell it; if not, the value is what was taken before, and must not be relied on."""
    low: float = -math.inf
    """Least value that it may have at all."""
    high: float = math.inf
    """Greatest one."""

    @classmethod
    def within_bounds(
        cls,
        robot: RobotDescription,
        name: str,
        value: float,
        deviation: float,
        index: int | None = None,
        identifiable: bool = True,
    ) -> ParameterEstimate:
        """Return an estimate of a physical parameter, with its unit, within what the robot allows."""
        return cls(name, value, deviation, PARAMETERS[name].unit, index, identifiable, *robot.allowed[name])

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval, within what is possible."""
        reach = NORMAL_95 * self.deviation
        return max(self.value - reach, self.low), min(self.value + reach, self.high)

    @property
    def label(self) -> str:
        """Name with index."""
        return indexed_name(self.name, self.index)


@dataclass(frozen=True)
class Check:
    """How far the simulator is from a part of the recording that was not fitted, before and after."""

    what: str
    """Quantity."""
    before: float
    """Root mean square error with the parameters that were known before."""
    after: float
    """The same with those that were found."""
    unit: str


@dataclass(frozen=True)
class Series:
    """Something measured and simulated over time or another axis, for the report."""

    title: str
    x_label: str
    y_label: str
    x: Array
    measured: Array
    before: Array
    """With the parameters that were known before; NaN where there is none."""
    after: Array
    """With those that were found."""
    points: bool = False
    """Draw the measured values as points instead of a line."""


@dataclass(frozen=True)
class Identification:
    """What one experiment, or traces, told."""

    experiment: str
    robot: str
    estimates: tuple[ParameterEstimate, ...]
    checks: tuple[Check, ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()
    """Pairs of numbers that the data can hardly tell apart."""
    notes: tuple[str, ...] = ()
    """What else whoever reads it should know, such as what the data do not tell, and why."""
    series: tuple[Series, ...] = ()
    sensors: dict[str, Any] = field(default_factory=dict)
    """What was found of sensors and later fits need: torque_gain (relative errors of the motors' torque reports)."""
    digest: str = ""
    """SHA-256 of the data."""
    date: str = ""
    """When they were recorded, ISO 8601."""

    def estimate(self, name: str, index: int | None = None) -> ParameterEstimate:
        """One of the estimates; a `KeyError`, if there is none of that name and index."""
        for item in self.estimates:
            if item.name == name and item.index == index:
                return item
        raise KeyError(indexed_name(name, index))

    def params(self, robot: RobotDescription, base: PhysicalParams) -> PhysicalParams:
        """One row of `base` with what was found in place of what it had, within what the robot allows."""
        params = base.rows(np.zeros(1, np.int64))
        for item in self.estimates:
            if item.name not in PhysicalParams.names() or not item.identifiable:
                continue
            low, high = robot.allowed[item.name]
            array = getattr(params, item.name)
            if array.ndim == 1:
                array[0] = np.clip(item.value, low, high)
            else:
                array[0, slice(None) if item.index is None else item.index] = np.clip(item.value, low, high)
        return params

    def identified_names(self) -> tuple[str, ...]:
        """Names of physical parameters that it tells, each once."""
        names = [item.name for item in self.estimates if item.identifiable and item.name in PhysicalParams.names()]
        return tuple(dict.fromkeys(names))
