"""Interface of simulations and robots ("worlds"), and its data.

A world receives motor angles, holds them for one control step, and returns sensor readings. A robot is a batch of one.
Only simulations also provide the true state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, suggest
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.ground import FLAT, Ground

ACTUATORS = ("dc", "constraint")
MAX_PHYSICS_STEP = 0.02
"""Maximum of `WorldConfig.physics_step` [s]."""


@dataclass(frozen=True)
class SensorReadings:
    """Sensor readings at the control computer, for N robots with M motors: delayed, biased and noisy."""

    time: Array
    """Time since the reset on each robot's clock (N,) [s]."""
    roll_pitch_yaw: Array
    """Orientation of the base in the world (N, 3) [rad]: yaw about z, pitch about y, then roll about x."""
    angular_velocity_base: Array
    """Angular velocity of the base in the base frame (N, 3) [rad/s]."""
    motor_angle: Array
    """Motor angles theta in the robot's motor order (N, M) [rad]."""
    motor_velocity: Array
    """Motor speeds (N, M) [rad/s]."""
    motor_torque: Array | None = None
    """Motor torques from the currents, without friction (N, M) [N m]. Robots always measure them; a simulation does if
    its configuration asks for them (`WorldConfig.torque_readings`), and is None otherwise."""


@dataclass(frozen=True)
class SimState:
    """Current true state of a simulation, for N robots with M motors and L legs."""

    base_position_world: Array
    """Position of the base link's origin in the world frame (N, 3) [m]."""
    base_quat_world: Array
    """Orientation of the base (N, 4), w x y z."""
    base_velocity_world: Array
    """Velocity of the base link's origin in the world frame (N, 3) [m/s]."""
    roll_pitch_yaw: Array
    """True orientation of the base (N, 3) [rad]."""
    motor_angle: Array
    """True motor angles (N, M) [rad]."""
    motor_velocity: Array
    """True motor speeds (N, M) [rad/s]."""
    motor_torque: Array
    """Torque of each motor in the last servo step, without friction (N, M) [N m]."""
    energy: Array
    """Integral of |tau . qdot| over the last control step, at servo rate (N,) [J]."""
    heat: Array
    """Heat of each motor over the last control step, at servo rate (N, M) [J]: R I^2 for DC motors, an estimate from
    the actuator's limits for joint actuators (see `HEAT_LOSS`), and 0 for constraint motors, which have no current."""
    foot_contact: Array
    """Fraction of the last control step's servo steps in which each foot touched the ground (N, L)."""
    motor_saturation: Array
    """Fraction of these servo steps in which each motor was at its limit (N, M): DC motors at full duty, joint
    actuators at the maximum torque at their speed."""
    diverged: NDArray[np.bool_]
    """Whether each robot's simulation diverged in the last control step, so that it waits for a reset (N,)."""


@dataclass(frozen=True)
class WorldConfig:
    """Configuration of a simulated world."""

    rest: tuple[float | tuple[float, ...], ...] | None = None
    """Pose of the legs in leg space in which robots settle before an episode: for each coordinate one value, or one per
    leg. Defaults to the resting pose of the robot's description."""
    actuator: Literal["dc", "constraint"] = "dc"
    """dc: servo and motor model; constraint: the position motor of physics engines, without servo and motor model."""
    rack: bool = False
    """Fix the base in the air, level and out of reach of the ground."""
    thermal_protection: bool = False
    """Switch off motors that stay over their thermal torque limit, until the next reset."""
    torque_readings: bool = False
    """Measure the motor torques: the readings contain them, as old as the other readings."""
    start_linear_speed: float = 0.0
    """Maximum of each component of the base's random velocity after a reset [m/s]."""
    start_angular_speed: float = 0.0
    """Maximum of each component of the base's random angular velocity after a reset [rad/s]."""
    ground: Ground = FLAT
    """Ground."""
    threads: int = 0
    """Number of threads or processes; 0 means one per core."""
    physics_step: float = 0.0
    """Maximum step of servos and physics [s]: robots use the longest stable one up to it, if it is longer than their
    data sheet's. 0: the data sheet's."""

    def __post_init__(self) -> None:
        """Reject contradictions and values out of bounds."""
        if self.actuator not in ACTUATORS:
            raise SurefootError(f"actuator is '{self.actuator}'; {suggest(self.actuator, ACTUATORS)}")
        if self.threads < 0:
            raise SurefootError(f"threads is {self.threads}; it must be 0 (one per core) or more")
        if not 0.0 <= self.physics_step <= MAX_PHYSICS_STEP:
            raise SurefootError(
                f"physics_step is {self.physics_step:g} s; it must be at least 0 and at most {MAX_PHYSICS_STEP:g}"
            )
        if self.actuator == "constraint" and self.thermal_protection:
            raise SurefootError("thermal_protection is on; it requires actuator dc")


class World(Protocol):
    """A robot, or a batch of simulated robots."""

    robot: RobotDescription
    num_envs: int

    def reset(self, index: ArrayLike | None = None) -> SensorReadings:
        """Reset the robots at `index` (default: all) to the resting pose; return the readings of all robots."""

    def step(self, target: ArrayLike) -> SensorReadings:
        """Command motor angles (N, M) [rad] for one control step; return the readings at its end."""


class Simulation(World, Protocol):
    """A world whose state and parameters can be read and set."""

    params: PhysicalParams
    divergences: int
    """Number of divergences of robots since the world was made."""

    def step(self, target: ArrayLike, active: NDArray[np.bool_] | None = None) -> SensorReadings:
        """Step like `World.step`, but only robots that are `active` (N,), by default all."""

    def readings(self) -> SensorReadings:
        """Return the current readings again."""

    def truth(self) -> SimState:
        """Return the true state, in arrays that the caller may modify."""

    def foot_positions(self) -> Array:
        """Return the centres of the spherical feet in the world frame (N, L, 3) [m]."""

    def set_params(self, index: ArrayLike, params: PhysicalParams) -> None:
        """Set the physical parameters of the robots at `index`, one row per robot."""

    def place(self, index: ArrayLike, starts: Array, headings: Array) -> None:
        """Set the positions (n, 2) [m] and headings (n,) [rad] at which robots start after their next reset.

        By default, robots start at (0, 0) with their heading along x.
        """

    def push(self, force_world: ArrayLike) -> None:
        """Set the force (N, 3) [N] on each base's centre of mass in the world frame, until the next call."""

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the world."""

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `get_state`, to continue exactly from there."""


SimulationFactory = Callable[[RobotDescription, int, PhysicalParams, int, WorldConfig], Simulation]
"""Factory of simulations: robot, number of robots, their parameters, seed, configuration."""
