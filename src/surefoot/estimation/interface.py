"""The interface of velocity estimators, and its data: N robots with M motors and L legs. A robot is a batch of one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from surefoot.arrays import Array
from surefoot.robot import RobotDescription


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
    """Motor torques (N, M) [N m], from the currents; see `torque_lead`."""
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


def torque_lead(robot: RobotDescription, lead: float = 0.0) -> float:
    """Return by how much reported torques are newer than the other readings of a state [s].

    Robots report torques of the last servo step, and angles and attitudes as old as their control latency, of which
    `lead` [s] is the time between the state and the control step.
    """
    return max(float(robot.nominal_params()["control_latency"]) - lead, 0.0)


class VelocityEstimator(Protocol):
    """Estimates the velocity of the base from one control step to the next."""

    def reset(self) -> None:
        """Forget all readings; the robots stand still at the next ones."""

    def update(self, readings: MotionReadings) -> VelocityEstimate:
        """Take the readings of a control step and return the estimate for their time."""
