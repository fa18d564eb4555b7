"""Contact reflex: feet that hit an obstacle in swing are lifted higher, for some strides.

A swinging foot that lags far behind its command has hit a step or a stone. The lag is computed from motor angles, so
that feet need no sensors.
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

CONTACT_LAG = 0.12
"""Lag of a foot behind its command that indicates contact, in lengths l of the straight leg. Feet of soft legs lag less
in free swing."""
_MIN_SWING_PHASE, _MAX_SWING_PHASE = 0.2, 0.95
"""Swing phase in which contact is detected: before, the foot may still stand, and after, it may have landed."""
_FILTER_TIME = 0.2
"""Time constant [sqrt(l / g)] of the low-pass filter on the lag, against commands that vary from step to step."""
_LIFT_RATE = 1.7
"""Rate at which the lift grows in contact [l / sqrt(l / g)]."""
_LIFT_DECAY_TIME = 15.0
"""Time constant [sqrt(l / g)] with which the lift decays in stance: some strides."""
_MIN_STRIDE = 0.07
"""Minimum stride length [l] at which contact is detected: shorter strides have no direction."""


class ContactReflex(RobotComponent):
    """Additional lift of the feet of N robots with L legs after contact in swing.

    Args:
        reference: reference gait with a `touch_clearance`.
        num_envs: number of robots.
    """

    prefix = "touch"
    changing = ("lift", "behind", "commanded")

    def __init__(self, reference: FollowingReference, num_envs: int) -> None:
        self.reference, legs = reference, reference.robot.leg_geometry
        self._length = float(legs.length)
        self.lift = np.zeros((num_envs, len(reference.neutral_feet)))
        """Additional lift of each foot in the middle of its swing (N, L) [m]."""
        self.behind = np.zeros(self.lift.shape)
        """Low-pass filtered lag of each foot behind its command, in the direction of its stride (N, L) [m]."""
        self.commanded = np.zeros((*self.lift.shape, 3))
        """Foot positions of the second-to-last command, relative to the legs' mounts (N, L, 3) [m]. This matches the
        delay of actuators."""

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Start episodes without lift."""
        for array in (self.lift, self.behind, self.commanded):
            array[rows] = 0.0
        self.publish(state)

    def after_step(self, state: RobotState) -> None:
        """Detect contacts from measured and commanded foot positions, and update the lift."""
        assert state.gait_state is not None
        self.update(state.target, state.readings.motor_angle, state.gait_state, state.duration)
        self.publish(state)

    def publish(self, state: RobotState) -> None:
        """Write the lift to the gait's state."""
        assert state.gait_state is not None
        state.gait_state = replace(state.gait_state, lift=self.lift)

    def update(self, target: Array, measured: Array, state: CommandState, step: Array) -> None:
        """Advance by one control step.

        Args:
            target: commanded motor angles (N, M) [rad].
            measured: motor angles measured at the end of the control step (N, M) [rad].
            state: state of the gait.
            step: duration of the control step (N,) [s].
        """
        reference = self.reference
        time = step[:, None] / reference.robot.natural_time
        stride = state.activity[:, None, None] * reference.strides(state.command)
        size = np.linalg.norm(stride, axis=-1)
        error = np.nan_to_num(self.commanded - self._feet(measured))  # NaN: motor angles that no closed leg has
        lag = (error[..., :2] * stride).sum(axis=-1) / np.maximum(size, 1e-9)
        self.behind += np.minimum(time / _FILTER_TIME, 1.0) * (lag - self.behind)
        phase = reference.feet.swing_phase(state.phase)
        swings = (phase > _MIN_SWING_PHASE) & (phase < _MAX_SWING_PHASE) & (size > _MIN_STRIDE * self._length)
        contact = swings & (self.behind > CONTACT_LAG * self._length)
        if state.over_holes is not None:
            # A foot that swings to a distant foothold lags without contact.
            contact &= state.over_holes[:, None] == 0.0
        raised = np.minimum(self.lift + _LIFT_RATE * self._length * time, reference.touch_clearance)
        decayed = np.where(phase < 0.0, self.lift * np.exp(-time / _LIFT_DECAY_TIME), self.lift)
        self.lift = np.where(contact, raised, decayed)
        self.commanded = self._feet(target)

    def _feet(self, angles: Array) -> Array:
        robot = self.reference.robot
        return np.asarray(robot.leg_geometry.foot_position(angles[:, robot.leg_motor_index]))
