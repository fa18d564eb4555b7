"""Results of an identification: estimates with intervals, identifiability, and errors on held-out data.

No interval is narrower than the accuracy of the simulator. A recording of a robot that is emulated in Bullet and fitted
in MuJoCo gives estimates with larger errors than sensor noise explains, because the engines close kinematic loops
differently and voltage and time are sampled.
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
"""Progress callback of a fit: name of the step, and mean squared residual (NaN if there is none)."""
NORMAL_95 = 1.959964
"""Half width of a normal distribution's 95 % interval, in standard deviations."""
RELATIVE_ACCURACY = 0.005
"""Standard deviation of the simulator's error, relative to the parameter's value."""
RELATIVE_ACCURACIES = {
    "torque_constant": 0.01,
    "servo_kp": 0.01,
    "leg_mass_ratio": 0.01,
    "leg_inertia_ratio": 0.02,
    "base_inertia_ratio": 0.02,
}
"""`RELATIVE_ACCURACY` of parameters on which the engines agree less."""
ABSOLUTE_ACCURACIES = {
    "servo_latency": 6e-5,
    "control_latency": 6e-5,
    "motor_friction": 2e-4,
    "motor_viscous_friction": 1e-4,
}
"""Additional standard deviation of the simulator's error in parameters that may be near 0, in their units."""


def ignore_progress(step: str, cost: float) -> None:
    """Ignore the progress of a fit (no-op callback)."""


def indexed_name(name: str, index: int | None) -> str:
    """Return a name, with the index in brackets if there is one."""
    return name if index is None else f"{name}[{index}]"


def add_model_error(name: str, value: float, deviation: float) -> float:
    """Return the standard deviation of an estimate, increased by the simulator's accuracy."""
    relative, absolute = RELATIVE_ACCURACIES.get(name, RELATIVE_ACCURACY), ABSOLUTE_ACCURACIES.get(name, 0.0)
    return float((deviation**2 + (relative * value) ** 2 + absolute**2) ** 0.5)


@dataclass(frozen=True)
class ParameterEstimate:
    """Estimate of a physical parameter, or of another quantity that an experiment measures."""

    name: str
    value: float
    deviation: float
    """Standard deviation of the error."""
    unit: str
    index: int | None = None
    """Index of the motor or axis; None for a single value."""
    identifiable: bool = True
    """Whether the data determine it; otherwise the value is the prior one, and is not written."""
    low: float = -math.inf
    """Minimum possible value."""
    high: float = math.inf
    """Maximum possible value."""
    of_robot: bool = True
    """Whether it is a property of the robot, unlike gains that are sent with every command."""

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
        """Make the estimate of a physical parameter, with its unit and the robot's bounds."""
        return cls(name, value, deviation, PARAMETERS[name].unit_for(robot), index, identifiable, *robot.allowed[name])

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval, within the bounds."""
        half_width = NORMAL_95 * self.deviation
        return max(self.value - half_width, self.low), min(self.value + half_width, self.high)

    @property
    def label(self) -> str:
        """Name with the index in brackets."""
        return indexed_name(self.name, self.index)


@dataclass(frozen=True)
class Check:
    """Root mean square error of the simulator on some data, with the prior parameters and with the estimates."""

    what: str
    """Compared quantity, or name of the log."""
    before: float
    """RMS error with the prior parameters."""
    after: float
    """RMS error with the estimates."""
    unit: str
    fitted: bool = False
    """Whether these data were fitted; otherwise they were held out."""


@dataclass(frozen=True)
class Series:
    """Measured and simulated curves of one quantity over time or another axis, for a figure of the report."""

    title: str
    x_label: str
    y_label: str
    x: Array
    measured: Array
    before: Array
    """Simulation with the prior parameters; NaN if there is none."""
    after: Array
    """Simulation with the estimates."""
    points: bool = False
    """Whether measured values are drawn as points instead of a line."""


@dataclass(frozen=True)
class Identification:
    """Result of an identification from one experiment, from traces, or from logs."""

    experiment: str
    robot: str
    estimates: tuple[ParameterEstimate, ...]
    checks: tuple[Check, ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()
    """Pairs of estimates with strongly correlated errors: two labels and the correlation."""
    notes: tuple[str, ...] = ()
    """Limitations of the result, such as parameters that are not identifiable, with reasons."""
    series: tuple[Series, ...] = ()
    """Curves for the figures of the report."""
    sensors: dict[str, Any] = field(default_factory=dict)
    """Sensor properties that later fits need: torque_gain (relative error of each motor's torque report)."""
    digest: str = ""
    """SHA-256 of the data."""
    date: str = ""
    """Date of the recording, ISO 8601."""
    log_digests: dict[str, str] = field(default_factory=dict)
    """SHA-256 of each log by name, fitted or held out."""
    gains: dict[str, list[float]] = field(default_factory=dict)
    """Servo gains of each motor during the logs, for a robot that receives its gains with every command."""
    stated_gains: tuple[str, ...] = ()
    """Names of the gains that the logs or the user stated, so that they were not estimated."""
    failure: tuple[str, ...] = ()
    """Why the fit does not explain the data, followed by suggestions; empty if it does."""

    @property
    def checks_title(self) -> str:
        """Title of the table of checks."""
        if any(check.fitted for check in self.checks):
            return "RMS error of replayed logs, fitted and held out"
        return "RMS error on data that were not fitted"

    def estimate(self, name: str, index: int | None = None) -> ParameterEstimate:
        """Return the estimate with a name and index.

        Raises:
            KeyError: there is none.
        """
        for item in self.estimates:
            if (item.name, item.index) == (name, index):
                return item
        raise KeyError(indexed_name(name, index))

    def params(self, robot: RobotDescription, base: PhysicalParams) -> PhysicalParams:
        """Return the first row of `base`, with estimates of the identifiable parameters within the robot's bounds."""
        params = base.rows(np.zeros(1, np.int64))
        for item in self.estimates:
            if item.identifiable and item.of_robot and item.name in PhysicalParams.names():
                value = np.clip(item.value, *robot.allowed[item.name])
                getattr(params, item.name)[0, ... if item.index is None else item.index] = value
        return params

    def identified_names(self) -> tuple[str, ...]:
        """Return the names of the identifiable physical parameters of the robot, without repetition."""
        names = [item.name for item in self.estimates if item.identifiable and item.of_robot]
        return tuple(dict.fromkeys(name for name in names if name in PhysicalParams.names()))
