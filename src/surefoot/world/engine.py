"""The interface of a physics engine, which `SimWorld` drives: bodies, loops and contacts of a batch of robots."""

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
    """Physics of a batch of robots; it shares the `ActuationState` arrays with the world.

    Rows are indices of robots, (n,); other arrays have a row for each of these.
    """

    gravity: float
    initial_state: Array
    diverged: NDArray[np.bool_]

    def advance(self, servo_steps: Index) -> None:
        """Run each robot for its number of servo steps, `compute_torque` before and `record_sample` after each."""

    def observe(self, rows: Index) -> None:
        """Write states to `actuation.sample`."""

    def get_state(self, rows: Index) -> Array:
        """Return the whole states (n, size) in the engine."""

    def set_state(self, rows: Index, states: Array) -> None:
        """Put robots into states (n, size), or all into one (size,), and clear their marks of divergence."""

    def set_motors(self, rows: Index, angles: Array, speeds: Array) -> None:
        """Put the motors of robots without closed loops to true angles [rad] and speeds [rad/s] (n, M)."""

    def turn(self, rows: Index, angles: Array) -> None:
        """Turn robots by angles (n,) [rad] about the vertical axis through the world's origin."""

    def move_base(self, rows: Index, offset_world: Array) -> None:
        """Move bases by offsets (n, 3) [m] in the world."""

    def set_base_velocity(self, rows: Index, linear_world: Array, angular_base: Array) -> None:
        """Set velocities (n, 3) [m/s] and angular velocities (n, 3) [rad/s] of bases."""

    def set_force(self, force_world: Array) -> None:
        """Set the forces (N, 3) [N] on all robots' bases, at their centres of mass."""

    def set_params(self, rows: Index, params: PhysicalParams) -> None:
        """Apply masses, inertias and the feet's contact, a row for each robot; states stay as they are."""

    def base(self) -> Array:
        """Return the base position, quaternion and velocity in the world, (N, 10)."""

    def foot_positions(self) -> Array:
        """Return the foot centres in the world, (N, L, 3)."""


EngineFactory = Callable[[RobotDescription, ActuationState, WorldConfig], Engine]
"""Makes the physics of as many robots as the shared arrays of servos, motors and sensors have rows."""
