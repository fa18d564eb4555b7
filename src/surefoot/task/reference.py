"""Reference gaits: the open-loop part of the command, as leg poses over time or for commands and a gait phase.

L legs have C coordinates each in leg space, in the robot's order: (abduction,) swing, extension.

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
from surefoot.task.foot_paths import FootPaths
from surefoot.task.stepping_kinematics import SteppingKinematics
from surefoot.task.stride_choice import StrideChoice

Extent = tuple[tuple[float, float], ...]
"""Minimum and maximum of each coordinate of leg space."""
RATE_STEP = 0.002
"""Step [s] of the central difference for the velocity of a pose."""
ACCELERATION_STEP = 0.01
"""Step [s] of the central difference for the acceleration of a pose, which jumps at touchdown and lift-off."""


@dataclass(frozen=True)
class Feedforward:
    """Feedforward gains, which compensate for the lag and the compliance of actuators."""

    velocity: float = 0.0
    """Gain on the velocity of the pose [s]; k_d / k_p compensates for the damping of an actuator."""
    acceleration: float = 0.0
    """Gain on the acceleration of the pose [s^2]; inertia / k_p compensates for an inertia."""
    weight: float = 0.0
    """Gain on the lever arm of the weight [rad/m]; m g / k_p compensates for the deflection under the weight."""

    @property
    def moves_poses(self) -> bool:
        """Whether there is feedforward of motion. Commands are then clipped to the legs' range."""
        return bool(self.velocity or self.acceleration)


class Reference(ABC):
    """Base class of references. Defaults are for references without commands and feedforward."""

    @property
    @abstractmethod
    def period(self) -> Any:
        """Period [s], or None if the reference does not repeat."""

    @abstractmethod
    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the leg poses (N, C, L) at times (N,) [s] since the episode's start."""

    @abstractmethod
    def extent(self) -> Extent:
        """Return the minimum and maximum of each coordinate over all legs, times and commands."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the equivalent configuration as JSON values."""

    @property
    def feedforward(self) -> Feedforward:
        """Feedforward gains."""
        return Feedforward()

    @property
    def is_clipped(self) -> bool:
        """Whether commands are clipped to the legs' range, so that reference plus feedback may exceed it."""
        return False

    @property
    def following(self) -> FollowingReference | None:
        """The reference itself if it follows commands, otherwise None."""
        return None

    @property
    def foothold_radius(self) -> float:
        """Maximum distance [m] of footholds from nominal stride positions, see `Footholds`."""
        return 0.0

    @property
    def touch_clearance(self) -> float:
        """Maximum additional lift [m] of feet after contact in swing, see `ContactReflex`."""
        return 0.0

    @property
    def over_holes(self) -> FollowingReference | None:
        """The second gait for terrain with holes, or None; see `GaitSwitch`."""
        return None

    def frequency(self, command: Array, over_holes: Array | None = None) -> Array:
        """Return the gait frequency (N,) [Hz] for commands (N, 3) and the blend weight of the gait over holes (N,)."""
        return np.full(len(command), 1.0 / self.period if self.period else 0.0)

    def pose_rate(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the velocities of leg poses (N, C, L) at times (N,) [s], in units of leg space per second."""
        time = np.asarray(time, float)
        return (self.pose(time + RATE_STEP) - self.pose(time - RATE_STEP)) / (2 * RATE_STEP)

    def pose_and_rate(self, time: ArrayLike, state: CommandState | None = None) -> tuple[Array, Array]:
        """Return the leg poses and their velocities, (N, C, L) each, see `pose` and `pose_rate`."""
        return self.pose(time, state), self.pose_rate(time, state)

    def pose_acceleration(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the accelerations of leg poses (N, C, L) at times (N,) [s], in leg space units per second squared."""
        time = np.asarray(time, float)
        before, now, after = (self.pose(time + k * ACCELERATION_STEP) for k in (-1, 0, 1))
        return (after - 2.0 * now + before) / ACCELERATION_STEP**2

    def load(self, state: CommandState | None = None) -> Array:
        """Return the fraction of the weight on each leg (L,): equal for all legs, because stance is unknown."""
        legs = self.pose(0.0).shape[-1]
        return np.full(legs, 1.0 / legs)


@dataclass(frozen=True)
class FollowingReference(Reference):
    """Reference whose strides follow the commanded velocity. A standing robot keeps its feet on the ground.

    Raises:
        SurefootError: a stride out of the legs' reach.
    """

    choice: StrideChoice
    """Strides and frequency for commands."""
    feedforward: Feedforward = Feedforward()
    _extent: Extent = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check that legs reach all strides and footholds."""
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
                "reference.foothold_radius and reference.touch_clearance together move feet out of the legs' "
                "reach; decrease one of them"
            )

    @property
    def following(self) -> FollowingReference:
        """The reference itself."""
        return self

    @property
    def is_clipped(self) -> bool:
        """Whether commands are clipped to the legs' range, so that reference plus feedback may exceed it."""
        return self.feedforward.moves_poses

    @property
    def kinematics(self) -> SteppingKinematics:
        """Kinematics of the feet."""
        return self.choice.kinematics

    @property
    def robot(self) -> RobotDescription:
        """The robot."""
        return self.kinematics.robot

    @property
    def feet(self) -> FootPaths:
        """Foot trajectories when stepping in place. Their stroke is the maximum stride."""
        return self.kinematics.feet

    @property
    def neutral_feet(self) -> Array:
        """Neutral foot positions relative to the legs' mounts (L, 3) [m]; z is the height."""
        return self.kinematics.neutral_feet

    @property
    def limits(self) -> CommandLimits:
        """Limits of the commands."""
        return self.choice.limits

    @property
    def foothold_radius(self) -> float:
        """Maximum distance [m] of footholds from nominal stride positions, see `Footholds`."""
        return self.kinematics.foothold_radius

    @property
    def touch_clearance(self) -> float:
        """Maximum additional lift [m] of feet after contact in swing, see `ContactReflex`."""
        return self.kinematics.touch_clearance

    @property
    def period(self) -> float:
        """Period of a cycle when stepping in place [s]."""
        return float(self.feet.period)

    def strides(self, command: Array) -> Array:
        """Return the strides forward and to the left (N, L, 2) [m] for commands (N, 3), up to the maximum stride."""
        return self.choice.choose(command)[0]

    def frequency(self, command: Array, over_holes: Array | None = None) -> Array:
        """Return the gait frequency (N,) [Hz] for commands (N, 3)."""
        return self.choice.frequency(command)

    def load(self, state: CommandState | None = None) -> Array:
        """Return the fraction of the weight on each leg (N, L), equal for all legs in stance."""
        assert state is not None
        return self.kinematics.load(state)

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the leg poses (..., N, C, L) for the state's commands and phases (..., N); `time` is not used."""
        assert state is not None
        return self.kinematics.pose(state, *self.choice.choose(state.command))

    def pose_rate(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the velocities of leg poses (N, C, L) [leg space units per second] for commands and phases."""
        return self.pose_and_rate(time, state)[1]

    def pose_and_rate(self, time: ArrayLike, state: CommandState | None = None) -> tuple[Array, Array]:
        """Return the leg poses and their velocities, (N, C, L) each, for commands and phases."""
        assert state is not None
        # The frequency of the first gait, also while the gait over holes is active.
        change = RATE_STEP * self.choice.frequency(state.command)
        # One call for three phases takes half the time of three calls.
        phases = np.stack([state.phase, state.phase - change, state.phase + change])
        pose, before, after = self.pose(time, replace(state, phase=phases))
        return pose, (after - before) / (2 * RATE_STEP)

    def pose_acceleration(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the accelerations of leg poses (N, C, L) for commands and phases."""
        assert state is not None
        change = ACCELERATION_STEP * self.choice.frequency(state.command)
        before, now, after = (self.pose(time, replace(state, phase=state.phase + k * change)) for k in (-1, 0, 1))
        return (after - 2.0 * now + before) / ACCELERATION_STEP**2

    def extent(self) -> Extent:
        """Return the minimum and maximum of each coordinate over all legs, phases and commands."""
        return self._extent

    def to_dict(self) -> dict[str, Any]:
        """Return the equivalent configuration as JSON values."""
        choice, kinematics, feedforward = self.choice, self.kinematics, self.feedforward
        gains = {name: getattr(choice, name) for name in ("stride_gain", "frequency_rise", "turn_gain")}
        names = ("clearance_rise", "height_rise", "foothold_radius", "touch_clearance")
        optional = {name: getattr(kinematics, name) for name in names}
        optional |= {"acceleration_feedforward": feedforward.acceleration, "weight_feedforward": feedforward.weight}
        velocity = {"velocity_feedforward": feedforward.velocity} if feedforward.velocity else {}
        nonzero = {name: value for name, value in optional.items() if value}
        return {"kind": "follow", "foot": self.feet.to_dict(), **velocity, **gains, **nonzero}
