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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot.params_file import ParamValue

MIN_MOTION = 0.02
"""Range of its commands [rad] from which a joint counts as moving."""
SKIPPED = 0.3
"""Time [s] at the start in which errors do not count: the robot's motion before the log is unknown."""
IMU = ("roll", "pitch", "roll_rate", "pitch_rate")
"""Channels of `RecordedMotion.imu`: angles [rad] of the base, yaw about z, then pitch, then roll, and rates [rad/s] in
its frame."""
COMPUTED = 1e-3
"""Spread of the steps of times that were computed, relative to their median: float32 rounds, clocks jitter more."""
MIN_STEPS = 20
"""Steps that tell a computed clock from a measured one."""
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
    read_time: Array = field(default_factory=_absent)
    """When readings were taken (T,) [s]; as of `reading_times`, if left out."""
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
    """What else the recorder states: control_step and lead [s], missed_steps, date, notes, clock (whose it was)."""

    def __post_init__(self) -> None:
        """Fill absent channels."""
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

    @property
    def computed_clock(self) -> bool:
        """Whether its times look computed, if nothing states whose they are: all steps are the same to a thousandth."""
        if self.meta.get("clock"):
            return False
        steps = np.diff(self.time)
        return len(steps) > MIN_STEPS and float(np.ptp(steps)) < COMPUTED * max(float(np.median(steps)), 1e-9)

    @property
    def command_interval(self) -> float:
        """Median time between rows that change the command [s]; 0, if commands change in most rows or never."""
        changes = np.flatnonzero(np.any(np.diff(self.command, axis=0) != 0, axis=1))
        if len(changes) < MIN_STEPS or np.median(np.diff(changes)) < 2:
            return 0.0
        return float(np.median(np.diff(self.time[changes])))

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
