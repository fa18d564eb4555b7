"""Interface of physics engines, which `SimWorld` drives: bodies, closed loops and contacts of a batch of robots."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.actuation import ActuationState
from surefoot.world.interface import WorldConfig

Index = NDArray[np.int64]


class Engine(Protocol):
    """Physics of a batch of N robots, which shares the `ActuationState` arrays with its world.

    `rows` are indices of robots (n,). Other arrays have one row per index.
    """

    gravity: float
    initial_state: Array
    diverged: NDArray[np.bool_]

    def advance(self, servo_steps: Index) -> None:
        """Run each robot for its number of servo steps (N,).

        Before each step the engine calls `compute_torque`, and after it `record_sample`.
        """

    def observe(self, rows: Index) -> None:
        """Write the current motor and IMU states of robots to `actuation.sample`."""

    def get_state(self, rows: Index) -> Array:
        """Return the complete states (n, size) in the engine."""

    def set_state(self, rows: Index, states: Array) -> None:
        """Set robots to states (n, size), or all to one state (size,), and clear their divergence flags."""

    def set_motors(self, rows: Index, angles: Array, speeds: Array) -> None:
        """Set true motor angles [rad] and speeds [rad/s] (n, M) of robots without closed loops."""

    def rotate(self, rows: Index, angles: Array) -> None:
        """Rotate robots by angles (n,) [rad] about the vertical axis through the world's origin."""

    def move_base(self, rows: Index, offset_world: Array) -> None:
        """Translate bases by offsets (n, 3) [m] in the world frame."""

    def set_base_velocity(self, rows: Index, linear_world: Array, angular_base: Array) -> None:
        """Set base velocities (n, 3) [m/s] in the world and angular velocities (n, 3) [rad/s] in the base frames."""

    def set_force(self, force_world: Array) -> None:
        """Set the forces (N, 3) [N] on the bases' centres of mass, in the world frame."""

    def set_params(self, rows: Index, params: PhysicalParams) -> None:
        """Apply masses, inertias and foot contact, one row per robot, without changing states."""

    def base(self) -> Array:
        """Return base position [m], quaternion (w x y z) and velocity [m/s] in the world frame (N, 10)."""

    def foot_positions(self) -> Array:
        """Return the foot centres in the world frame (N, L, 3) [m]."""


EngineFactory = Callable[[RobotDescription, ActuationState, WorldConfig], Engine]
"""Factory of engines. The number of robots is the number of rows of the `ActuationState`."""
