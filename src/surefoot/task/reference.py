"""The open loop part of a gait: poses of every leg in leg space, over time or for commands and a phase.

L legs have C coordinates each, in the robot's order: (abduction,) swing, extension.

Tan et al. 2018, eq. 3: a(t, o) = reference(t) + feedback(o).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task.commands import CommandState
from surefoot.task.foot_kinematics import FootKinematics
from surefoot.task.foot_paths import FootPaths
from surefoot.task.stride_choice import StrideChoice

Extent = tuple[tuple[float, float], ...]
"""Lowest and highest value of each coordinate of leg space."""
RATE_STEP = 0.002
"""Half of the time [s] over which the velocity of a pose is taken."""
ACCELERATION_STEP = 0.01
"""Half of the time [s] over which the acceleration of a pose is taken: it jumps where feet touch down and lift off."""


@dataclass(frozen=True)
class Feedforward:
    """Leads of commands over a reference, which make up for what actuators lag and give way."""

    velocity: float = 0.0
    """Time [s] by which commands lead along the velocity of the pose; k_d / k_p makes up for an actuator's damping."""
    acceleration: float = 0.0
    """Square of the time [s^2] by which commands lead along the acceleration of the pose."""
    weight: float = 0.0
    """Angle by which commands lead, relative to the lever arm of the weight [rad/m]."""

    @property
    def moves_poses(self) -> bool:
        """Whether poses lead; commands are clipped to the leg space then."""
        return bool(self.velocity or self.acceleration)


class Reference(ABC):
    """Poses over time. Its defaults are for references that no command changes, without leads."""

    @property
    @abstractmethod
    def period(self) -> Any:
        """Time [s] after which the reference repeats; None if it never does."""

    @abstractmethod
    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at times (N,) [s] since the episode's start."""

    @abstractmethod
    def extent(self) -> Extent:
        """Return the lowest and highest value of each coordinate over all legs, times and commands."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the configuration that makes it again, as JSON values."""

    @property
    def feedforward(self) -> Feedforward:
        """Leads of commands over the poses."""
        return Feedforward()

    @property
    def is_clipped(self) -> bool:
        """Whether reference and feedback together may exceed the leg space, to which commands are clipped."""
        return False

    @property
    def following(self) -> FollowingReference | None:
        """The reference itself, if it follows commands."""
        return None

    @property
    def foothold_radius(self) -> float:
        """Maximum distance [m] by which feet land beside the places of their strides, see `Footholds`."""
        return 0.0

    @property
    def touch_clearance(self) -> float:
        """Maximum height [m] by which feet are lifted further that meet something, see `ContactReflex`."""
        return 0.0

    @property
    def over_holes(self) -> FollowingReference | None:
        """The gait while the map of heights has holes, if that is another one; see `Footholds`."""
        return None

    def frequency(self, command: Array, over_holes: Array | None = None) -> Array:
        """Return the frequency (N,) [Hz] at commands (N, 3) and the share of the gait over holes (N,)."""
        return np.full(len(command), 1.0 / self.period if self.period else 0.0)

    def pose_rate(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the velocities (N, C, L) of the poses at times (N,) [s], in units of leg space a second."""
        time = np.asarray(time, float)
        return (self.pose(time + RATE_STEP) - self.pose(time - RATE_STEP)) / (2 * RATE_STEP)

    def pose_acceleration(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the second derivatives (N, C, L) of the poses at times (N,) [s]."""
        time = np.asarray(time, float)
        before, now, after = (self.pose(time + k * ACCELERATION_STEP) for k in (-1, 0, 1))
        return (after - 2.0 * now + before) / ACCELERATION_STEP**2

    def load(self, state: CommandState | None = None) -> Array:
        """Return the fraction of the weight that each leg carries (L,): all alike, as stance is unknown."""
        legs = self.pose(0.0).shape[-1]
        return np.full(legs, 1.0 / legs)


@dataclass(frozen=True)
class FollowingReference(Reference):
    """Feet whose strides have the commanded speed and direction; a robot that stands keeps them on the ground.

    Raises:
        SurefootError: a stride out of the legs' reach.
    """

    choice: StrideChoice
    """Strides and frequency for commands."""
    feedforward: Feedforward = Feedforward()
    _extent: Extent = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check that legs reach every stride."""
        poses = self.pose(0.0, self.choice.extremes())
        if not np.isfinite(poses).all():
            leg = self.feet.legs[int(np.argwhere(~np.isfinite(poses))[0][-1])]
            raise SurefootError(
                f"reference.foot: a stride of {leg} is out of the leg's reach; "
                "change height, stroke, depth or clearance"
            )
        extent = tuple((float(part.min()), float(part.max())) for part in np.moveaxis(poses, -2, 0))
        object.__setattr__(self, "_extent", extent)
        both = self.foothold_radius and self.touch_clearance
        if both and not np.isfinite(self.pose(0.0, self.choice.foothold_extremes())).all():
            raise SurefootError(
                "reference.foothold_radius and reference.touch_clearance together lead feet out of the legs' "
                "reach; make one of them less"
            )

    @property
    def following(self) -> FollowingReference:
        """The reference itself."""
        return self

    @property
    def is_clipped(self) -> bool:
        """Whether reference and feedback together may exceed the leg space, to which commands are clipped."""
        return self.feedforward.moves_poses

    @property
    def kinematics(self) -> FootKinematics:
        """Kinematics of the feet."""
        return self.choice.kinematics

    @property
    def robot(self) -> RobotDescription:
        """Robot whose legs these are."""
        return self.kinematics.robot

    @property
    def feet(self) -> FootPaths:
        """Feet on the spot; their stroke is the longest stride."""
        return self.kinematics.feet

    @property
    def places(self) -> Array:
        """Feet below the legs' mounts, (L, 3) [m] from the mounts; z is the height."""
        return self.kinematics.places

    @property
    def limits(self) -> CommandLimits:
        """Limits of the commands that are followed."""
        return self.choice.limits

    @property
    def foothold_radius(self) -> float:
        """Maximum distance [m] by which feet land beside the places of their strides, see `Footholds`."""
        return self.kinematics.foothold_radius

    @property
    def touch_clearance(self) -> float:
        """Maximum height [m] by which feet are lifted further that meet something, see `ContactReflex`."""
        return self.kinematics.touch_clearance

    @property
    def period(self) -> float:
        """Time of a step on the spot [s]."""
        return float(self.feet.period)

    def strides(self, command: Array) -> Array:
        """Return the strides (N, L, 2) [m] forward and to the left for commands (N, 3), no longer than allowed."""
        return self.choice.choose(command)[0]

    def frequency(self, command: Array, over_holes: Array | None = None) -> Array:
        """Return the frequency (N,) [Hz] at commands (N, 3)."""
        return self.choice.frequency(command)

    def load(self, state: CommandState | None = None) -> Array:
        """Return the fraction of the weight that each leg carries (N, L), the same for all legs in stance."""
        assert state is not None
        return self.kinematics.load(state)

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at the state's commands and phases; the times (N,) are not used."""
        assert state is not None
        return self.kinematics.pose(state, *self.choice.choose(state.command))

    def pose_rate(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the rates (N, C, L) [leg space units per second] of the poses at the state's commands and phases."""
        assert state is not None
        # The frequency is that of the first gait, over holes too.
        change = RATE_STEP * self.choice.frequency(state.command)
        before, after = (self.pose(time, replace(state, phase=state.phase + sign * change)) for sign in (-1, 1))
        return (after - before) / (2 * RATE_STEP)

    def pose_acceleration(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the second derivatives (N, C, L) of the poses at the state's commands and phases."""
        assert state is not None
        change = ACCELERATION_STEP * self.choice.frequency(state.command)
        before, now, after = (self.pose(time, replace(state, phase=state.phase + k * change)) for k in (-1, 0, 1))
        return (after - 2.0 * now + before) / ACCELERATION_STEP**2

    def extent(self) -> Extent:
        """Return the lowest and highest value of each coordinate over all legs, phases and commands."""
        return self._extent

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration that makes it again, as JSON values."""
        choice, kinematics, ahead = self.choice, self.kinematics, self.feedforward
        gains = {name: getattr(choice, name) for name in ("stride_gain", "frequency_rise", "turn_gain")}
        names = ("clearance_rise", "height_rise", "foothold_radius", "touch_clearance")
        others = {name: getattr(kinematics, name) for name in names}
        others |= {"acceleration_feedforward": ahead.acceleration, "weight_feedforward": ahead.weight}
        velocity = {"velocity_feedforward": ahead.velocity} if ahead.velocity else {}
        given = {name: value for name, value in others.items() if value}
        return {"kind": "follow", "foot": self.feet.to_dict(), **velocity, **gains, **given}
