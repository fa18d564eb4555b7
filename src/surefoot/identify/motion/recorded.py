"""Recorded motion of a robot: commands and readings row by row, whoever recorded them.

A row has the time at which a command was sent, the command, and the newest readings with the time at which they were
taken. Everything but the times may be missing. Two recorders differ in these times:

- A deployment takes the readings at the end of a control step, for which the row before has sent the command.
- Of other logs readings are known by row. Robots send readings at their own rate: rows that come faster repeat a
  reading. A new reading was taken since the row before, at most as long ago as readings are apart; the middle of this
  interval is taken as its time.
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
from surefoot.task.trace import LOG, EpisodeTrace

MIN_MOTION = 0.02
"""Range of its commands [rad] from which a joint counts as moving."""
SKIPPED = 0.3
"""Time [s] at the start in which errors do not count: the robot's motion before the log is unknown."""
IMU = ("roll", "pitch", "roll_rate", "pitch_rate")
"""Channels of `RecordedMotion.imu`: angles [rad] of the base, yaw about z, then pitch, then roll, and rates [rad/s] in
its frame."""
_MAX_ROWS = 5_000_000
_MAX_LENGTH = 3600.0
_MAX_ANGLE = 1e3


def _absent() -> Array:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """T rows of a robot with M motors; channels that are left out, and readings that are missing, are NaN."""

    name: str
    time: Array
    """When commands were sent (T,) [s]; times may repeat."""
    command: Array
    """Motor angles (T, M) [rad]."""
    read_time: Array
    """When readings were taken (T,) [s]."""
    motor_angle: Array = field(default_factory=_absent)
    """(T, M) [rad]"""
    motor_velocity: Array = field(default_factory=_absent)
    """(T, M) [rad/s]"""
    motor_torque: Array = field(default_factory=_absent)
    """(T, M) [N m]"""
    roll_pitch_yaw: Array = field(default_factory=_absent)
    """(T, 3) [rad], as the IMU measured it."""
    angular_velocity_base: Array = field(default_factory=_absent)
    """(T, 3) [rad/s] in the base frame."""
    rack: bool = False
    """Whether the robot hung with its base held still."""
    gains: dict[str, ParamValue] = field(default_factory=dict)
    """Gains that came with the commands, as physical parameters; none, if commands have angles alone."""
    meta: dict[str, Any] = field(default_factory=dict)
    """What else the recorder states: control_step and lead [s], missed_steps, date, notes."""

    def __post_init__(self) -> None:
        """Fill absent channels with NaN."""
        motors = np.shape(self.command)
        widths = dict.fromkeys(("motor_angle", "motor_velocity", "motor_torque"), motors)
        widths |= dict.fromkeys(("roll_pitch_yaw", "angular_velocity_base"), (len(self.time), 3))
        for name, shape in widths.items():
            if not np.size(getattr(self, name)):
                object.__setattr__(self, name, np.full(shape, np.nan))

    @property
    def control_step(self) -> float:
        """Time between two rows [s]: as stated, else the median of those that differ."""
        steps = np.diff(self.time)
        return float(self.meta.get("control_step") or (np.median(steps[steps > 0]) if (steps > 0).any() else 1.0))

    @property
    def imu(self) -> Array:
        """Channels of `IMU` (T, 4)."""
        return np.concatenate([self.roll_pitch_yaw[:, :2], self.angular_velocity_base[:, :2]], axis=1)

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

    @property
    def read_at_row(self) -> bool:
        """Whether readings were taken exactly at the times of rows."""
        return np.array_equal(self.read_time, self.time)

    def missing(self) -> list[str]:
        """Return the names of the readings that are missing in every row."""
        names = ("motor_angle", "motor_velocity", "motor_torque", "roll_pitch_yaw", "angular_velocity_base")
        return [name for name in names if not np.isfinite(getattr(self, name)).any()]

    def timing(self) -> dict[str, float]:
        """Return the regularity of its times: steps [s], and shares of repeated times and readings."""
        steps = np.diff(self.time)
        return {
            "rows": len(self.time),
            "seconds": float(self.time[-1] - self.time[0]),
            "least_step": float(steps.min()),
            "median_step": float(np.median(steps)),
            "greatest_step": float(steps.max()),
            "repeated_times": float(np.mean(steps == 0.0)),
            "repeated_readings": float(np.mean(~self.fresh)),
        }

    def until(self, seconds: float) -> RecordedMotion:
        """Return the rows of the first seconds, which must be commands to replay."""
        return self.rows(self.time <= self.time[0] + seconds).checked()

    def rows(self, rows: NDArray[np.bool_] | slice) -> RecordedMotion:
        """Return some of the rows."""
        arrays: dict[str, Any] = {
            name: value[rows] for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return replace(self, **arrays)

    def between(self, start: float, end: float) -> RecordedMotion:
        """Return the rows from `start` to `end` [s] after the first row.

        Raises:
            SurefootError: fewer than two rows.
        """
        after = self.time - self.time[0]
        rows = (after >= start) & (after <= end)
        if (count := int(rows.sum())) < 2:
            raise SurefootError(f"--between {start:g} {end:g} has {count} rows; the log is {after[-1]:g} s long")
        return replace(self.rows(rows), meta={**self.meta, "control_step": self.control_step})

    def checked(self) -> RecordedMotion:
        """Return the motion itself, once its commands are found to be ones that can be replayed.

        Raises:
            SurefootError: too few rows, time that goes backwards, commands that are missing or never move.
        """
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
        return self

    def as_trace(self, robot: RobotDescription) -> EpisodeTrace:
        """Return the rows of a log as a trace of the world `LOG`; what nobody recorded is NaN.

        Raises:
            SurefootError: numbers that a trace does not take, such as infinite ones.
        """
        steps, legs, step = len(self.time), len(robot.legs), self.control_step
        power = np.abs(np.sum(self.motor_torque * self.motor_velocity, axis=1))
        return EpisodeTrace(
            time=self.time,
            base_position_world=np.full((steps + 1, 3), np.nan),
            base_quat_world=np.full((steps + 1, 4), np.nan),
            roll_pitch_yaw=self.roll_pitch_yaw,
            angular_velocity_base=self.angular_velocity_base,
            motor_angle=self.motor_angle,
            motor_velocity=self.motor_velocity,
            motor_torque=self.motor_torque,
            observation=np.empty((steps, 0)),
            feedback=np.full((steps, 2 * legs), np.nan),
            target=self.command,
            energy=power * np.diff(self.time, prepend=self.time[:1] - step),
            foot_contact=np.full((steps, legs), np.nan),
            meta={
                "robot": robot.name,
                "world": LOG,
                "leg_names": robot.leg_names,
                "motor_names": robot.motor_names,
                "observation_names": [],
                "ended": "time",
                "max_steps": round(float(np.ptp(self.time)) / step) + 1,
                "source": self.name,
                "params": self.gains,
                **({"read_at_row": True} if self.read_at_row else {}),
                **self.meta,
                "control_step": step,
            },
            robot_archive=robot.archive,
        )


def check_rising(time: Array) -> None:
    """Refuse time (T,) [s] that goes backwards."""
    if (back := np.flatnonzero(np.diff(time) < 0.0)).size:
        first, then = time[back[0]], time[back[0] + 1]
        raise SurefootError(f"time goes backwards in row {back[0] + 1}, from {first:g} to {then:g} s")


def reading_times(time: Array, *readings: Array) -> Array:
    """Return when readings (T, n) were taken (T,) [s]: in their row, or in an earlier row whose reading they repeat."""
    read = np.concatenate(readings, axis=1)
    new = np.flatnonzero([True, *np.any((np.diff(read, axis=0) != 0) & ~np.isnan(read[1:]), axis=1)])
    apart = float(np.median(np.diff(time[new]))) if len(new) > 1 else 0.0
    taken = time[new] - np.minimum(np.diff(time, prepend=time[:1])[new], apart) / 2
    return np.repeat(taken, np.diff([*new, len(time)]))


def deployed_motion(name: str, trace: EpisodeTrace) -> RecordedMotion:
    """Return the motion of a trace that surefoot recorded: each row's command was sent a row before."""
    sent = np.concatenate([[max(trace.time[0] - trace.meta["control_step"], 0.0)], trace.time[:-1]])
    return _motion(name, trace, sent, trace.time)


def motion_from_trace(name: str, trace: EpisodeTrace) -> RecordedMotion:
    """Return the motion of a trace, to be replayed; of an imported one the longest part with targets.

    Raises:
        SurefootError: fewer than two rows in a row with targets, or what `RecordedMotion.checked` refuses.
    """
    if not trace.imported:
        return deployed_motion(name, trace).checked()
    motion = _motion(name, trace, trace.time, trace.time)
    motion = motion.rows(_longest(np.asarray(np.isfinite(trace.target).all(axis=1))))
    if len(motion.time) < 2:
        raise SurefootError("has no two rows in a row with commands; a log to replay or to identify from has commands")
    if not trace.meta.get("read_at_row"):
        motion = replace(motion, read_time=reading_times(motion.time, motion.motor_angle, motion.imu))
    return replace(motion, gains=param_table(trace.meta["params"], "meta.params")).checked()


def _motion(name: str, trace: EpisodeTrace, sent: Array, read: Array) -> RecordedMotion:
    readings = trace.motor_angle, trace.motor_velocity, trace.motor_torque
    attitude = trace.roll_pitch_yaw, trace.angular_velocity_base
    return RecordedMotion(name, sent, trace.target, read, *readings, *attitude, meta=trace.meta)


def _longest(rows: NDArray[np.bool_]) -> slice:
    """Return the longest run of rows (T,) that are true."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(np.int8), [0]]))).reshape(-1, 2)
    first, last = max(ends.tolist(), key=lambda part: part[1] - part[0], default=(0, 0))
    return slice(first, last)


def common_gains(motions: Iterable[RecordedMotion]) -> dict[str, ParamValue]:
    """Return the gains that came with the commands of logs.

    Raises:
        SurefootError: logs with different gains.
    """
    first, *others = motions
    for motion in others:
        if motion.gains != first.gains:
            raise SurefootError(
                f"logs {first.name} and {motion.name} have commands with different gains; fit each alone"
            )
    return first.gains


def read_motion(path: Path, robot: RobotDescription) -> RecordedMotion:
    """Read a trace (.npz), or an .npz file with arrays `time` (T,), `command`, `motor_angle` (T, M) and `imu` (T, 4).

    `motor_angle` or `imu` may be missing.

    Raises:
        SurefootError: no such file, a damaged one, one with other arrays, of another robot, or one that can't be
            replayed.
    """
    with prefix_errors(f"log {path}"):
        arrays = read_npz(path)
        if "meta" in arrays:
            trace = EpisodeTrace.load(path)
            if trace.meta["robot"] != robot.name or tuple(trace.meta["motor_names"]) != robot.motor_names:
                raise SurefootError(f"is of robot '{trace.meta['robot']}', not of '{robot.name}' with its motors")
            return motion_from_trace(path.name, trace)
        return _motion_from_arrays(path.name, arrays, robot)


def _motion_from_arrays(name: str, arrays: dict[str, NDArray[Any]], robot: RobotDescription) -> RecordedMotion:
    missing = [key for key in ("time", "command") if key not in arrays]
    if missing or not {"motor_angle", "imu"} & set(arrays):
        lacks = missing or ["motor_angle and imu"]
        raise SurefootError(
            f"has no {' and no '.join(lacks)}; a log has time, command, and motor_angle or imu. It has "
            f"{choices(sorted(arrays)[:20])}; with other names: surefoot trace import --map MAPPING.yaml"
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
    return motion_from_rows(name, **columns).checked()


def motion_from_rows(name: str, time: Array, command: Array, motor_angle: Array, imu: Array) -> RecordedMotion:
    """Return the motion of a log's rows, with the channels of `IMU` (T, 4)."""
    attitude, rates = (np.pad(part, ((0, 0), (0, 1)), constant_values=np.nan) for part in (imu[:, :2], imu[:, 2:]))
    read = reading_times(time, motor_angle, imu)
    return RecordedMotion(name, time, command, read, motor_angle, roll_pitch_yaw=attitude, angular_velocity_base=rates)
