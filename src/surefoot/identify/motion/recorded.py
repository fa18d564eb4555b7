"""Recorded motion of a robot: rows of commands and readings, from any recorder.

Each row holds a command and the time at which it was sent, and the newest readings and the time at which they were
taken. Everything except the times may be missing. Recorders differ in the time of readings:

- A deployment of surefoot reads at the end of a control step, whose command was sent in the previous row.
- Third-party logs state only the row of a reading. A robot sends readings at its own rate, so faster rows repeat a
  reading. A new reading was taken after the previous row, and not longer ago than the interval between readings; the
  middle of this time span is used.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, prefix_errors
from surefoot.robot.params_file import ParamValue

MIN_MOTION = 0.02
"""Range of the commands [rad] above which a joint counts as moving."""
SKIPPED_TIME = 0.3
"""Time [s] at the start that is not evaluated, because the robot's motion before the log is unknown."""
IMU = ("roll", "pitch", "roll_rate", "pitch_rate")
"""Channels of `RecordedMotion.imu`: roll and pitch of the base [rad] (yaw about z, then pitch, then roll), and its
rates about x and y in the base frame [rad/s]."""
COMPUTED_SPREAD = 1e-3
"""Range of the time steps, relative to their median, below which times count as computed: rounding to float32 causes
less, the jitter of a real clock more."""
MIN_STEPS = 20
"""Minimum number of steps to distinguish a computed clock from a measured one."""
_MAX_ROWS = 5_000_000
_MAX_LENGTH = 3600.0
_MAX_ANGLE = 1e3


def _absent() -> Array:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """Recorded motion of a robot with M motors in T rows; missing channels and readings are NaN."""

    name: str
    """Name of the log."""
    time: Array
    """Time of sending each command (T,) [s]; times may repeat."""
    command: Array
    """Commanded motor angles (T, M) [rad]."""
    read_time: Array = field(default_factory=_absent)
    """Time at which readings were taken (T,) [s]. Defaults to `reading_times`."""
    motor_angle: Array = field(default_factory=_absent)
    """(T, M) [rad]"""
    motor_velocity: Array = field(default_factory=_absent)
    """(T, M) [rad/s]"""
    motor_torque: Array = field(default_factory=_absent)
    """(T, M) [N m]"""
    roll_pitch_yaw: Array = field(default_factory=_absent)
    """(T, 3) [rad], as measured by the IMU"""
    angular_velocity_base: Array = field(default_factory=_absent)
    """(T, 3) [rad/s], in the base frame"""
    rack: bool = False
    """Whether the robot hung with its base held still."""
    gains: dict[str, ParamValue] = field(default_factory=dict)
    """Gains sent with the commands, as physical parameters; empty if commands consist of angles only."""
    meta: dict[str, Any] = field(default_factory=dict)
    """Other metadata of the recorder: control_step and lead [s], missed_steps, date, notes, clock (whose it is)."""

    def __post_init__(self) -> None:
        """Fill absent channels with NaN, and absent reading times with their default."""
        motors = np.shape(self.command)
        widths = dict.fromkeys(("motor_angle", "motor_velocity", "motor_torque"), motors)
        widths |= dict.fromkeys(("roll_pitch_yaw", "angular_velocity_base"), (len(self.time), 3))
        for name, shape in widths.items():
            if not np.size(getattr(self, name)):
                object.__setattr__(self, name, np.full(shape, np.nan))
        if len(self.time) and not np.size(self.read_time):
            object.__setattr__(self, "read_time", reading_times(self.time, self.motor_angle, self.imu))

    @property
    def control_step(self) -> float:
        """Time between two rows [s]: as stated by the recorder, else the median of the nonzero steps."""
        steps = np.diff(self.time)
        return float(self.meta.get("control_step") or (np.median(steps[steps > 0]) if (steps > 0).any() else 1.0))

    @property
    def imu(self) -> Array:
        """Channels of `IMU` (T, 4)."""
        return np.concatenate([self.roll_pitch_yaw[:, :2], self.angular_velocity_base[:, :2]], axis=1)

    @property
    def moving_joints(self) -> NDArray[np.bool_]:
        """Mask (M,) of the joints whose command moves."""
        return np.asarray(np.ptp(self.command, axis=0) > MIN_MOTION)

    @property
    def evaluated_rows(self) -> NDArray[np.bool_]:
        """Mask (T,) of the rows whose errors are evaluated."""
        return self.time >= self.time[0] + SKIPPED_TIME

    @property
    def has_new_reading(self) -> NDArray[np.bool_]:
        """Mask (T,) of the rows with a new reading, which do not repeat the previous one."""
        return np.diff(self.read_time, prepend=-np.inf) > 0

    @property
    def read_at_row(self) -> bool:
        """Whether readings were taken exactly at the times of rows."""
        return np.array_equal(self.read_time, self.time)

    @property
    def computed_clock(self) -> bool:
        """Whether the times look computed: all steps are equal within 0.1 %, as no measured clock has them.

        A log that states its clock is taken at its word.
        """
        if self.meta.get("clock"):
            return False
        steps = np.diff(self.time)
        return len(steps) > MIN_STEPS and float(np.ptp(steps)) < COMPUTED_SPREAD * max(float(np.median(steps)), 1e-9)

    @property
    def command_interval(self) -> float:
        """Median time between changes of the command [s]; 0 if commands change in most rows or never."""
        changes = np.flatnonzero(np.any(np.diff(self.command, axis=0) != 0, axis=1))
        if len(changes) < MIN_STEPS or np.median(np.diff(changes)) < 2:
            return 0.0
        return float(np.median(np.diff(self.time[changes])))

    def missing(self) -> list[str]:
        """Return the names of the readings that are missing in all rows."""
        names = ("motor_angle", "motor_velocity", "motor_torque", "roll_pitch_yaw", "angular_velocity_base")
        return [name for name in names if not np.isfinite(getattr(self, name)).any()]

    def timing(self) -> dict[str, float]:
        """Return statistics of the times: steps [s], and fractions of repeated times and readings."""
        steps = np.diff(self.time)
        return {
            "rows": len(self.time),
            "seconds": float(self.time[-1] - self.time[0]),
            "least_step": float(steps.min()),
            "median_step": float(np.median(steps)),
            "greatest_step": float(steps.max()),
            "repeated_times": float(np.mean(steps == 0.0)),
            "repeated_readings": float(np.mean(~self.has_new_reading)),
        }

    def first_seconds(self, seconds: float) -> RecordedMotion:
        """Return the rows of the first seconds.

        Raises:
            SurefootError: these rows can't be replayed.
        """
        with prefix_errors(f"log {self.name}, first {seconds:g} s"):
            return self.rows(self.time <= self.time[0] + seconds).require_replayable()

    def from_first_motion(self) -> RecordedMotion:
        """Return the rows from shortly before the commands begin to move, by `SKIPPED_TIME`."""
        moved = np.abs(self.command - self.command[0]).max(axis=1) > MIN_MOTION
        return self.rows(self.time >= self.time[np.argmax(moved)] - SKIPPED_TIME)

    def rows(self, rows: NDArray[np.bool_] | slice) -> RecordedMotion:
        """Return the selected rows."""
        arrays: dict[str, Any] = {
            name: value[rows] for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return replace(self, **arrays)

    def crop(self, start: float, end: float) -> RecordedMotion:
        """Return the rows from `start` to `end` [s] after the first row.

        Raises:
            SurefootError: fewer than two rows.
        """
        after = self.time - self.time[0]
        rows = (after >= start) & (after <= end)
        if (count := int(rows.sum())) < 2:
            raise SurefootError(f"--between {start:g} {end:g} has {count} rows; the log is {after[-1]:g} s long")
        return replace(self.rows(rows), meta={**self.meta, "control_step": self.control_step})

    def require_replayable(self) -> RecordedMotion:
        """Return the motion itself if its commands can be replayed.

        Raises:
            SurefootError: there are too few rows, time goes backwards, or commands are missing or never move.
        """
        if not 2 <= len(self.time) <= _MAX_ROWS:
            raise SurefootError(f"has {len(self.time)} rows; a log has 2 to {_MAX_ROWS}")
        for name in ("time", "command"):
            if not np.isfinite(getattr(self, name)).all():
                raise SurefootError(f"{name} has values that are not finite; every row needs a time and a command")
        check_rising(self.time)
        if self.time[-1] - self.time[0] > _MAX_LENGTH:
            raise SurefootError(f"is {self.time[-1] - self.time[0]:g} s long; at most {_MAX_LENGTH:g} s are replayed")
        if (largest := float(np.abs(self.command).max())) > _MAX_ANGLE:
            raise SurefootError(f"has a command of {largest:g} rad; angles must be within {_MAX_ANGLE:g} rad")
        if not self.moving_joints.any():
            raise SurefootError(
                f"no command moves a joint by more than {MIN_MOTION:g} rad; there is nothing to compare"
            )
        return self


def check_rising(time: Array) -> None:
    """Reject times (T,) [s] that go backwards."""
    if (decreases := np.flatnonzero(np.diff(time) < 0.0)).size:
        before, after = time[decreases[0]], time[decreases[0] + 1]
        raise SurefootError(f"time goes backwards in row {decreases[0] + 1}, from {before:g} to {after:g} s")


def reading_times(time: Array, *readings: Array) -> Array:
    """Return the estimated time (T,) [s] at which the readings (T, n) of each row were taken; see the module."""
    read = np.concatenate(readings, axis=1)
    new = np.flatnonzero([True, *np.any((np.diff(read, axis=0) != 0) & ~np.isnan(read[1:]), axis=1)])
    interval = float(np.median(np.diff(time[new]))) if len(new) > 1 else 0.0
    read_time = time[new] - np.minimum(np.diff(time, prepend=time[:1])[new], interval) / 2
    return np.repeat(read_time, np.diff([*new, len(time)]))


def common_gains(motions: Iterable[RecordedMotion]) -> dict[str, ParamValue]:
    """Return the gains that were sent with the commands of all logs.

    Raises:
        SurefootError: the gains of the logs differ.
    """
    first, *others = motions
    for motion in others:
        if motion.gains != first.gains:
            raise SurefootError(
                f"logs {first.name} and {motion.name} have commands with different gains; fit them separately"
            )
    return first.gains
