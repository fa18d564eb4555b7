"""One motor follows a sine on the rack: how well each model of the motor repeats it (Tan et al. 2018, fig. 4)."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, describe_os_errors
from surefoot.files import check_readable
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.interface import ACTUATORS, SimulationFactory, WorldConfig

COLUMNS = ("time", "target", "angle")
LEAD_IN = 0.5
"""Time [s] for which the first target is held before the clock starts, so that every model starts at rest."""


@dataclass(frozen=True)
class MotorLog:
    """One motor's recording; arrays (T,)."""

    name: str
    """Where it comes from."""
    time: Array
    """Rising, from the start of the motion [s]."""
    target: Array
    """Angle asked for from this time on [rad]."""
    angle: Array
    """Angle measured at this time [rad]; NaN where there is none."""

    def __post_init__(self) -> None:
        """Refuse what is no recording."""
        if len(self.time) < 2:
            raise SurefootError(f"motor log {self.name}: has {len(self.time)} rows; it takes 2 or more")
        if not np.isfinite(self.time).all() or not np.isfinite(self.target).all():
            raise SurefootError(f"motor log {self.name}: times and targets must be finite")
        if np.any(np.diff(self.time) <= 0):
            raise SurefootError(f"motor log {self.name}: times must rise")

    def error(self, simulated: Array) -> float:
        """Root mean square [rad] of simulated (T,) less measured angles; less targets where nothing was measured."""
        known = np.isfinite(self.angle)
        missed = (simulated - self.angle)[known] if known.any() else simulated - self.target
        return float(np.sqrt(np.mean(np.square(missed))))

    @classmethod
    def sine(cls, middle: float, amplitude: float, frequency: float, duration: float, step: float) -> MotorLog:
        """A target without a measurement: `middle` + `amplitude` sin(2 pi `frequency` t), renewed every `step` [s]."""
        time: Array = step * np.arange(round(duration / step) + 1, dtype=np.float64)
        target: Array = middle + amplitude * np.sin(2 * np.pi * frequency * time)
        return cls("sine", time, target, np.full(len(time), np.nan))

    @classmethod
    def read(cls, path: Path) -> MotorLog:
        """Read a CSV file with the columns time [s], target [rad] and angle [rad].

        Raises:
            SurefootError: a file that can't be read or is no such table.
        """
        try:
            with describe_os_errors(f"motor log {path}"):
                check_readable(path)
                with path.open(newline="", encoding="utf-8") as file:
                    rows = list(csv.DictReader(file))
        except (UnicodeDecodeError, csv.Error) as error:
            raise SurefootError(f"motor log {path}: is no CSV file: {error}") from error
        found = list(rows[0]) if rows else []
        if any(name not in found for name in COLUMNS):
            raise SurefootError(f"motor log {path}: columns are {choices(found)}; it takes {choices(COLUMNS)}")
        columns: dict[str, list[float]] = {name: [] for name in COLUMNS}
        for number, row in enumerate(rows, start=2):
            for name in COLUMNS:
                try:
                    columns[name].append(float(row[name]))
                except (TypeError, ValueError):
                    text = row[name]
                    raise SurefootError(f"motor log {path}: line {number}: {name} '{text}' is no number") from None
        return cls(str(path), *(np.array(columns[name]) for name in COLUMNS))

    def write(self, path: Path) -> Path:
        """Write a CSV file that `read` reads."""
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = np.stack([self.time, self.target, self.angle], axis=1)
        np.savetxt(path, rows, "%.6f", ",", "\r\n", ",".join(COLUMNS), comments="")
        return path


def motor_index(robot: RobotDescription, motor: str) -> int:
    """Place of a motor in the robot's order; refused, if there is no such motor."""
    if motor not in robot.motor_names:
        raise SurefootError(f"motor '{motor}' does not exist; motors: {choices(robot.motor_names)}")
    return robot.motor_names.index(motor)


def run_motor_experiment(
    robot: RobotDescription,
    make_world: SimulationFactory,
    log: MotorLog,
    index: int,
    params: Mapping[str, float] | None = None,
) -> dict[str, Array]:
    """Let one motor of the robot on its rack follow a log's targets with each model of the motor; the others hold.

    Args:
        robot: the robot.
        make_world: makes the simulation.
        log: targets, and what was measured.
        index: place of the motor that follows them in the robot's order.
        params: physical parameters that differ from the robot's description; refused if it does not allow them.

    Returns:
        by actuator, the motor's true angle at the log's times (T,) [rad].
    """
    step = robot.timing.servo_step
    # A command for every servo step: the targets come with the log's own timing.
    given = {**(params or {}), "control_step": step}
    nominal = PhysicalParams.nominal(robot).with_values(robot, **given)
    clock = log.time - log.time[0]
    lead_in, ticks = round(LEAD_IN / step), math.ceil(clock[-1] / step) + 1
    # The newest target at each servo step; a hair's breadth against rounding.
    newest = np.searchsorted(clock, np.arange(ticks) * step + 1e-9, side="right") - 1
    found = {}
    for actuator in ACTUATORS:
        config = WorldConfig(actuator=actuator, rack=True, threads=1)  # type: ignore[arg-type]
        world = make_world(robot, 1, nominal, 0, config)
        command, angle = robot.resting_angles.copy(), np.empty(ticks)
        for tick in range(-lead_in, ticks):
            if tick >= 0:
                angle[tick] = world.truth().motor_angle[0, index]
            command[index] = log.target[newest[max(tick, 0)]]
            world.step(command[None])
        found[actuator] = np.interp(clock, np.arange(ticks) * step, angle)
    return found
