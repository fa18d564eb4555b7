"""Torques of a robot at the time of its other readings."""

from __future__ import annotations

from collections import deque

import numpy as np

from surefoot.arrays import Array
from surefoot.robot import RobotDescription


class TorqueDelay:
    """Delays the motor torques of one robot, state by state.

    Robots report torques of the last servo step, and angles and attitudes as old as their control latency. With torques
    that are 10 ms too new, the estimated distance is 2 percent off in a trot, and 10 percent in a gallop.

    Args:
        robot: its data sheet has the control latency.
        lead: time between a state and the control step that uses it, which is a part of the latency [s].
    """

    def __init__(self, robot: RobotDescription, lead: float = 0.0) -> None:
        self._delay = max(float(robot.nominal_params()["control_latency"]) - lead, 0.0)
        self.reset()

    def reset(self) -> None:
        """Forget the torques before."""
        self._time = 0.0
        self._torques: deque[tuple[float, Array]] = deque()
        """Times [s] and torques of the latest states, back to the time of the other readings."""

    def update(self, torque: Array, duration: float) -> Array:
        """Take the torque (M,) of a state, `duration` [s] after the last one; return the torque of its other readings.

        The first torque is also returned for the time before.
        """
        self._time += duration
        self._torques.append((self._time, torque))
        at = self._time - self._delay
        while len(self._torques) > 2 and self._torques[1][0] <= at:
            self._torques.popleft()
        (start, before), (end, after) = self._torques[0], self._torques[min(1, len(self._torques) - 1)]
        part = min(max((at - start) / (end - start), 0.0), 1.0) if end > start else 0.0
        return np.asarray(before + part * (after - before))
