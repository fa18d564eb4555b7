"""Feet that meet something in their swing are lifted further, until they have met nothing for some strides.

A swinging foot that stays far behind its command has met a step or a stone. That is computed from motor angles: feet
need no sensors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.task.commands import CommandState
from surefoot.task.component import RobotComponent
from surefoot.task.reference import FollowingReference
from surefoot.task.state import RobotState

BEHIND = 0.12
"""A foot has met something that is further than this behind its command, in lengths l of the straight leg: a free one
of soft legs lags by less."""
_FIRST, _MAX_SWING_PHASE = 0.2, 0.95
"""Part of the swing in which it is looked at: before, it may still stand, and then it may have landed."""
_FILTER = 0.2
"""Time constant [sqrt(l / g)] of that distance: commands that differ from step to step are no obstacles."""
_LIFT_RATE = 1.7
"""By how much the lift grows in a time sqrt(l / g), in l."""
_LIFT_DECAY_TIME = 15.0
"""Time constant [sqrt(l / g)] with which the lift is forgotten, some strides."""
_MIN_STRIDE = 0.07
"""Shortest stride [l] that has a direction in which a foot can meet something."""


class ContactReflex(RobotComponent):
    """Additional lift of the feet of N robots with L legs after contact in swing.

    Args:
        reference: with `touch_clearance`.
        num_envs: robots.
    """

    prefix = "touch"
    changing = ("lift", "behind", "commanded")

    def __init__(self, reference: FollowingReference, num_envs: int) -> None:
        self.reference, legs = reference, reference.robot.leg_geometry
        self._length = float(legs.length)
        self.lift = np.zeros((num_envs, len(reference.places)))
        """Height [m] by which feet are lifted further in the middle of their swings, (N, L)."""
        self.behind = np.zeros(self.lift.shape)
        """How far feet are behind their commands in the direction of their strides, low-pass filtered [m] (N, L)."""
        self.commanded = np.zeros((*self.lift.shape, 3))
        """Feet of the last command but one, from the legs' mounts [m] (N, L, 3): actuators take that long."""

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Let robots stand that have met nothing."""
        for array in (self.lift, self.behind, self.commanded):
            array[rows] = 0.0
        self.publish(state)

    def after_step(self, state: RobotState) -> None:
        """Compare the measured feet with the commanded feet, and lift those that met something."""
        assert state.gait_state is not None
        self.update(state.target, state.readings.motor_angle, state.gait_state, state.duration)
        self.publish(state)

    def publish(self, state: RobotState) -> None:
        """Write the lift to what the gait follows."""
        assert state.gait_state is not None
        state.gait_state = replace(state.gait_state, lift=self.lift)

    def update(self, target: Array, measured: Array, state: CommandState, step: Array) -> None:
        """Go on by a control step.

        Args:
            target: motor angles (N, M) [rad] that were commanded.
            measured: those at its end.
            state: what the gait follows.
            step: its duration (N,) [s].
        """
        reference = self.reference
        time = step[:, None] / reference.robot.natural_time
        stride = state.activity[:, None, None] * reference.strides(state.command)
        size = np.linalg.norm(stride, axis=-1)
        missing = np.nan_to_num(self.commanded - self._feet(measured))  # NaN: a leg that can't close
        now = (missing[..., :2] * stride).sum(axis=-1) / np.maximum(size, 1e-9)
        self.behind += np.minimum(time / _FILTER, 1.0) * (now - self.behind)
        part = reference.feet.swing_phase(state.phase)
        swings = (part > _FIRST) & (part < _MAX_SWING_PHASE) & (size > _MIN_STRIDE * self._length)
        met = swings & (self.behind > BEHIND * self._length)
        if state.over_holes is not None:
            # A foot on its way to a foothold far beside its stride is behind without having met anything.
            met &= state.over_holes[:, None] == 0.0
        raised = np.minimum(self.lift + _LIFT_RATE * self._length * time, reference.touch_clearance)
        self.lift = np.where(met, raised, np.where(part < 0.0, self.lift * np.exp(-time / _LIFT_DECAY_TIME), self.lift))
        self.commanded = self._feet(target)

    def _feet(self, angles: Array) -> Array:
        robot = self.reference.robot
        return np.asarray(robot.leg_geometry.foot_position(angles[:, robot.leg_motor_index]))
