"""Logs of other people as traces, by a mapping that says which column is what.

    # mapping.yaml; all but motors may be left out
    time: {column: time, unit: s}                # s, ms, us, ns; the recorder's own times of a bag, if left out
    unit: rad                                    # of angles: rad or deg; speeds are these per second
    motors:                                      # for each motor of the robot, in any order
      rightFrontLegMotor: {command: "command[0]", angle: "motor_angle[0]", sign: 1, offset: 0.0}
    imu: {roll: "imu[0]", pitch: "imu[1]", roll_rate: "imu[2]", pitch_rate: "imu[3]", unit: rad, sign: 1}

A motor's angle is sign x column + offset, its command too; `velocity` and `torque` may be given beside them. What has
no column is missing in the trace: NaN. Times and rows stay as they are, uneven and repeated ones too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import from_mapping, read_yaml
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.identify.logs.table import Table, read_table
from surefoot.robot import RobotDescription
from surefoot.task.trace import LOG, EpisodeTrace

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
ANGLE_UNITS = {"rad": 1.0, "deg": float(np.pi / 180)}
_SHOWN = 30


@dataclass(frozen=True)
class TimeColumn:
    """The clock."""

    column: str
    unit: Literal["s", "ms", "us", "ns"] = "s"


@dataclass(frozen=True)
class MotorColumns:
    """The columns of one motor."""

    command: str
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
    """What stands in which column."""

    motors: dict[str, Any]
    time: TimeColumn | None = None
    unit: Literal["rad", "deg"] = "rad"
    imu: ImuColumns = field(default_factory=ImuColumns)


def usual_mapping(robot: RobotDescription) -> LogMapping:
    """Return the mapping of a file with arrays time, command, motor_angle and imu, all in the robot's own order."""
    motors = {
        name: {"command": f"command[{k}]", "angle": f"motor_angle[{k}]"} for k, name in enumerate(robot.motor_names)
    }
    imu = ImuColumns("imu[0]", "imu[1]", None, "imu[2]", "imu[3]")
    return LogMapping(motors, TimeColumn("time"), imu=imu)


def import_log(path: Path, robot: RobotDescription, mapping: Path | None = None) -> EpisodeTrace:
    """Return somebody's log as a trace.

    Args:
        path: NPZ, CSV, pickle, MCAP, or folder or file of a ROS bag.
        robot: whose log it is.
        mapping: YAML file; arrays have the usual names and the robot's order, if not given.

    Raises:
        SurefootError: a file that can't be read, a mapping that does not fit the robot or the file, time that goes
            backwards, or commands that are missing in a row.
    """
    if mapping is None:
        columns = usual_mapping(robot)
    else:
        data = read_yaml(mapping)
        with prefix_errors(mapping):
            columns = from_mapping(LogMapping, data)
            _check_motors(columns, robot)
    with prefix_errors(f"log {path}"):
        return _trace(read_table(path), columns, robot, mapping is None, path.name)


def _check_motors(columns: LogMapping, robot: RobotDescription) -> None:
    for name in columns.motors:
        if name not in robot.motor_names:
            raise SurefootError(
                f"motors names '{name}', which {robot.name} does not have; it has {choices(robot.motor_names)}"
            )
    if missing := [name for name in robot.motor_names if name not in columns.motors]:
        raise SurefootError(f"motors lacks {choices(missing)}; every motor has a command")


def _trace(table: Table, columns: LogMapping, robot: RobotDescription, usual: bool, name: str) -> EpisodeTrace:
    motors = {key: from_mapping(MotorColumns, value, f"motors.{key}") for key, value in columns.motors.items()}
    if usual and (extra := f"command[{robot.num_motors}]") in table.columns:
        raise SurefootError(f"has a column '{extra}'; {robot.name} has {robot.num_motors} motors")

    def column(key: str, optional: bool = False) -> Array:
        if key in table.columns:
            return table.columns[key]
        if optional:
            return np.full(table.rows, np.nan)
        raise SurefootError(f"has no column '{key}'; columns: {choices(list(table.columns)[:_SHOWN])}")

    time = table.time if columns.time is None else column(columns.time.column) * TIME_UNITS[columns.time.unit]
    if time is None:
        raise SurefootError("has no clock of its own; the mapping must say which column is time")
    if not np.isfinite(time).all():
        raise SurefootError(f"time is not finite in row {int(np.argmin(np.isfinite(time)))}")
    if (back := np.flatnonzero(np.diff(time) < 0)).size:
        raise SurefootError(
            f"time goes backwards in row {back[0] + 1}, from {time[back[0]]:g} to {time[back[0] + 1]:g} s"
        )
    steps, count, scale = table.rows, robot.num_motors, ANGLE_UNITS[columns.unit]

    def of_motors(key: str, offset: bool) -> Array:
        values = np.full((steps, count), np.nan)
        for place, motor in enumerate(robot.motor_names):
            what = motors[motor]
            if (source := getattr(what, key)) is not None:
                factor = what.sign * (1.0 if key == "torque" else scale)
                values[:, place] = column(source, usual and key != "command") * factor + (
                    what.offset if offset else 0.0
                )
        return values

    def of_imu(*keys: str) -> Array:
        sources = [getattr(columns.imu, key) for key in keys]
        factor = columns.imu.sign * ANGLE_UNITS[columns.imu.unit]
        return np.stack([np.full(steps, np.nan) if s is None else column(s, usual) * factor for s in sources], axis=1)

    command = of_motors("command", True)
    if not np.isfinite(command).all():
        row, motor = (int(k) for k in np.argwhere(~np.isfinite(command))[0])
        raise SurefootError(f"row {row} has no command of {robot.motor_names[motor]}; every row needs its command")
    gaps = np.diff(time)
    step = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0

    def unknown(*shape: int) -> Array:
        return np.full(shape, np.nan)

    return EpisodeTrace(
        time=time,
        base_position_world=unknown(steps + 1, 3),
        base_quat_world=unknown(steps + 1, 4),
        roll_pitch_yaw=of_imu("roll", "pitch", "yaw"),
        angular_velocity_base=of_imu("roll_rate", "pitch_rate", "yaw_rate"),
        motor_angle=of_motors("angle", True),
        motor_velocity=of_motors("velocity", False),
        motor_torque=of_motors("torque", False),
        observation=np.empty((steps, 0)),
        feedback=unknown(steps, 2 * len(robot.legs)),
        target=command,
        energy=unknown(steps),
        foot_contact=unknown(steps, len(robot.legs)),
        meta={
            "robot": robot.name,
            "world": LOG,
            "control_step": step,
            "leg_names": robot.leg_names,
            "motor_names": robot.motor_names,
            "observation_names": [],
            "ended": "time",
            "max_steps": steps,
            "source": name,
        },
    )


def missing_columns(trace: EpisodeTrace) -> list[str]:
    """Return the readings that an imported trace does not have at all."""
    names = ("motor_angle", "motor_velocity", "motor_torque", "roll_pitch_yaw", "angular_velocity_base")
    return [name for name in names if not np.isfinite(getattr(trace, name)).any()]
