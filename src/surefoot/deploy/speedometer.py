"""Estimated speed and distance of a running robot, for whoever watches the run; nothing of it controls the robot."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.messages import State
from surefoot.deploy.safety import is_finite
from surefoot.estimation.interface import MotionReadings, torque_lead
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.robot import RobotDescription

SMOOTHING = 0.5
"""Time constant [s] of the shown velocity: about a stride."""


class Speedometer:
    """Velocity and path length of one robot, from the states that it sends `lead` [s] before a control step."""

    def __init__(self, robot: RobotDescription, control_step: float, lead: float = 0.0) -> None:
        self._estimator, self._control_step = LeggedOdometry(robot), control_step
        self._delay, self._time = torque_lead(robot, lead), 0.0
        self._torques: deque[tuple[float, Array]] = deque()
        """Times [s] and torques of the latest states, back to the time of the other readings."""
        self.velocity: Array = np.zeros(2)
        """Mean speeds forward and to the left over the last stride or so (2,) [m/s]."""
        self.distance = 0.0
        """Length of the path [m]; steps of a stride do not count."""

    def update(self, state: State, steps: int = 1) -> None:
        """Take the newest state, control steps after the last one; readings that are not finite are left out."""
        if not is_finite(state):
            return
        duration = steps * self._control_step
        estimate = self._estimator.update(
            MotionReadings(
                duration=np.array([duration]),
                roll_pitch_yaw=state.roll_pitch_yaw[None],
                angular_velocity_base=state.angular_velocity_base[None],
                motor_angle=state.motor_angle[None],
                motor_velocity=state.motor_velocity[None],
                motor_torque=self._delayed_torque(state.motor_torque, duration)[None],
            )
        )
        self.velocity += (1.0 - math.exp(-duration / SMOOTHING)) * (estimate.velocity_base[0, :2] - self.velocity)
        self.distance += float(np.hypot(*self.velocity)) * duration

    def _delayed_torque(self, torque: Array, duration: float) -> Array:
        """Return the torque (M,) at the time of the other readings, `duration` [s] after the last state."""
        self._time += duration
        self._torques.append((self._time, torque))
        at = self._time - self._delay
        while len(self._torques) > 2 and self._torques[1][0] <= at:
            self._torques.popleft()
        (start, before), (end, after) = self._torques[0], self._torques[min(1, len(self._torques) - 1)]
        part = min(max((at - start) / (end - start), 0.0), 1.0) if end > start else 0.0
        return np.asarray(before + part * (after - before))
