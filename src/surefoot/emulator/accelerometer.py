"""Simulated accelerometer of an emulated robot."""

from __future__ import annotations

from collections import deque

import numpy as np

from surefoot.arrays import Array
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.rotations import quat_matrix, rpy_matrix
from surefoot.seeding import generator


class Accelerometer:
    """Specific force of the base link, R^T (a - g), from its velocities at the ends of consecutive servo steps.

    Args:
        robot: the robot, whose latency is a number of servo steps.
        params: physical parameters of the robot, one row: mounting of its IMU, and the maximum age of readings.
        gravity: acceleration of gravity [m/s^2].
        noise: standard deviation of readings [m/s^2].
        seed: seed of the noise.
        base: pose and velocity of the base link at the start (10,), see `Engine.base`.
    """

    def __init__(
        self, robot: RobotDescription, params: PhysicalParams, gravity: float, noise: float, seed: int, base: Array
    ) -> None:
        self._step, self._noise = robot.timing.servo_step, noise
        self._random = generator(seed, "emulated accelerometer")
        self._gravity, self._mount = np.array([0.0, 0.0, gravity]), rpy_matrix(*params.imu_mount[0]).T
        self._velocity = base[7:10]
        self._forces: deque[Array] = deque(maxlen=round(float(params.control_latency[0]) / self._step) + 1)
        self.measure(base)

    def measure(self, base: Array, count: int = 1) -> None:
        """Sample the mean force of servo steps.

        Args:
            base: pose and velocity of the base link at their end (10,).
            count: number of steps since the sample before.
        """
        velocity = base[7:10]
        acceleration, self._velocity = (velocity - self._velocity) / (count * self._step), velocity
        force = self._mount @ quat_matrix(base[3:7]).T @ (acceleration + self._gravity)
        self._forces.extend([force] * count)

    def read(self, latency: float) -> Array:
        """Return the reading (3,) of `latency` ago, rounded to servo steps, or the oldest one [m/s^2]."""
        force = self._forces[-1 - min(round(latency / self._step), len(self._forces) - 1)]
        return force + self._noise * self._random.standard_normal(3) if self._noise else force
