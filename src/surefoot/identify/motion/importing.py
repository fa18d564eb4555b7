"""Import of foreign logs, by a mapping of columns.

    # mapping.yaml; all but motors may be left out
    time: {column: time, unit: s}                # s, ms, us, ns; the recorder's own times of a bag, if left out
    unit: rad                                    # of angles: rad or deg; speeds are these per second
    motors:                                      # for each motor of the robot, in any order
      rightFrontLegMotor: {command: "command[0]", angle: "motor_angle[0]", sign: 1, offset: 0.0}
    imu: {roll: "imu[0]", pitch: "imu[1]", roll_rate: "imu[2]", pitch_rate: "imu[3]", unit: rad, sign: 1}
    rows: {episode_index: 3}                     # only rows with this value, of a file with several runs

A motor's angle is sign x column + offset, its command too; `velocity` and `torque` may be mapped beside them. Readings
without a column are NaN; so are the commands of a log of states, in whose mapping no motor has one. Times and rows stay
as they are, uneven and repeated ones too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import from_mapping, read_yaml
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.identify.motion.column_table import ColumnTable, read_table
from surefoot.identify.motion.go2_messages import is_go2, read_go2
from surefoot.identify.motion.recorded import RecordedMotion, check_rising
from surefoot.robot import RobotDescription

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
ANGLE_UNITS = {"rad": 1.0, "deg": float(np.pi / 180)}


@dataclass(frozen=True)
class TimeColumn:
    """The column of times."""

    column: str
    unit: Literal["s", "ms", "us", "ns"] = "s"


@dataclass(frozen=True)
class MotorColumns:
    """The columns of one motor."""

    command: str | None = None
    """Left out for every motor of a log of states."""
    angle: str | None = None
    velocity: str | None = None
    torque: str | None = None
    sign: Literal[-1, 1] = 1
    offset: float = 0.0
    """Added to angles and commands [rad], after unit and sign."""


@dataclass(frozen=True)
class ImuColumns:
    """The columns of the IMU: the base's attitude, yaw about z, pitch about y, then roll about x, and rates in it."""

    roll: str | None = None
    pitch: str | None = None
    yaw: str | None = None
    roll_rate: str | None = None
    pitch_rate: str | None = None
    yaw_rate: str | None = None
    unit: Literal["rad", "deg"] = "rad"
    sign: Literal[-1, 1] = 1


@dataclass(frozen=True)
class LogMapping:
    """The columns of a log."""

    motors: dict[str, MotorColumns]
    time: TimeColumn | None = None
    unit: Literal["rad", "deg"] = "rad"
    imu: ImuColumns = field(default_factory=ImuColumns)
    rows: dict[str, float] = field(default_factory=dict)
    """Values of columns in the rows that are taken; all rows, if left out."""


def default_mapping(robot: RobotDescription) -> LogMapping:
    """Return the mapping of a file with arrays time, command, motor_angle and imu, all in the robot's own order."""
    motors = {name: MotorColumns(f"command[{k}]", f"motor_angle[{k}]") for k, name in enumerate(robot.motor_names)}
    return LogMapping(motors, TimeColumn("time"), imu=ImuColumns("imu[0]", "imu[1]", None, "imu[2]", "imu[3]"))


def import_log(
    path: Path, robot: RobotDescription, mapping: Path | None = None, any_checksum: bool = False
) -> RecordedMotion:
    """Return the motion of a foreign log.

    Args:
        path: NPZ, CSV, pickle, torch, Parquet, MCAP, or folder or file of a ROS bag.
        robot: whose log it is.
        mapping: YAML file; if not given, bags and CSV files of a Go2's messages are read as such, and others by
            `default_mapping`.
        any_checksum: take a Go2's messages with a wrong checksum too.

    Raises:
        SurefootError: a file that can't be read, a mapping that does not fit the robot or the file, time that goes
            backwards, or commands that are missing in a row of a log with commands.
    """
    columns = default_mapping(robot)
    if mapping is None and is_go2(robot) and (motion := read_go2(path, any_checksum)) is not None:
        return motion
    if mapping is not None:
        data = read_yaml(mapping)
        with prefix_errors(mapping):
            columns = from_mapping(LogMapping, data)
            for name in columns.motors:
                if name not in robot.motor_names:
                    raise SurefootError(
                        f"motors names '{name}', which {robot.name} does not have; it has {choices(robot.motor_names)}"
                    )
            if missing := [name for name in robot.motor_names if name not in columns.motors]:
                raise SurefootError(f"motors lacks {choices(missing)}; it must name every motor")
            _check_commands(columns)
    with prefix_errors(f"log {path}"):
        return _motion(read_table(path).where(columns.rows), columns, robot, mapping is None, path.name)


def _check_commands(columns: LogMapping) -> None:
    """Refuse commands of some motors, and motors with neither command nor angle."""
    without = [name for name, motor in columns.motors.items() if motor.command is None]
    if without and len(without) < len(columns.motors):
        raise SurefootError(
            f"motors.{without[0]} has no command, and other motors have one; give it, or leave out all of them for a "
            "log of states"
        )
    for name in without:
        if columns.motors[name].angle is None:
            raise SurefootError(f"motors.{name} has neither command nor angle; it needs one of them")


def _motion(
    table: ColumnTable, columns: LogMapping, robot: RobotDescription, default: bool, name: str
) -> RecordedMotion:
    motors = [columns.motors[key] for key in robot.motor_names]
    if default and (extra := f"command[{robot.num_motors}]") in table.columns:
        raise SurefootError(f"has a column '{extra}'; {robot.name} has {robot.num_motors} motors")
    missing = np.full(table.rows, np.nan)

    def column(key: str | None, optional: bool = False) -> Array:
        return missing if key is None or (optional and key not in table.columns) else table.column(key)

    def of_motors(key: str, unit: float = 1.0, offset: bool = False) -> Array:
        optional = default and key != "command"
        return np.stack(
            [column(getattr(m, key), optional) * (m.sign * unit) + (m.offset if offset else 0.0) for m in motors],
            axis=1,
        )

    def of_imu(*keys: str) -> Array:
        factor = columns.imu.sign * ANGLE_UNITS[columns.imu.unit]
        return np.stack([column(getattr(columns.imu, key), default) * factor for key in keys], axis=1)

    time = table.time if columns.time is None else column(columns.time.column) * TIME_UNITS[columns.time.unit]
    if time is None:
        raise SurefootError("has no clock of its own; the mapping must name the column of time")
    if not np.isfinite(time).all():
        raise SurefootError(f"time is not finite in row {int(np.argmin(np.isfinite(time)))}")
    if (run_column := _find_run_column(table, time)) is not None:
        first = table.columns[run_column][0]
        raise SurefootError(
            f"has several runs: time begins anew where {run_column} changes; choose one in the mapping, such as "
            f"rows: {{{run_column}: {first:g}}}"
        )
    check_rising(time)
    angle = ANGLE_UNITS[columns.unit]
    command = of_motors("command", angle, True)
    if motors[0].command is not None and not np.isfinite(command).all():
        row, motor = (int(k) for k in np.argwhere(~np.isfinite(command))[0])
        raise SurefootError(f"row {row} has no command of {robot.motor_names[motor]}; every row needs its command")
    return RecordedMotion(
        name,
        time,
        command,
        motor_angle=of_motors("angle", angle, True),
        motor_velocity=of_motors("velocity", angle),
        motor_torque=of_motors("torque"),
        roll_pitch_yaw=of_imu("roll", "pitch", "yaw"),
        angular_velocity_base=of_imu("roll_rate", "pitch_rate", "yaw_rate"),
    )


def _find_run_column(table: ColumnTable, time: Array) -> str | None:
    """Return the column that changes exactly in the rows in which time (T,) goes backwards; None, if there is none."""
    back = np.flatnonzero(np.diff(time) < 0.0)
    names = (name for name, column in table.columns.items() if np.array_equal(np.flatnonzero(np.diff(column)), back))
    return next(names, None) if len(back) else None
