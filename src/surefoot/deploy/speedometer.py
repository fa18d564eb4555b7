"""Estimated speed and distance of a running robot, for whoever watches the run; nothing of it controls the robot."""

from __future__ import annotations

import math

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.messages import State
from surefoot.deploy.readings import sensor_readings
from surefoot.deploy.safety import is_finite
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.estimation.torque_delay import TorqueDelay
from surefoot.robot import RobotDescription
from surefoot.task.base_velocity import motion_readings

SMOOTHING = 0.5
"""Time constant [s] of the shown velocity: about a stride."""


class Speedometer:
    """Velocity and path length of one robot, from the states that it sends `lead` [s] before a control step."""

    def __init__(self, robot: RobotDescription, control_step: float, lead: float = 0.0) -> None:
        self._estimator, self._control_step = LeggedOdometry(robot), control_step
        self._torque_delay = TorqueDelay(robot, lead)
        self.velocity: Array = np.zeros(2)
        """Mean speeds forward and to the left over the last stride or so (2,) [m/s]."""
        self.distance = 0.0
        """Length of the path [m]; steps of a stride do not count."""

    def update(self, state: State, steps: int = 1) -> None:
        """Take the newest state, control steps after the last one; readings that are not finite are left out."""
        if not is_finite(state):
            return
        duration = steps * self._control_step
        # The estimator uses the duration and not the time.
        readings = sensor_readings(state, 0.0, self._torque_delay.update(state.motor_torque, duration))
        estimate = self._estimator.update(motion_readings(readings, np.array([duration])))
        self.velocity += (1.0 - math.exp(-duration / SMOOTHING)) * (estimate.velocity_base[0, :2] - self.velocity)
        self.distance += float(np.hypot(*self.velocity)) * duration
