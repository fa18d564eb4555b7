"""Import of third-party logs with a mapping from columns to motors and IMU.

    # mapping.yaml; only motors is required
    time: {column: time, unit: s}                # s, ms, us or ns; defaults to the recorder's own times of a bag
    unit: rad                                    # of angles: rad or deg; speeds are per second
    motors:                                      # every motor of the robot, in any order
      rightFrontLegMotor: {command: "command[0]", angle: "motor_angle[0]", sign: 1, offset: 0.0}
    imu: {roll: "imu[0]", pitch: "imu[1]", roll_rate: "imu[2]", pitch_rate: "imu[3]", unit: rad, sign: 1}
    rows: {episode_index: 3}                     # only rows with this value, of a file with several runs

Angle and command of a motor are sign x column + offset; `velocity` and `torque` may also be mapped. Readings without a
column are NaN. A log of states has no commands: its mapping leaves out `command` for every motor, and commands are NaN.
Times and rows are imported unchanged, even if they are uneven or repeated.
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
    """Column of times."""

    column: str
    unit: Literal["s", "ms", "us", "ns"] = "s"


@dataclass(frozen=True)
class MotorColumns:
    """Columns of one motor."""

    command: str | None = None
    """Column of commands; left out for every motor of a log of states."""
    angle: str | None = None
    velocity: str | None = None
    torque: str | None = None
    sign: Literal[-1, 1] = 1
    offset: float = 0.0
    """Offset added to angles and commands after unit and sign [rad]."""


@dataclass(frozen=True)
class ImuColumns:
    """Columns of the IMU: orientation of the base (yaw about z, pitch about y, then roll about x) and body rates."""

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
    """Mapping from the columns of a log to motors and IMU."""

    motors: dict[str, MotorColumns]
    time: TimeColumn | None = None
    unit: Literal["rad", "deg"] = "rad"
    imu: ImuColumns = field(default_factory=ImuColumns)
    rows: dict[str, float] = field(default_factory=dict)
    """Values of columns in the rows that are taken; all rows, if left out."""


def default_mapping(robot: RobotDescription) -> LogMapping:
    """Return the mapping of a file with arrays time, command, motor_angle and imu, with motors in the robot's order."""
    motors = {name: MotorColumns(f"command[{k}]", f"motor_angle[{k}]") for k, name in enumerate(robot.motor_names)}
    return LogMapping(motors, TimeColumn("time"), imu=ImuColumns("imu[0]", "imu[1]", None, "imu[2]", "imu[3]"))


def import_log(
    path: Path, robot: RobotDescription, mapping: Path | None = None, any_checksum: bool = False
) -> RecordedMotion:
    """Read a third-party log as recorded motion.

    Args:
        path: NPZ, CSV, pickle, torch, Parquet or MCAP file, or folder or file of a ROS bag.
        robot: robot that was logged.
        mapping: YAML file with the mapping. Defaults to `default_mapping`, except for bags and CSV files with Go2
            messages, which need none.
        any_checksum: whether to accept Go2 messages with a wrong checksum.

    Raises:
        SurefootError: the file can't be read, the mapping does not fit the robot or the file, time goes backwards, or
            some rows of a log with commands have none.
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
                raise SurefootError(f"motors lacks {choices(missing)}; it must name every motor of the robot")
            _check_commands(columns)
    with prefix_errors(f"log {path}"):
        return _motion(read_table(path).where(columns.rows), columns, robot, mapping is None, path.name)


def _check_commands(columns: LogMapping) -> None:
    """Reject a mapping with commands for some motors only, or with motors that have neither command nor angle."""
    without = [name for name, motor in columns.motors.items() if motor.command is None]
    if without and len(without) < len(columns.motors):
        raise SurefootError(
            f"motors.{without[0]} has no command, but other motors have one; add it, or leave out command for all "
            "motors if this is a log of states"
        )
    for name, motor in columns.motors.items():
        if motor.command is None and motor.angle is None:
            raise SurefootError(f"motors.{name} has neither command nor angle; it needs at least one")
        if motor.command == motor.angle:
            raise SurefootError(f"motors.{name}: command and angle are both '{motor.command}'; they are two columns")


def _motion(
    table: ColumnTable, columns: LogMapping, robot: RobotDescription, default: bool, name: str
) -> RecordedMotion:
    motors = [columns.motors[key] for key in robot.motor_names]
    if default and (extra := f"command[{robot.num_motors}]") in table.columns:
        raise SurefootError(f"has a column '{extra}'; {robot.name} has {robot.num_motors} motors")
    missing = np.full(table.rows, np.nan)

    def column(key: str | None, optional: bool = False) -> Array:
        return missing if key is None or (optional and key not in table.columns) else table.column(key)

    def motor_columns(key: str, unit: float = 1.0, offset: bool = False) -> Array:
        optional = default and key != "command"
        return np.stack(
            [column(getattr(m, key), optional) * (m.sign * unit) + (m.offset if offset else 0.0) for m in motors],
            axis=1,
        )

    def imu_columns(*keys: str) -> Array:
        factor = columns.imu.sign * ANGLE_UNITS[columns.imu.unit]
        return np.stack([column(getattr(columns.imu, key), default) * factor for key in keys], axis=1)

    time = table.time if columns.time is None else column(columns.time.column) * TIME_UNITS[columns.time.unit]
    if table.rows < 2:
        raise SurefootError(f"has {table.rows} rows; a log has 2 or more")
    if time is None:
        raise SurefootError("has no time stamps of its own; the mapping must name the column of time")
    if not np.isfinite(time).all():
        raise SurefootError(f"time is not finite in row {int(np.argmin(np.isfinite(time)))}")
    if (run_column := _find_run_column(table, time)) is not None:
        first = table.columns[run_column][0]
        raise SurefootError(
            f"has several runs: time starts again where {run_column} changes; choose one in the mapping, such as "
            f"rows: {{{run_column}: {first:g}}}"
        )
    check_rising(time)
    angle = ANGLE_UNITS[columns.unit]
    command, first = motor_columns("command", angle, True), 0
    if table.time is not None and (whole := np.isfinite(command).all(axis=1)).any():
        first = int(np.argmax(whole))  # a bag begins before the first command
        if table.rows - first < 2:
            raise SurefootError("has a command in the last row only; a log has 2 or more rows with commands")
    if motors[0].command is not None and not np.isfinite(command[first:]).all():
        row, motor = (int(k) for k in np.argwhere(~np.isfinite(command[first:]))[0])
        joint = robot.motor_names[motor]
        raise SurefootError(f"row {first + row} has no command for {joint}; every row needs a command")
    motion = RecordedMotion(
        name,
        time,
        command,
        motor_angle=motor_columns("angle", angle, True),
        motor_velocity=motor_columns("velocity", angle),
        motor_torque=motor_columns("torque"),
        roll_pitch_yaw=imu_columns("roll", "pitch", "yaw"),
        angular_velocity_base=imu_columns("roll_rate", "pitch_rate", "yaw_rate"),
        meta={"notes": [f"{first} messages before the first command are left out"]} if first else {},
    )
    return motion.rows(slice(first, None))


def _find_run_column(table: ColumnTable, time: Array) -> str | None:
    """Return the column that changes exactly in the rows in which time (T,) goes backwards; None, if there is none."""
    back = np.flatnonzero(np.diff(time) < 0.0)
    names = (name for name, column in table.columns.items() if np.array_equal(np.flatnonzero(np.diff(column)), back))
    return next(names, None) if len(back) else None
