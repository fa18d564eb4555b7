"""A reference gait that follows commands: foot trajectories whose strides have the commanded speed and direction.

A foot in stance moves against the base's motion at its place: with the commanded velocity v and yaw rate w, the foot of
a leg mounted at r goes backward by (v + w x r) times the time of stance, times a gain for what is lost to slip and soft
legs. Without commands feet are lifted on the spot; a robot that stands keeps them on the ground.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task.commands import MAX_HEADING_ERROR, CommandState
from surefoot.task.foot import RATE_STEP, FootReference

_PHASES = 48


@dataclass(frozen=True)
class FollowingReference:
    """Feet that follow commands.

    Raises:
        SurefootError: a stride out of the legs' reach.
    """

    robot: RobotDescription
    feet: FootReference
    """Frequency, clearance, phases and posture of the feet; its stroke is the longest stride."""
    limits: CommandLimits
    """Commands that are followed."""
    stride_gain: float
    """Length of a stride over that of a foot that does not slip."""
    frequency_rise: float
    """Frequency gained at the greatest stride, over the frequency on the spot."""
    turn_gain: float = 1.0
    """What a stride has for turning, over that of a foot that does not slip. Legs without abduction turn a robot only
    as far as they make feet slide."""
    places: Array = field(init=False, repr=False)
    """Feet below the legs' mounts, (L, 3) [m] from the mounts; z is the height."""
    _extent: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check that legs reach every stride."""
        legs, resting = self.robot.leg_geometry, self._resting()
        _, aside, below = legs.foot_position(resting).T
        axis = below - legs.foot_in_plane(resting)[:, 1]
        places = np.stack(np.broadcast_arrays(self.feet.offset, aside, axis - self.feet.height), -1)
        object.__setattr__(self, "places", places)
        poses = self.pose(0.0, self._extremes())
        if not np.isfinite(poses).all():
            leg = self.feet.legs[int(np.argwhere(~np.isfinite(poses))[0][-1])]
            raise SurefootError(
                f"reference.foot: a stride of {leg} is out of the leg's reach; "
                "change height, stroke, depth or clearance"
            )
        extent = tuple((float(part.min()), float(part.max())) for part in np.moveaxis(poses, -2, 0))
        object.__setattr__(self, "_extent", extent)

    def _resting(self) -> Array:
        """Return the motor angles (L, m) of legs without abduction or swing."""
        pose = np.array(self.robot.rest)
        pose[:-1] = 0.0
        return self.robot.leg_geometry.to_motors(np.repeat(pose[:, None], len(self.feet.legs), axis=1))

    def _extremes(self) -> CommandState:
        """Return the states in which legs are furthest from their places: strides all around, at every phase."""
        corners = np.array(np.meshgrid(*zip(self.limits.low, self.limits.high, strict=True))).reshape(3, -1).T
        rate = np.max(np.abs(self.limits.yaw_rate)) + self.limits.heading_gain * MAX_HEADING_ERROR
        corners[:, 2] = np.where(corners[:, 2] > 0, rate, -rate)
        corners = np.concatenate([corners, corners * [1, 1, 0], np.zeros((1, 3))])
        phase = np.tile(np.arange(_PHASES) / _PHASES, len(corners))
        return CommandState(np.repeat(corners, _PHASES, axis=0), np.ones(len(phase)), phase)

    @property
    def period(self) -> float:
        """Time of a step on the spot [s]."""
        return float(self.feet.period)

    def _on_the_spot(self, command: Array) -> tuple[Array, Array]:
        """Return the strides (N, L, 2) [m] that commands (N, 3) need at the frequency on the spot, and their share.

        The share (N,) is that of the longest over the longest allowed, at most 1.
        """
        x, y = self.robot.leg_mounts[:, 0], self.robot.leg_mounts[:, 1] + self.places[:, 1]
        turn = self.turn_gain * command[:, 2:]
        forward, aside = command[:, :1] - turn * y, command[:, 1:2] + turn * x
        if "abduction" not in self.robot.coordinates:
            aside = np.zeros_like(aside)
        stance = self.feet.duty_factor / self.feet.frequency
        stride = self.stride_gain * stance[:, None] * np.stack([forward, aside], -1)
        share = np.linalg.norm(stride, axis=-1) / np.maximum(self.feet.stroke, 1e-9)
        return stride, np.minimum(share.max(axis=-1), 1.0)

    def strides(self, command: Array) -> Array:
        """Return the strides (N, L, 2) [m] forward and to the left for commands (N, 3), no longer than allowed.

        A higher frequency comes with longer strides, so that feet keep the commanded speed.
        """
        stride, share = self._on_the_spot(command)
        stride = stride / (1.0 + self.frequency_rise * share)[:, None, None]
        length = np.linalg.norm(stride, axis=-1, keepdims=True)
        return np.asarray(stride * np.minimum(1.0, self.feet.stroke[:, None] / np.maximum(length, 1e-9)))

    def frequency(self, command: Array) -> Array:
        """Return the frequency (N,) [Hz] at commands (N, 3)."""
        _, share = self._on_the_spot(command)
        return np.asarray(self.feet.frequency * (1.0 + self.frequency_rise * share))

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at what the gait follows, whatever the times (N,)."""
        assert state is not None
        along, bump = self.feet.curve(state.phase)
        active = state.activity[:, None]
        step = (active * along)[..., None] * self.strides(state.command)
        foot = np.concatenate([step, (active * bump)[..., None]], axis=-1) + self.places
        return self.robot.leg_geometry.foot_pose(foot)

    @property
    def velocity_feedforward(self) -> float:
        """Time [s] by which commands lead along the velocity of the pose."""
        return self.feet.velocity_feedforward

    def pose_rate(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the velocities (N, C, L) of the poses at what the gait follows, in units of leg space a second."""
        assert state is not None
        change = RATE_STEP * self.frequency(state.command)
        before, after = (self.pose(time, replace(state, phase=state.phase + sign * change)) for sign in (-1, 1))
        return (after - before) / (2 * RATE_STEP)

    def extent(self) -> tuple[tuple[float, float], ...]:
        """Return the lowest and highest value of each coordinate over all legs, phases and commands."""
        return self._extent

    def to_dict(self) -> dict[str, Any]:
        """Return the `ReferenceConfig` that makes it again, as JSON values."""
        gains = {name: getattr(self, name) for name in ("stride_gain", "frequency_rise", "turn_gain")}
        return {**self.feet.to_dict(), "kind": "follow", **gains}
