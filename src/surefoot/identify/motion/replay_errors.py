"""Errors of simulated robots that replay recorded commands, compared with the recorded readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.motion.recorded import IMU, SKIPPED_TIME, RecordedMotion
from surefoot.identify.recording import interpolate_columns
from surefoot.identify.replay import ReplayedReadings, Replayer, segment_from_motion
from surefoot.robot import PhysicalParams, RobotDescription


@dataclass(frozen=True)
class ReplayErrors:
    """Simulated minus recorded readings in each row of a recorded motion."""

    motion: RecordedMotion
    motor_angle: Array
    """(T, M) [rad]"""
    imu: Array
    """Channels of `IMU` (T, 4) [rad, rad/s]."""

    @property
    def rms(self) -> float:
        """Root mean square error over all moving joints and evaluated rows [rad]."""
        return _rms(self.motor_angle[self.motion.evaluated_rows][:, self.motion.moving_joints])

    @property
    def by_motor(self) -> Array:
        """Root mean square error of each motor (M,) [rad]; NaN without readings."""
        return np.array([_rms(column) for column in self.motor_angle[self.motion.evaluated_rows].T])

    @property
    def by_imu(self) -> dict[str, float]:
        """Root mean square error of each channel of `IMU` [rad, rad/s]; NaN without readings."""
        return {name: _rms(column) for name, column in zip(IMU, self.imu[self.motion.evaluated_rows].T, strict=True)}


def _rms(errors: Array) -> float:
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def imu_channels(readings: ReplayedReadings) -> Array:
    """Return the channels of `IMU` of simulated readings (N, T, 4)."""
    return readings.imu[:, :, [0, 1, 3, 4]]


def replay_motion(
    motion: RecordedMotion, robot: RobotDescription, params: PhysicalParams, replayer: Replayer
) -> ReplayErrors:
    """Replay a motion on one simulated robot.

    Raises:
        SurefootError: the log is too short to be evaluated, or the simulation diverges.
    """
    if not motion.evaluated_rows.any():
        raise SurefootError(
            f"log {motion.name} is {np.ptp(motion.time):.2f} s long; errors are evaluated after {SKIPPED_TIME:g} s"
        )
    readings = replayer.run(segment_from_motion(motion, robot), params)
    if not np.isfinite(readings.motor_angle).all():
        raise SurefootError(f"the simulation diverges in the replay of {motion.name}; check the parameters")
    return ReplayErrors(motion, readings.motor_angle[0] - motion.motor_angle, imu_channels(readings)[0] - motion.imu)


def compare_motions(motion: RecordedMotion, other: RecordedMotion) -> ReplayErrors:
    """Return the errors of another recording of the same commands, up to the end of the shorter one.

    Both recordings are aligned at their start. Readings of `other` are interpolated linearly.
    """
    times = other.time - other.time[0]
    part = motion.first_seconds(float(times[-1]))
    moments = part.time - part.time[0]
    angle, imu = (interpolate_columns(moments, times, values) for values in (other.motor_angle, other.imu))
    return ReplayErrors(part, angle - part.motor_angle, imu - part.imu)
