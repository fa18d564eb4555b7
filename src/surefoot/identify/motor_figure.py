"""A motor that follows a sine on the rack, simulated with each model of the motor (Tan et al. 2018, fig. 4)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, describe_os_errors, prefix_errors, suggest
from surefoot.files import check_readable
from surefoot.identify.motion.column_table import read_csv
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
    """Rising [s]."""
    target: Array
    """Commanded angle from this time on [rad]."""
    angle: Array
    """Measured angle [rad]; NaN where there is none."""

    def __post_init__(self) -> None:
        """Refuse too few rows, and times or targets that are not finite or do not rise."""
        if len(self.time) < 2:
            raise SurefootError(f"motor log {self.name}: has {len(self.time)} rows; it takes 2 or more")
        if not np.isfinite(self.time).all() or not np.isfinite(self.target).all():
            raise SurefootError(f"motor log {self.name}: times and targets must be finite")
        if np.any(np.diff(self.time) <= 0):
            raise SurefootError(f"motor log {self.name}: times must rise")

    def error(self, simulated: Array) -> float:
        """Return the RMS [rad] of simulated (T,) less measured angles; less targets where nothing was measured."""
        measured = np.isfinite(self.angle)
        errors = (simulated - self.angle)[measured] if measured.any() else simulated - self.target
        return float(np.sqrt(np.mean(np.square(errors))))

    @classmethod
    def sine(cls, middle: float, amplitude: float, frequency: float, duration: float, step: float) -> MotorLog:
        """Return a target without a measurement: `middle` + `amplitude` sin(2 pi `frequency` t), every `step` [s]."""
        time: Array = step * np.arange(round(duration / step) + 1, dtype=np.float64)
        target: Array = middle + amplitude * np.sin(2 * np.pi * frequency * time)
        return cls("sine", time, target, np.full(len(time), np.nan))

    @classmethod
    def read(cls, path: Path) -> MotorLog:
        """Read a CSV file with the columns time [s], target [rad] and angle [rad].

        Raises:
            SurefootError: a file that can't be read or is no such table.
        """
        where = f"motor log {path}"
        with describe_os_errors(where), prefix_errors(where):
            check_readable(path)
            columns = read_csv(path).columns
            if any(name not in columns for name in COLUMNS):
                raise SurefootError(f"columns are {choices(columns)}; it takes {choices(COLUMNS)}")
        return cls(str(path), *(columns[name] for name in COLUMNS))

    def write(self, path: Path) -> Path:
        """Write a CSV file that `read` reads."""
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = np.stack([self.time, self.target, self.angle], axis=1)
        np.savetxt(path, rows, "%.6f", ",", "\r\n", ",".join(COLUMNS), comments="")
        return path


def motor_index(robot: RobotDescription, motor: str) -> int:
    """Return the index of a motor; refuse an unknown name."""
    if motor not in robot.motor_names:
        raise SurefootError(f"motor '{motor}' does not exist; {suggest(motor, robot.motor_names)}")
    return robot.motor_names.index(motor)


def run_motor_experiment(
    robot: RobotDescription,
    make_world: SimulationFactory,
    log: MotorLog,
    index: int,
    params: Mapping[str, float] | None = None,
) -> dict[str, Array]:
    """Simulate one motor on the rack that follows a log's targets, with each model of the motor; the others hold.

    Args:
        robot: the robot.
        make_world: makes the simulation.
        log: targets, and what was measured.
        index: of the motor.
        params: physical parameters that differ from the robot's description.

    Returns:
        By actuator, the motor's true angle at the log's times (T,) [rad].
    """
    step = robot.timing.servo_step
    # A command for every servo step: the targets come with the log's own timing.
    nominal = PhysicalParams.nominal(robot).with_values(robot, **{**(params or {}), "control_step": step})
    clock = log.time - log.time[0]
    lead_in, ticks = round(LEAD_IN / step), math.ceil(clock[-1] / step) + 1
    # The newest target at each servo step, with a margin against rounding.
    newest = np.searchsorted(clock, np.arange(ticks) * step + 1e-9, side="right") - 1
    angles = {}
    for actuator in ACTUATORS:
        config = WorldConfig(actuator=actuator, rack=True, threads=1)  # type: ignore[arg-type]
        world = make_world(robot, 1, nominal, 0, config)
        command, angle = robot.resting_angles.copy(), np.empty(ticks)
        for tick in range(-lead_in, ticks):
            if tick >= 0:
                angle[tick] = world.truth().motor_angle[0, index]
            command[index] = log.target[newest[max(tick, 0)]]
            world.step(command[None])
        angles[actuator] = np.interp(clock, np.arange(ticks) * step, angle)
    return angles
