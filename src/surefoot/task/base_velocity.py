"""Estimated velocity of the base for the observation `base_velocity`, the same in simulation and on the robot.

The estimator gets only what a robot measures, so its output has the delay of the readings, and its own error.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.estimation.interface import MotionReadings
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.robot import RobotDescription
from surefoot.task.component import RobotComponent
from surefoot.task.state import RobotState
from surefoot.world.interface import SensorReadings


class BaseVelocity(RobotComponent):
    """Estimated velocity of the base.

    Args:
        robot: the robot.
        num_envs: number of robots.
    """

    prefix = "base_velocity"

    def __init__(self, robot: RobotDescription, num_envs: int) -> None:
        self._estimator = LeggedOdometry(robot, num_envs)
        self.velocity = np.zeros((num_envs, 3))
        """Estimated velocity in the base frame (N, 3) [m/s]."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays that an exact resume needs, by name."""
        state = {f"{self.prefix}_estimator_{name}": array for name, array in self._estimator.arrays().items()}
        return {self.prefix: self.velocity, **state}

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Start episodes: robots stand still."""
        if len(rows):
            self._estimator.start(rows, motion_readings(state.readings, state.duration, rows))
            self.velocity[rows] = 0.0
        self.publish(state)

    def after_step(self, state: RobotState) -> None:
        """Estimate the velocity at the time of the readings."""
        self.velocity[:] = self._estimator.update(motion_readings(state.readings, state.duration)).velocity_base
        self.publish(state)

    def publish(self, state: RobotState) -> None:
        """Write the velocity to the state."""
        state.base_velocity = self.velocity


def motion_readings(readings: SensorReadings, duration: Array, rows: Any = slice(None)) -> MotionReadings:
    """Return what an estimator receives of the readings of some robots.

    Args:
        readings: readings of all robots.
        duration: time since their previous readings (N,) [s].
        rows: indices of the robots.

    Raises:
        SurefootError: readings without motor torques.
    """
    if readings.motor_torque is None:
        raise SurefootError("observation 'base_velocity' needs motor torques among the readings; this world has none")
    return MotionReadings(
        duration=duration[rows],
        roll_pitch_yaw=readings.roll_pitch_yaw[rows],
        angular_velocity_base=readings.angular_velocity_base[rows],
        motor_angle=readings.motor_angle[rows],
        motor_velocity=readings.motor_velocity[rows],
        motor_torque=readings.motor_torque[rows],
    )
