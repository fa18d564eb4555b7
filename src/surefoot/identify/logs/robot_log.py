"""Commands and readings of a robot, row by row, from any recorder.

A row has the time at which a command was sent, the command, and the newest readings. Robots send readings at their own
rate: rows that come faster repeat a reading. A new reading was taken since the row before, at most as long ago as
readings are apart; the middle of this interval is taken as its time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.npz import read_npz
from surefoot.robot import RobotDescription
from surefoot.robot.params_file import ParamValue, param_table
from surefoot.task.trace import EpisodeTrace

MIN_MOTION = 0.02
"""Range of its commands [rad] from which a joint counts as moving."""
SKIPPED = 0.3
"""Time [s] at the start in which errors do not count: the robot's motion before the log is unknown."""
IMU = ("roll", "pitch", "roll_rate", "pitch_rate")
"""Channels of the IMU: angles [rad] of the base, yaw about z, then pitch, then roll, and rates [rad/s] in its frame."""
_MAX_ROWS = 5_000_000
_MAX_LENGTH = 3600.0
_MAX_ANGLE = 1e3


@dataclass(frozen=True, eq=False)
class RobotLog:
    """T rows of a robot with M motors; readings are NaN where they are missing."""

    name: str
    time: Array
    """When commands were sent (T,) [s]; times may repeat."""
    command: Array
    """Motor angles (T, M) [rad]."""
    read_time: Array
    """When readings were taken (T,) [s]."""
    motor_angle: Array
    """(T, M) [rad]"""
    imu: Array
    """Channels of `IMU` (T, 4)."""
    gains: dict[str, ParamValue] = field(default_factory=dict)
    """Gains that came with the commands, as physical parameters; none, if commands have angles alone."""

    def __post_init__(self) -> None:
        """Refuse too few rows, time that goes backwards, and commands that never move."""
        if not 2 <= len(self.time) <= _MAX_ROWS:
            raise SurefootError(f"has {len(self.time)} rows; a log has 2 to {_MAX_ROWS}")
        for name in ("time", "command"):
            if not np.isfinite(getattr(self, name)).all():
                raise SurefootError(f"{name} has values that are not finite; every row needs its time and command")
        check_rising(self.time)
        if self.time[-1] - self.time[0] > _MAX_LENGTH:
            raise SurefootError(f"is {self.time[-1] - self.time[0]:g} s long; at most {_MAX_LENGTH:g} s are replayed")
        if (most := float(np.abs(self.command).max())) > _MAX_ANGLE:
            raise SurefootError(f"has a command of {most:g} rad; angles are within {_MAX_ANGLE:g} rad")
        if not self.moving.any():
            raise SurefootError(f"its commands never move: no joint by {MIN_MOTION:g} rad; there is nothing to compare")

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Joints (M,) whose commands move."""
        return np.asarray(np.ptp(self.command, axis=0) > MIN_MOTION)

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Rows (T,) whose errors count."""
        return self.time >= self.time[0] + SKIPPED

    @property
    def fresh(self) -> NDArray[np.bool_]:
        """Rows (T,) that do not repeat the reading before."""
        return np.diff(self.read_time, prepend=-np.inf) > 0

    def timing(self) -> dict[str, float]:
        """Return the regularity of its times, as `measure_timing` does."""
        return measure_timing(self.time, self.read_time)

    def until(self, seconds: float) -> RobotLog:
        """Return the rows of the first seconds."""
        rows = self.time <= self.time[0] + seconds
        names = ("time", "command", "read_time", "motor_angle", "imu")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


def measure_timing(time: Array, read_time: Array) -> dict[str, float]:
    """Return the regularity of rows' times (T,): steps [s], and shares of repeated times and readings."""
    steps = np.diff(time)
    return {
        "rows": len(time),
        "seconds": float(time[-1] - time[0]),
        "least_step": float(steps.min()),
        "median_step": float(np.median(steps)),
        "greatest_step": float(steps.max()),
        "repeated_times": float(np.mean(steps == 0.0)),
        "repeated_readings": float(np.mean(np.diff(read_time, prepend=-np.inf) <= 0.0)),
    }


def check_rising(time: Array) -> None:
    """Refuse time (T,) [s] that goes backwards."""
    if (back := np.flatnonzero(np.diff(time) < 0.0)).size:
        first, then = time[back[0]], time[back[0] + 1]
        raise SurefootError(f"time goes backwards in row {back[0] + 1}, from {first:g} to {then:g} s")


def log_from_rows(name: str, time: Array, command: Array, motor_angle: Array, imu: Array) -> RobotLog:
    """Return a log whose readings are of their rows' time, or of an earlier row's that they repeat."""
    read = np.concatenate([motor_angle, imu], axis=1)
    new = np.flatnonzero([True, *np.any((np.diff(read, axis=0) != 0) & ~np.isnan(read[1:]), axis=1)])
    apart = float(np.median(np.diff(time[new]))) if len(new) > 1 else 0.0
    taken = time[new] - np.minimum(np.diff(time, prepend=time[:1])[new], apart) / 2
    return RobotLog(name, time, command, np.repeat(taken, np.diff([*new, len(time)])), motor_angle, imu)


def log_from_trace(name: str, trace: EpisodeTrace) -> RobotLog:
    """Return the log of a trace: imported ones row by row; of others each row's command was sent a row before.

    Of a trace in which targets are missing, it is the longest part with targets.

    Raises:
        SurefootError: fewer than two rows in a row with targets, or what `RobotLog` refuses.
    """
    imu = np.concatenate([trace.roll_pitch_yaw[:, :2], trace.angular_velocity_base[:, :2]], axis=1)
    if not trace.imported:
        sent = np.concatenate([[max(trace.time[0] - trace.meta["control_step"], 0.0)], trace.time[:-1]])
        return RobotLog(name, sent, trace.target, trace.time, trace.motor_angle, imu)
    rows = _longest(np.asarray(np.isfinite(trace.target).all(axis=1)))
    time, target, angle, imu = trace.time[rows], trace.target[rows], trace.motor_angle[rows], imu[rows]
    if len(time) < 2:
        raise SurefootError("has no two rows in a row with commands; a log to replay or to identify from has commands")
    log = log_from_rows(name, time, target, angle, imu)
    read_time = time if trace.meta.get("read_at_row") else log.read_time
    return replace(log, read_time=read_time, gains=param_table(trace.meta["params"], "meta.params"))


def _longest(rows: NDArray[np.bool_]) -> slice:
    """Return the longest run of rows (T,) that are true."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(np.int8), [0]]))).reshape(-1, 2)
    first, last = max(ends.tolist(), key=lambda part: part[1] - part[0], default=(0, 0))
    return slice(first, last)


def common_gains(logs: Iterable[RobotLog]) -> dict[str, ParamValue]:
    """Return the gains that came with the commands of logs.

    Raises:
        SurefootError: logs with different gains.
    """
    first, *others = logs
    for log in others:
        if log.gains != first.gains:
            raise SurefootError(f"logs {first.name} and {log.name} have commands with different gains; fit each alone")
    return first.gains


def read_log(path: Path, robot: RobotDescription) -> RobotLog:
    """Read a trace (.npz), or an .npz file with arrays `time` (T,), `command`, `motor_angle` (T, M) and `imu` (T, 4).

    `motor_angle` or `imu` may be missing.

    Raises:
        SurefootError: no such file, a damaged one, one with other arrays, of another robot, or refused by `RobotLog`.
    """
    with prefix_errors(f"log {path}"):
        arrays = read_npz(path)
        if "meta" in arrays:
            trace = EpisodeTrace.load(path)
            if trace.meta["robot"] != robot.name or tuple(trace.meta["motor_names"]) != robot.motor_names:
                raise SurefootError(f"is of robot '{trace.meta['robot']}', not of '{robot.name}' with its motors")
            return log_from_trace(path.name, trace)
        return _log_from_arrays(path.name, arrays, robot)


def _log_from_arrays(name: str, arrays: dict[str, NDArray[Any]], robot: RobotDescription) -> RobotLog:
    missing = [key for key in ("time", "command") if key not in arrays]
    if missing or not {"motor_angle", "imu"} & set(arrays):
        lacks = missing or ["motor_angle and imu"]
        raise SurefootError(
            f"has no {' and no '.join(lacks)}; a log has time, command, and motor_angle or imu. It has "
            f"{choices(sorted(arrays)[:20])}; with other names: surefoot identify import --map MAPPING.yaml"
        )
    steps, motors = np.shape(arrays["time"])[:1] or (0,), robot.num_motors
    shapes = {"time": steps, "command": (*steps, motors), "motor_angle": (*steps, motors), "imu": (*steps, len(IMU))}
    columns = {}
    for key, shape in shapes.items():
        array = arrays.get(key, np.full(shape, np.nan))
        if array.dtype.kind not in "iuf":
            raise SurefootError(f"{key} holds {array.dtype}; it must hold numbers")
        if array.shape != shape:
            rule = f"{robot.name} has {motors} motors" if key in ("command", "motor_angle") else "a row for each time"
            raise SurefootError(f"{key} has shape {array.shape}; it must have {shape}: {rule}")
        columns[key] = array.astype(float)
    return log_from_rows(name, **columns)
