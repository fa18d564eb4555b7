"""How far simulated robots are from a log that they replay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.logs.robot_log import IMU, SKIPPED, RobotLog
from surefoot.identify.replay import ReplayedReadings, Replayer, segment_from_log
from surefoot.robot import PhysicalParams, RobotDescription


@dataclass(frozen=True)
class LogErrors:
    """Simulated less recorded, over the rows of a log."""

    log: RobotLog
    motor_angle: Array
    """(T, M) [rad]"""
    imu: Array
    """Channels of `IMU` (T, 4) [rad, rad/s]."""

    @property
    def rms(self) -> float:
        """Root mean square over all moving joints and counted rows [rad]."""
        return _rms(self.motor_angle[self.log.counted][:, self.log.moving])

    @property
    def by_motor(self) -> Array:
        """Root mean square of each motor (M,) [rad]; NaN where nothing was read."""
        return np.array([_rms(column) for column in self.motor_angle[self.log.counted].T])

    @property
    def by_imu(self) -> dict[str, float]:
        """Root mean square of each channel of the IMU [rad, rad/s]; NaN where nothing was read."""
        return {name: _rms(column) for name, column in zip(IMU, self.imu[self.log.counted].T, strict=True)}


def _rms(errors: Array) -> float:
    known = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def imu_of(replayed: ReplayedReadings) -> Array:
    """Return the channels of `IMU` (N, T, 4)."""
    return replayed.imu[:, :, [0, 1, 3, 4]]


def replay_log(log: RobotLog, robot: RobotDescription, params: PhysicalParams, replayer: Replayer) -> LogErrors:
    """Replay a log on one simulated robot.

    Raises:
        SurefootError: a log that ends before errors count, or a robot that diverges.
    """
    if not log.counted.any():
        raise SurefootError(f"log {log.name} is {np.ptp(log.time):.2f} s long; errors count after {SKIPPED:g} s")
    told = replayer.run(segment_from_log(log, robot), params)
    if not np.isfinite(told.motor_angle).all():
        raise SurefootError(f"the simulated robot breaks down in the replay of {log.name}; check its parameters")
    return LogErrors(log, told.motor_angle[0] - log.motor_angle, imu_of(told)[0] - log.imu)


def errors_of_recorded(log: RobotLog, other: RobotLog) -> LogErrors:
    """Return how far another recording of the same commands is from a log, from the start of both to the shorter's end.

    The other's readings are read on straight lines between its rows.
    """
    end = other.time[-1] - other.time[0]
    part = log.until(float(end))
    moments = part.time - part.time[0]

    def at(values: Array) -> Array:
        return np.stack([np.interp(moments, other.time - other.time[0], column) for column in values.T], axis=1)

    return LogErrors(part, at(other.motor_angle) - part.motor_angle, at(other.imu) - part.imu)
