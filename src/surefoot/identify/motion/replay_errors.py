"""Errors of simulated robots that replay recorded commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.motion.recorded import IMU, SKIPPED_TIME, RecordedMotion
from surefoot.identify.recording import read_at
from surefoot.identify.replay import ReplayedReadings, Replayer, segment_from_motion
from surefoot.robot import PhysicalParams, RobotDescription


@dataclass(frozen=True)
class ReplayErrors:
    """Simulated less recorded readings of the rows of a recorded motion."""

    motion: RecordedMotion
    motor_angle: Array
    """(T, M) [rad]"""
    imu: Array
    """Channels of `IMU` (T, 4) [rad, rad/s]."""

    @property
    def rms(self) -> float:
        """Root mean square over all moving joints and counted rows [rad]."""
        return _rms(self.motor_angle[self.motion.counted][:, self.motion.moving])

    @property
    def by_motor(self) -> Array:
        """Root mean square of each motor (M,) [rad]; NaN where nothing was read."""
        return np.array([_rms(column) for column in self.motor_angle[self.motion.counted].T])

    @property
    def by_imu(self) -> dict[str, float]:
        """Root mean square of each channel of the IMU [rad, rad/s]; NaN where nothing was read."""
        return {name: _rms(column) for name, column in zip(IMU, self.imu[self.motion.counted].T, strict=True)}


def _rms(errors: Array) -> float:
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def imu_channels(readings: ReplayedReadings) -> Array:
    """Return the channels of `IMU` (N, T, 4)."""
    return readings.imu[:, :, [0, 1, 3, 4]]


def replay_motion(
    motion: RecordedMotion, robot: RobotDescription, params: PhysicalParams, replayer: Replayer
) -> ReplayErrors:
    """Replay a motion on one simulated robot.

    Raises:
        SurefootError: a log that ends before errors count, or a robot that diverges.
    """
    if not motion.counted.any():
        raise SurefootError(f"log {motion.name} is {np.ptp(motion.time):.2f} s long; errors count after {SKIPPED_TIME:g} s")
    readings = replayer.run(segment_from_motion(motion, robot), params)
    if not np.isfinite(readings.motor_angle).all():
        raise SurefootError(f"the simulated robot breaks down in the replay of {motion.name}; check its parameters")
    return ReplayErrors(motion, readings.motor_angle[0] - motion.motor_angle, imu_channels(readings)[0] - motion.imu)


def compare_motions(motion: RecordedMotion, other: RecordedMotion) -> ReplayErrors:
    """Return the errors of another record of the same commands, from both starts to the end of the shorter one.

    The other's readings are interpolated linearly.
    """
    times = other.time - other.time[0]
    part = motion.until(float(times[-1]))
    moments = part.time - part.time[0]
    angle, imu = (read_at(moments, times, values) for values in (other.motor_angle, other.imu))
    return ReplayErrors(part, angle - part.motor_angle, imu - part.imu)
