"""Policies of others that tests adopt, readings of a Go2, and a network that shows its observation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surefoot.policy.graph import Graph, Value

DATA = Path(__file__).resolve().parents[1] / "data" / "rl_sar"


@dataclass
class Readings:
    """Readings of a Go2 at a control step, in the order and with the signs of the vendor's messages."""

    roll_pitch_yaw: np.ndarray
    angular_velocity_base: np.ndarray
    motor_angle: np.ndarray
    motor_velocity: np.ndarray

    @property
    def quaternion(self) -> np.ndarray:
        """Orientation of the base, w x y z."""
        (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in self.roll_pitch_yaw)
        return np.array(
            [
                cy * cp * cr + sy * sp * sr,
                cy * cp * sr - sy * sp * cr,
                cy * sp * cr + sy * cp * sr,
                sy * cp * cr - cy * sp * sr,
            ]
        )


class Probe:
    """A network that gives some numbers of its observation as its action."""

    hidden: tuple[int, ...] = ()

    def __init__(self, inputs: int, outputs: int, first: int) -> None:
        self.inputs, self.outputs, self._columns = inputs, outputs, [(first + k) % inputs for k in range(outputs)]

    def add(self, graph: Graph, observation: Value, hidden: list[Value]) -> tuple[Value, list[Value]]:
        """Add the selection."""
        return graph.select(observation, self._columns), []
