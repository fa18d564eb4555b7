"""Comparison of motor models: one motor follows a sine on the rack (Tan et al. 2018, fig. 4)."""

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
"""Time [s] for which the first target is held before the log begins, so that every model starts at rest."""

MAX_LENGTH = 600.0
"""Maximum length of a log [s]."""


@dataclass(frozen=True)
class MotorLog:
    """Log of one motor, T rows."""

    name: str
    """Name of the file or signal."""
    time: Array
    """Rising times (T,) [s]."""
    target: Array
    """Angle commanded from this time on (T,) [rad]."""
    angle: Array
    """Measured angle (T,) [rad]; NaN where nothing was measured."""

    def __post_init__(self) -> None:
        """Reject fewer than two rows, non-finite times or targets, times that do not rise, and too long logs."""
        if len(self.time) < 2:
            raise SurefootError(f"motor log {self.name}: has {len(self.time)} rows; it takes 2 or more")
        if not np.isfinite(self.time).all() or not np.isfinite(self.target).all():
            raise SurefootError(f"motor log {self.name}: times and targets must be finite")
        if np.any(np.diff(self.time) <= 0):
            raise SurefootError(f"motor log {self.name}: times must rise")
        if (length := float(self.time[-1] - self.time[0])) > MAX_LENGTH:
            raise SurefootError(
                f"motor log {self.name}: is {length:g} s long, at most {MAX_LENGTH:g} s; are its times in seconds?"
            )

    def error(self, simulated: Array) -> float:
        """Return the RMS error [rad] of simulated angles (T,) to measured ones, or to targets if none was measured."""
        measured = np.isfinite(self.angle)
        errors = (simulated - self.angle)[measured] if measured.any() else simulated - self.target
        return float(np.sqrt(np.mean(np.square(errors))))

    @classmethod
    def sine(cls, middle: float, amplitude: float, frequency: float, duration: float, step: float) -> MotorLog:
        """Return the targets `middle` + `amplitude` sin(2 pi `frequency` t) every `step` [s], without measurements."""
        time: Array = step * np.arange(round(duration / step) + 1, dtype=np.float64)
        target: Array = middle + amplitude * np.sin(2 * np.pi * frequency * time)
        return cls("sine", time, target, np.full(len(time), np.nan))

    @classmethod
    def read(cls, path: Path) -> MotorLog:
        """Read a CSV file with the columns time [s], target [rad] and angle [rad].

        Raises:
            SurefootError: the file can't be read or lacks these columns.
        """
        where = f"motor log {path}"
        with describe_os_errors(where), prefix_errors(where):
            check_readable(path)
            columns = read_csv(path).columns
            if any(name not in columns for name in COLUMNS):
                raise SurefootError(f"columns are {choices(columns)}; it takes {choices(COLUMNS)}")
        return cls(str(path), *(columns[name] for name in COLUMNS))

    def write(self, path: Path) -> Path:
        """Write the log as a CSV file that `read` reads."""
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = np.stack([self.time, self.target, self.angle], axis=1)
        np.savetxt(path, rows, "%.6f", ",", "\r\n", ",".join(COLUMNS), comments="")
        return path


def motor_index(robot: RobotDescription, motor: str) -> int:
    """Return the index of a motor by name.

    Raises:
        SurefootError: the name is unknown.
    """
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
    """Simulate a log's targets on one motor of a robot on the rack with each actuator model; other motors hold.

    Args:
        robot: robot description.
        make_world: factory of the simulation.
        log: targets and measured angles.
        index: index of the motor.
        params: physical parameters that differ from the robot description.

    Returns:
        True angle of the motor at the log's times (T,) [rad], by actuator model.
    """
    step = robot.timing.servo_step
    # One command per servo step, so that targets keep the timing of the log.
    nominal = PhysicalParams.nominal(robot).with_values(robot, **{**(params or {}), "control_step": step})
    clock = log.time - log.time[0]
    lead_in, ticks = round(LEAD_IN / step), math.ceil(clock[-1] / step) + 1
    # Index of the newest target at each servo step, with a margin for rounding.
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
