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


class EpisodicOdometry(LeggedOdometry):
    """Legged odometry of N robots whose episodes start at different times.

    Args:
        robot: legs, motors and weight.
        num_envs: number of robots.
    """

    def __init__(self, robot: RobotDescription, num_envs: int) -> None:
        super().__init__(robot, num_envs)
        self._robot = robot
        self._starting: dict[int, LeggedOdometry] = {}
        constants = dict(vars(self))
        self.reset()
        self._changing = [
            name
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray) and value is not constants.get(name)
        ]
        """Names of the arrays of the filter's state, which a reset replaces."""

    def start(self, rows: NDArray[np.int64], readings: MotionReadings) -> Array:
        """Forget the readings of robots that stand still at their first new ones.

        Args:
            rows: indices of the robots (n,).
            readings: first readings of these robots.

        Returns:
            Velocities of these robots in the base frame (n, 3) [m/s].
        """
        count = len(rows)
        if count == self._num_envs:
            self.reset()
            return self.update(readings).velocity_base
        if count not in self._starting:
            self._starting[count] = LeggedOdometry(self._robot, count)
        first = self._starting[count]
        first.reset()
        velocity = first.update(readings).velocity_base
        for own, new in zip(self._state_of(self), self._state_of(first), strict=True):
            own[rows] = new
        return velocity

    def _state_of(self, odometry: LeggedOdometry) -> list[Array]:
        """Return the filter's state and the previous readings of the feet, with one row per robot."""
        before = odometry._odometry._before
        assert before is not None
        return [*(getattr(odometry, name) for name in self._changing), *before]

    def arrays(self) -> dict[str, Array]:
        """Return the arrays that an exact resume needs, by name."""
        return {f"estimator_{k}": array for k, array in enumerate(self._state_of(self))}


class BaseVelocity(RobotComponent):
    """Estimated velocity of the base.

    Args:
        robot: the robot.
        num_envs: number of robots.
    """

    prefix = "base_velocity"

    def __init__(self, robot: RobotDescription, num_envs: int) -> None:
        self._estimator = EpisodicOdometry(robot, num_envs)
        self.velocity = np.zeros((num_envs, 3))
        """Estimated velocity in the base frame (N, 3) [m/s]."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays that an exact resume needs, by name."""
        own = {"velocity": self.velocity, **self._estimator.arrays()}
        return {f"{self.prefix}_{name}": array for name, array in own.items()}

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Start episodes: robots stand still."""
        if len(rows):
            readings = motion_readings(state.readings, state.duration, rows)
            self.velocity[rows] = self._estimator.start(rows, readings)
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
        # A copy, because the estimator keeps it, and `EpisodicOdometry.start` writes to what the estimator keeps.
        angular_velocity_base=readings.angular_velocity_base[rows].copy(),
        motor_angle=readings.motor_angle[rows],
        motor_velocity=readings.motor_velocity[rows],
        motor_torque=readings.motor_torque[rows],
    )
