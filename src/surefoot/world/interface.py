"""The interface that simulation and robot share, and its data.

A world takes motor angles, holds them for a control step, and returns readings. A robot is a batch of one. Only
a simulation also answers `truth()`.
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


@dataclass(frozen=True)
class SensorReadings:
    """What the control computer receives of N robots with M motors: delayed, biased and noisy."""

    time: Array
    """Time since reset on each robot's clock [s], (N,)."""
    roll_pitch_yaw: Array
    """Orientation of the base in the world [rad], (N, 3): yaw about z, pitch about y, then roll about x."""
    angular_velocity_base: Array
    """Angular velocity of the base, in the base frame [rad/s], (N, 3)."""
    motor_angle: Array
    """Motor angles theta in the robot's motor order [rad], (N, M)."""
    motor_velocity: Array
    """Motor speeds [rad/s], (N, M)."""


@dataclass(frozen=True)
class SimState:
    """The present true state, which only a simulation knows."""

    base_position_world: Array
    """Origin of the base link [m], (N, 3)."""
    base_quat_world: Array
    """Orientation of the base, (N, 4), w x y z."""
    base_velocity_world: Array
    """Velocity of the base link's origin, in the world frame [m/s], (N, 3)."""
    roll_pitch_yaw: Array
    """True orientation [rad], (N, 3)."""
    motor_angle: Array
    """True motor angles [rad], (N, M)."""
    motor_velocity: Array
    """True motor speeds [rad/s], (N, M)."""
    motor_torque: Array
    """Torque of each motor in the last servo step, friction not counted [N m], (N, M)."""
    energy: Array
    """Integral of |tau . qdot| over the last control step, at servo rate [J], (N,)."""
    heat: Array
    """Heat of each motor over the last control step, at servo rate [J], (N, M): R I^2 of DC motors; of joint actuators,
    which are known by their limits, `HEAT_LOSS` says of what; 0 for constraint motors, which have no current."""
    foot_contact: Array
    """Fraction of the last control step's servo steps in which each foot touched the ground, (N, L)."""
    motor_saturation: Array
    """Fraction of these servo steps in which each motor was at its limit, (N, M): DC motors at full duty, joint
    actuators at the torque that there is at their speed."""
    diverged: NDArray[np.bool_]
    """Robots whose state stopped being finite in the last control step; they wait for a reset, (N,)."""


@dataclass(frozen=True)
class WorldConfig:
    """Configuration of a simulated world."""

    rest: tuple[float | tuple[float, ...], ...] | None = None
    """Pose of the legs in leg space in which robots settle before an episode, each coordinate of all legs or of each;
    the description's, if not given."""
    actuator: Literal["dc", "constraint"] = "dc"
    """dc: servo and DC motor; constraint: the position motor of physics engines, without a servo or a motor model."""
    rack: bool = False
    """Hold the base still in the air, level and out of reach of the ground."""
    thermal_protection: bool = False
    """Switch off motors that stay over their thermal torque limit, until the next reset."""
    start_linear_speed: float = 0.0
    """A reset gives the base a random velocity, each component up to this [m/s]."""
    start_angular_speed: float = 0.0
    """A reset gives the base a random angular velocity, each component up to this [rad/s]."""
    ground: Ground = FLAT
    """What robots stand on."""
    threads: int = 0
    """Threads, or processes, to step on; 0 means one a core."""

    def __post_init__(self) -> None:
        """Refuse contradictions and values out of bounds."""
        if self.actuator not in ACTUATORS:
            raise SurefootError(f"actuator is '{self.actuator}'; {suggest(self.actuator, ACTUATORS)}")
        if self.threads < 0:
            raise SurefootError(f"threads is {self.threads}; it must be 0 (one a core) or more")
        if self.actuator == "constraint" and self.thermal_protection:
            raise SurefootError("thermal_protection is on; it requires actuator dc")


class World(Protocol):
    """A robot, or a batch of simulated ones."""

    robot: RobotDescription
    num_envs: int

    def reset(self, index: ArrayLike | None = None) -> SensorReadings:
        """Bring the robots at `index` (all, if none is given) to the resting pose; return readings of all robots."""

    def step(self, target: ArrayLike) -> SensorReadings:
        """Send motor angles (N, M) [rad] and hold them for one control step; return readings at its end."""


class Simulation(World, Protocol):
    """A world whose state and parameters can be read and set."""

    params: PhysicalParams
    divergences: int
    """How often a robot's state stopped being finite, since the world was made."""

    def step(self, target: ArrayLike, active: NDArray[np.bool_] | None = None) -> SensorReadings:
        """Step as a world does; robots that are not `active` (N,) are not stepped."""

    def readings(self) -> SensorReadings:
        """Return the present readings again."""

    def truth(self) -> SimState:
        """Return the true state; the arrays belong to the caller."""

    def foot_positions(self) -> Array:
        """Return the centres of the rounded feet in the world frame [m], (N, L, 3)."""

    def set_params(self, index: ArrayLike, params: PhysicalParams) -> None:
        """Give the robots at `index` other physical parameters, one row each."""

    def place(self, index: ArrayLike, starts: Array, headings: Array) -> None:
        """Let robots rest at places (n, 2) [m] of the ground, with headings (n,) [rad], from their next reset on.

        Without this they rest at (0, 0), and head along x.
        """

    def push(self, force_world: ArrayLike) -> None:
        """Set the force (N, 3) [N] that acts at the base's centre of mass from now on, in the world frame."""

    def get_state(self) -> dict[str, Any]:
        """Return the whole state of the world."""

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`, exactly."""


SimulationFactory = Callable[[RobotDescription, int, PhysicalParams, int, WorldConfig], Simulation]
"""Makes a simulation of a robot: number of robots, their parameters, seed, configuration."""
