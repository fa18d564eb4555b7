"""Balance of a gait over holes: linear feedback of attitude and speed on the poses of its legs.

After Raibert 1986, "Legged Robots That Balance": legs in stance turn the base back by their lengths and push it to its
speed, legs in swing land where they slow it down. All inputs are measured: roll, pitch and their rates by an IMU, the
speed by the motors of legs in stance, whose feet are assumed to stand still.

Angles are split into slow means, the slope that the robot stands on, and what they differ from them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot import GRAVITY
from surefoot.task.commands import CommandState
from surefoot.task.foot_references import FollowingReference
from surefoot.task.reference import Reference
from surefoot.world.interface import Readings

_SLOW = 2.4
"""Time constant [sqrt(l / g)] of the means of roll, pitch and of the speed error: some strides."""
_SPEED_FILTER = 0.2
"""Time constant [sqrt(l / g)] of the speed."""
_FASTEST = 1.0
"""Greatest speed error that counts [sqrt(g l)]."""


class Balance:
    """Poses that balance adds, of N robots with L legs and C coordinates a leg.

    Args:
        reference: with gains of the balance; numbers, or arrays (N, 1) where each robot has its own.
        num_envs: robots.
    """

    arrays = ("pose", "slow", "speed", "slow_speed")
    """Names of the arrays that change over time."""

    def __init__(self, reference: FollowingReference, num_envs: int) -> None:
        self.reference, self.gains, self.robot = reference, reference.balance, reference.robot
        robot = self.robot
        length = float(robot.leg_geometry.length)
        self._time, self._speed_unit = np.sqrt(length / GRAVITY), np.sqrt(length * GRAVITY)
        self._ahead, self._left = np.sign(robot.leg_mounts[:, 0]), np.sign(robot.leg_mounts[:, 1])
        self.pose = np.zeros((num_envs, len(robot.coordinates), len(robot.legs)))
        """What is added to the legs' poses (N, C, L)."""
        self.slow = np.zeros((num_envs, 2))
        """Slow means of roll and pitch (N, 2) [rad]."""
        self.speed = np.zeros((num_envs, 2))
        """Speed forward and to the left, by legs in stance (N, 2) [sqrt(g l)]."""
        self.slow_speed = np.zeros((num_envs, 1))
        """Slow mean of the speed forward beyond its command (N, 1) [sqrt(g l)]."""

    @classmethod
    def of(cls, reference: Reference, num_envs: int) -> Balance | None:
        """Return that of a reference's gait over holes; None, if it has none."""
        if isinstance(reference, FollowingReference) and reference.over_holes is not None:
            return cls(reference.over_holes, num_envs)
        return None

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Let robots stand on level ground."""
        for array in (self.pose, self.slow, self.speed, self.slow_speed):
            array[rows] = 0.0

    def update(self, readings: Readings, state: CommandState, step: Array) -> None:
        """Go on by a control step.

        Args:
            readings: at its end.
            state: what the gait follows.
            step: its duration (N,) [s].
        """
        gains, swings, time = self.gains, self.reference.swings(state), step[:, None] / self._time
        slow = np.minimum(time / _SLOW, 1.0)
        angles = readings.roll_pitch_yaw[:, :2]
        self.slow += slow * (angles - self.slow)
        roll, pitch = (angles - self.slow).T[..., None]
        mean_roll, mean_pitch = self.slow.T[..., None]
        roll_rate, pitch_rate = readings.angular_velocity_base[:, :2].T[..., None] * self._time
        measured, stands = self._measure_speed(readings, swings)
        self.speed += np.minimum(time / _SPEED_FILTER, 1.0) * np.where(stands, measured - self.speed, 0.0)
        fast = np.clip(self.speed - state.command[:, :2] / self._speed_unit, -_FASTEST, _FASTEST)
        forward, aside = fast.T[..., None]
        self.slow_speed += slow * (forward - self.slow_speed)

        def phase(name: str) -> Array:
            return np.where(swings, getattr(gains.swing, name), getattr(gains.stance, name))

        low_end = phase("pitch_extension") * pitch + phase("pitch_rate_extension") * pitch_rate
        low_end = low_end + gains.slope_extension * mean_pitch
        low_side = phase("roll_extension") * roll + phase("roll_rate_extension") * roll_rate
        swing = phase("pitch_swing") * pitch + phase("pitch_rate_swing") * pitch_rate - phase("speed_swing") * forward
        swing = swing + gains.slope_swing * mean_pitch - gains.slow_speed_swing * self.slow_speed
        outward = phase("roll_abduction") * roll + phase("roll_rate_abduction") * roll_rate
        outward = outward + phase("speed_abduction") * aside + gains.slope_abduction * mean_roll
        parts = [swing, low_end * self._ahead - low_side * self._left]
        if "abduction" in self.robot.coordinates:
            parts = [outward * self._left, *parts]
        self.pose = state.activity[:, None, None] * np.stack(parts, axis=1)

    def _measure_speed(self, readings: Readings, swings: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
        """Return the speeds (N, 2) [sqrt(g l)] by legs in stance, and whether there is one (N, 1)."""
        legs, index = self.robot.leg_geometry, self.robot.leg_motor_index
        angle, rate = readings.motor_angle[:, index], readings.motor_velocity[:, index]
        foot = np.asarray(legs.foot_position(angle)) + self.robot.leg_mounts
        moves = np.einsum("nlij,nlj->nli", legs.jacobian(angle), rate)
        moves = moves + np.cross(readings.angular_velocity_base[:, None], foot)
        stands = np.isfinite(moves).all(axis=-1) & ~swings
        count = stands.sum(axis=1)[:, None]
        speed = -np.where(stands[..., None], moves, 0.0).sum(axis=1) / np.maximum(count, 1)
        return np.asarray(speed[:, :2] / self._speed_unit), count > 0
