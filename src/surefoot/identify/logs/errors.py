"""Errors of simulated robots that replay a log."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.logs.robot_log import IMU, SKIPPED, RobotLog
from surefoot.identify.recording import read_at
from surefoot.identify.replay import ReplayedReadings, Replayer, segment_from_log
from surefoot.robot import PhysicalParams, RobotDescription


@dataclass(frozen=True)
class LogErrors:
    """Simulated less recorded readings of the rows of a log."""

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
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def imu_channels(readings: ReplayedReadings) -> Array:
    """Return the channels of `IMU` (N, T, 4)."""
    return readings.imu[:, :, [0, 1, 3, 4]]


def replay_log(log: RobotLog, robot: RobotDescription, params: PhysicalParams, replayer: Replayer) -> LogErrors:
    """Replay a log on one simulated robot.

    Raises:
        SurefootError: a log that ends before errors count, or a robot that diverges.
    """
    if not log.counted.any():
        raise SurefootError(f"log {log.name} is {np.ptp(log.time):.2f} s long; errors count after {SKIPPED:g} s")
    readings = replayer.run(segment_from_log(log, robot), params)
    if not np.isfinite(readings.motor_angle).all():
        raise SurefootError(f"the simulated robot breaks down in the replay of {log.name}; check its parameters")
    return LogErrors(log, readings.motor_angle[0] - log.motor_angle, imu_channels(readings)[0] - log.imu)


def compare_logs(log: RobotLog, other: RobotLog) -> LogErrors:
    """Return the errors of another record of the same commands, from both starts to the end of the shorter one.

    The other's readings are interpolated linearly.
    """
    times = other.time - other.time[0]
    part = log.until(float(times[-1]))
    moments = part.time - part.time[0]
    angle, imu = (read_at(moments, times, values) for values in (other.motor_angle, other.imu))
    return LogErrors(part, angle - part.motor_angle, imu - part.imu)
