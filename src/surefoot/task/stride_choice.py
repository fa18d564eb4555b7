"""Strides and step frequency for commands.

With the commanded velocity v and yaw rate w, the foot of a leg mounted at r goes backward by (v + w x r) times the time
of stance, times a gain for what is lost to slip and soft legs. Without commands feet are lifted on the spot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.robot.commands import CommandLimits
from surefoot.task.commands import MAX_HEADING_ERROR, CommandState
from surefoot.task.foot_kinematics import FootKinematics

_STRIDE_PHASES = 48
"""Phases of a cycle at which strides are checked."""
_FOOTHOLD_PHASES = 12
"""Phases at which lifts and footholds are checked too: this is done whenever a robot is made."""
_TURNS = 8
"""Directions of footholds that are checked."""


@dataclass(frozen=True)
class StrideChoice:
    """Strides of a robot's L legs, and their frequency, for N commands."""

    kinematics: FootKinematics
    """Feet that take the strides; frequency, stroke and duty factor are those on the spot."""
    limits: CommandLimits
    """Limits of the commands."""
    stride_gain: float
    """Length of a stride relative to the stride of a foot that does not slip."""
    frequency_rise: float
    """Frequency gained at the longest stride, relative to the frequency on the spot."""
    turn_gain: float = 1.0
    """Part of a stride for turning, relative to that of a foot that does not slip. Legs without abduction turn a robot
    only as far as they make feet slide."""

    def _in_place_strides(self, command: Array) -> tuple[Array, Array]:
        """Return the strides (N, L, 2) [m] that commands (N, 3) need at the frequency on the spot, and their share.

        The share (N,) is the ratio of the longest stride to the longest allowed, at most 1.
        """
        robot, feet = self.kinematics.robot, self.kinematics.feet
        x, y = robot.leg_mounts[:, 0], robot.leg_mounts[:, 1] + self.kinematics.places[:, 1]
        turn = self.turn_gain * command[:, 2:]
        forward, aside = command[:, :1] - turn * y, command[:, 1:2] + turn * x
        if "abduction" not in robot.coordinates:
            aside = np.zeros_like(aside)
        stance = feet.duty_factor / feet.frequency
        stride = self.stride_gain * stance[:, None] * np.stack([forward, aside], -1)
        share = np.linalg.norm(stride, axis=-1) / np.maximum(feet.stroke, 1e-9)
        return stride, np.minimum(share.max(axis=-1), 1.0)

    def choose(self, command: Array) -> tuple[Array, Array]:
        """Return the strides (N, L, 2) [m] forward and to the left for commands (N, 3), and their share (N,).

        Strides are no longer than allowed; the share is the ratio of the longest to the longest allowed. A higher
        frequency comes with longer strides, so that feet keep the commanded speed.
        """
        stride, share = self._in_place_strides(command)
        stride = stride / (1.0 + self.frequency_rise * share)[:, None, None]
        length = np.linalg.norm(stride, axis=-1, keepdims=True)
        longest = self.kinematics.feet.stroke[:, None]
        return np.asarray(stride * np.minimum(1.0, longest / np.maximum(length, 1e-9))), share

    def frequency(self, command: Array) -> Array:
        """Return the frequency (N,) [Hz] at commands (N, 3)."""
        _, share = self._in_place_strides(command)
        return np.asarray(self.kinematics.feet.frequency * (1.0 + self.frequency_rise * share))

    def extremes(self) -> CommandState:
        """Return the states in which legs are furthest from their places: strides all around, at every phase."""
        limits, kinematics = self.limits, self.kinematics
        corners = np.array(np.meshgrid(*zip(limits.low, limits.high, strict=True))).reshape(3, -1).T
        rate = np.max(np.abs(limits.yaw_rate)) + limits.heading_gain * MAX_HEADING_ERROR
        corners[:, 2] = np.where(corners[:, 2] > 0, rate, -rate)
        corners = np.concatenate([corners, corners * [1, 1, 0], np.zeros((1, 3))])
        phase = np.tile(np.arange(_STRIDE_PHASES) / _STRIDE_PHASES, len(corners))
        lift = np.full((len(phase), len(kinematics.feet.legs)), kinematics.touch_clearance)
        return CommandState(np.repeat(corners, _STRIDE_PHASES, axis=0), np.ones(len(phase)), phase, lift=lift)

    def foothold_extremes(self) -> CommandState:
        """Return states of `extremes` with feet lifted by all heights, and footholds all around their places."""
        states, kinematics = self.extremes(), self.kinematics
        legs = len(kinematics.feet.legs)
        every = np.arange(0, len(states.phase), _STRIDE_PHASES // _FOOTHOLD_PHASES)
        turns, lifts, radii = np.arange(_TURNS) / _TURNS, np.linspace(0.0, 1.0, 6), np.linspace(0.25, 1.0, 4)
        turn, lift, radius, k = (grid.ravel() for grid in np.meshgrid(turns, lifts, radii, every, indexing="ij"))
        way = np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], axis=-1)
        beside = np.repeat((kinematics.foothold_radius * radius[:, None] * way)[:, None], legs, axis=1)
        height = np.repeat(kinematics.touch_clearance * lift[:, None], legs, axis=1)
        return CommandState(states.command[k], states.activity[k], states.phase[k], beside, beside, height)
