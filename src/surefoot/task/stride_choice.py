"""Strides and step frequency as functions of the command.

For a commanded velocity v and yaw rate w, the foot of a leg mounted at r moves backward by (v + w x r) times the stance
duration, times a gain that compensates for slip and soft legs. With zero command, feet step in place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.robot.commands import CommandLimits
from surefoot.task.commands import MAX_HEADING_ERROR, CommandState
from surefoot.task.stepping_kinematics import SteppingKinematics

_STRIDE_PHASES = 48
"""Number of phases of a cycle at which the reach of strides is checked."""
_FOOTHOLD_PHASES = 12
"""Number of phases at which lifts and footholds are also checked: few, because every construction of a gait does it."""
_FOOTHOLD_DIRECTIONS = 8
"""Number of foothold directions that are checked."""


@dataclass(frozen=True)
class StrideChoice:
    """Strides of L legs and gait frequency for N commands."""

    kinematics: SteppingKinematics
    """Kinematics of the feet, with frequency and duty factor when stepping in place, and the maximum stride."""
    limits: CommandLimits
    """Limits of the commands."""
    stride_gain: float
    """Stride length relative to the stride of a foot that does not slip."""
    frequency_rise: float
    """Increase of the frequency at the maximum stride, relative to the frequency when stepping in place."""
    turn_gain: float = 1.0
    """Gain on the part of a stride that turns the robot. Legs without abduction turn a robot only by sliding feet."""

    def _in_place_strides(self, command: Array) -> tuple[Array, Array]:
        """Return the strides (N, L, 2) [m] for commands (N, 3) at the frequency of stepping in place, without limit.

        The second result is the ratio (N,) of the longest stride to the maximum stride, at most 1.
        """
        robot, feet = self.kinematics.robot, self.kinematics.feet
        x, y = robot.leg_mounts[:, 0], robot.leg_mounts[:, 1] + self.kinematics.neutral_feet[:, 1]
        turn = self.turn_gain * command[:, 2:]
        forward, lateral = command[:, :1] - turn * y, command[:, 1:2] + turn * x
        if "abduction" not in robot.coordinates:
            lateral = np.zeros_like(lateral)
        stance = feet.duty_factor / feet.frequency
        stride = self.stride_gain * stance[:, None] * np.stack([forward, lateral], -1)
        stride_fraction = _length(stride) / np.maximum(feet.stroke, 1e-9)
        return stride, np.minimum(stride_fraction.max(axis=-1), 1.0)

    def choose(self, command: Array) -> tuple[Array, Array]:
        """Return strides forward and to the left (N, L, 2) [m] for commands (N, 3), up to the maximum stride.

        The second result (N,) is the ratio of the longest stride to the maximum stride, at most 1. It raises the
        frequency, and strides become shorter accordingly, so that feet keep the commanded speed.
        """
        stride, stride_fraction = self._in_place_strides(command)
        stride = stride / (1.0 + self.frequency_rise * stride_fraction)[:, None, None]
        length = _length(stride)[..., None]
        longest = self.kinematics.feet.stroke[:, None]
        return np.asarray(stride * np.minimum(1.0, longest / np.maximum(length, 1e-9))), stride_fraction

    def frequency(self, command: Array) -> Array:
        """Return the gait frequency (N,) [Hz] for commands (N, 3)."""
        _, stride_fraction = self._in_place_strides(command)
        return np.asarray(self.kinematics.feet.frequency * (1.0 + self.frequency_rise * stride_fraction))

    def extremes(self) -> CommandState:
        """Return the states in which legs are furthest from their neutral positions: extreme commands at all phases."""
        limits, kinematics = self.limits, self.kinematics
        corners = np.array(np.meshgrid(*zip(limits.low, limits.high, strict=True))).reshape(3, -1).T
        rate = np.max(np.abs(limits.yaw_rate)) + limits.heading_gain * MAX_HEADING_ERROR
        corners[:, 2] = np.where(corners[:, 2] > 0, rate, -rate)
        corners = np.concatenate([corners, corners * [1, 1, 0], np.zeros((1, 3))])
        phase = np.tile(np.arange(_STRIDE_PHASES) / _STRIDE_PHASES, len(corners))
        lift = np.full((len(phase), len(kinematics.feet.legs)), kinematics.touch_clearance)
        return CommandState(np.repeat(corners, _STRIDE_PHASES, axis=0), np.ones(len(phase)), phase, lift=lift)

    def foothold_extremes(self) -> CommandState:
        """Return the states of `extremes` combined with lifts of all heights and footholds in all directions."""
        states, kinematics = self.extremes(), self.kinematics
        legs = len(kinematics.feet.legs)
        every = np.arange(0, len(states.phase), _STRIDE_PHASES // _FOOTHOLD_PHASES)
        turns, lifts, radii = (
            np.arange(_FOOTHOLD_DIRECTIONS) / _FOOTHOLD_DIRECTIONS,
            np.linspace(0.0, 1.0, 6),
            np.linspace(0.25, 1.0, 4),
        )
        turn, lift, radius, k = (grid.ravel() for grid in np.meshgrid(turns, lifts, radii, every, indexing="ij"))
        direction = np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], axis=-1)
        offset = np.repeat((kinematics.foothold_radius * radius[:, None] * direction)[:, None], legs, axis=1)
        height = np.repeat(kinematics.touch_clearance * lift[:, None], legs, axis=1)
        return CommandState(states.command[k], states.activity[k], states.phase[k], offset, offset, height)


def _length(vectors: Array) -> Array:
    """Return the lengths (...) of vectors (..., 2), in a third of the time of `np.linalg.norm`."""
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2)
