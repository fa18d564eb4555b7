"""Results of identification: estimates with intervals, whether data determine them, and errors on held-out data.

The accuracy of a simulator bounds every interval. A recording of a robot that is emulated in Bullet, fitted in MuJoCo,
gives values that are off by more than the noise of its readings explains: two engines close loops differently, and
voltage and time are sampled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS

FitProgress = Callable[[str, float], None]
"""Callback of a fit: the step, and the mean square of the residuals in standard deviations (NaN if there is none)."""
NORMAL_95 = 1.959964
"""Half width of a normal distribution's 95 % interval, in standard deviations."""
RELATIVE_ACCURACY = 0.005
"""Least deviation of fitted values, as a share of the value."""
RELATIVE_ACCURACIES = {
    "torque_constant": 0.01,
    "servo_kp": 0.01,
    "leg_mass_ratio": 0.01,
    "leg_inertia_ratio": 0.02,
    "base_inertia_ratio": 0.02,
}
"""The same of parameters on which the engines agree less."""
ABSOLUTE_ACCURACIES = {
    "servo_latency": 6e-5,
    "control_latency": 6e-5,
    "motor_friction": 2e-4,
    "motor_viscous_friction": 1e-4,
}
"""Least deviation of parameters that may be near 0, in their units."""


def ignore_progress(step: str, cost: float) -> None:
    """Do nothing with the progress of a fit."""


def indexed_name(name: str, index: int | None) -> str:
    """Return a name, with its index in brackets if it has one."""
    return name if index is None else f"{name}[{index}]"


def add_model_error(name: str, value: float, deviation: float) -> float:
    """Return a deviation that includes the simulator's own accuracy."""
    relative, absolute = RELATIVE_ACCURACIES.get(name, RELATIVE_ACCURACY), ABSOLUTE_ACCURACIES.get(name, 0.0)
    return float((deviation**2 + (relative * value) ** 2 + absolute**2) ** 0.5)


@dataclass(frozen=True)
class ParameterEstimate:
    """An estimate of a physical parameter, or of another number that an experiment measures."""

    name: str
    value: float
    deviation: float
    """Standard deviation of its error."""
    unit: str
    index: int | None = None
    """Motor or axis, if the number is not one for all."""
    identifiable: bool = True
    """Whether the data determine it; if not, the value is the prior one, and is not written."""
    low: float = -math.inf
    """Least possible value."""
    high: float = math.inf
    of_robot: bool = True
    """Whether it is a property of the robot; gains that come with every command are not."""

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
        """Return an estimate of a physical parameter, with its unit and the robot's bounds."""
        return cls(name, value, deviation, PARAMETERS[name].unit_for(robot), index, identifiable, *robot.allowed[name])

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval, within the bounds."""
        reach = NORMAL_95 * self.deviation
        return max(self.value - reach, self.low), min(self.value + reach, self.high)

    @property
    def label(self) -> str:
        """Name with index."""
        return indexed_name(self.name, self.index)


@dataclass(frozen=True)
class Check:
    """Root mean square error of the simulator."""

    what: str
    """Quantity."""
    before: float
    """With the prior parameters."""
    after: float
    """With the estimates."""
    unit: str
    fitted: bool = False
    """Whether these data were fitted; if not, they are a check."""


@dataclass(frozen=True)
class Series:
    """A measured and simulated quantity over time or another axis, for the report."""

    title: str
    x_label: str
    y_label: str
    x: Array
    measured: Array
    before: Array
    """With the prior parameters; NaN where there is none."""
    after: Array
    """With the estimates."""
    points: bool = False
    """Draw measured values as points."""


@dataclass(frozen=True)
class Identification:
    """Result of one experiment, of traces or of logs."""

    experiment: str
    robot: str
    estimates: tuple[ParameterEstimate, ...]
    checks: tuple[Check, ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()
    """Pairs of estimates whose errors correlate strongly."""
    notes: tuple[str, ...] = ()
    """What limits the result, such as parameters that are not identifiable, and why."""
    series: tuple[Series, ...] = ()
    sensors: dict[str, Any] = field(default_factory=dict)
    """Properties of sensors that later fits need: torque_gain (relative errors of the motors' torque reports)."""
    digest: str = ""
    """SHA-256 of the data."""
    date: str = ""
    """When they were recorded, ISO 8601."""
    parts: dict[str, str] = field(default_factory=dict)
    """SHA-256 of each log by its name, fitted or held out."""
    gains: dict[str, list[float]] = field(default_factory=dict)
    """Gains of each motor with which the logs were recorded, of a robot that gets its gains with every command."""
    stated_gains: tuple[str, ...] = ()
    """Names of those that were stated, by the logs or the user."""
    failure: tuple[str, ...] = ()
    """Why the result explains nothing, then what to try; empty, if it does."""

    @property
    def checks_title(self) -> str:
        """Title of a table of the checks."""
        if any(check.fitted for check in self.checks):
            return "RMS error of replayed logs, fitted ones and held-out ones"
        return "RMS error on data that were not fitted"

    def estimate(self, name: str, index: int | None = None) -> ParameterEstimate:
        """Return the estimate of a name and index; a `KeyError`, if there is none."""
        for item in self.estimates:
            if (item.name, item.index) == (name, index):
                return item
        raise KeyError(indexed_name(name, index))

    def params(self, robot: RobotDescription, base: PhysicalParams) -> PhysicalParams:
        """Return one row of `base` with the identifiable parameters replaced, within the robot's bounds."""
        params = base.rows(np.zeros(1, np.int64))
        for item in self.estimates:
            if item.identifiable and item.of_robot and item.name in PhysicalParams.names():
                value = np.clip(item.value, *robot.allowed[item.name])
                getattr(params, item.name)[0, ... if item.index is None else item.index] = value
        return params

    def identified_names(self) -> tuple[str, ...]:
        """Return the names of the identifiable physical parameters, each once."""
        found = [item.name for item in self.estimates if item.identifiable and item.of_robot]
        return tuple(dict.fromkeys(name for name in found if name in PhysicalParams.names()))
