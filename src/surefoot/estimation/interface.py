"""The interface of velocity estimators, and its data: N robots with M motors and L legs. A robot is a batch of one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from surefoot.arrays import Array


@dataclass(frozen=True)
class MotionReadings:
    """Sensor readings of a control step, all taken at the same time. The estimate is for that time."""

    duration: Array
    """Time since the readings before (N,) [s]."""
    roll_pitch_yaw: Array
    """Orientation of the base in the world (N, 3) [rad]: yaw about z, then pitch about y, then roll about x."""
    angular_velocity_base: Array
    """Angular velocity of the base, in the base frame (N, 3) [rad/s]."""
    motor_angle: Array
    """Motor angles (N, M) [rad]."""
    motor_velocity: Array
    """Motor speeds (N, M) [rad/s]."""
    motor_torque: Array
    """Motor torques (N, M) [N m], from the currents; robots report them too early, see `torque_delay`."""
    accelerometer: Array | None = None
    """Specific force in the base frame (N, 3) [m/s^2]: (0, 0, g) at rest. None without an accelerometer."""
    expected_load: Array | None = None
    """Fraction of the weight that each leg carries according to a reference gait (N, L). None without one."""


@dataclass(frozen=True)
class VelocityEstimate:
    """Motion of the base at the time of the readings."""

    velocity_base: Array
    """Velocity of the base's origin, in the base frame (N, 3) [m/s]: the mean over the time since the readings
    before."""
    covariance: Array
    """Covariance of the error of `velocity_base` (N, 3, 3) [m^2/s^2]."""
    height: Array
    """Height of the base's origin above the feet in contact (N,) [m]."""
    contact: Array
    """Probability that each foot stands on the ground without slipping (N, L)."""


class VelocityEstimator(Protocol):
    """Estimates the velocity of the base from one control step to the next."""

    def reset(self) -> None:
        """Forget all readings; the robots stand still at the next ones."""

    def update(self, readings: MotionReadings) -> VelocityEstimate:
        """Take the readings of a control step and return the estimate for their time."""
