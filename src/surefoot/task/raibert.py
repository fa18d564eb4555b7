"""Raibert's controller: classical feedback on top of foot trajectories.

Raibert 1986, "Legged Robots That Balance", and the quadruped's three parts of control: speed by the place where feet
land, attitude by torques and lengths of legs in stance, and a gait that a clock gives. A foot lands at

    x = v T / 2 + k (v - v_d)

before its leg's neutral place, where v is the speed forward, v_d the desired one and T the time of a stance. The
trajectory's own stroke already is v_d T, so what is added to it is (T / 2 + k) (v - v_d).

Its inputs are what a robot measures: roll, pitch, their rates, motor angles and speeds, and its own clock. The speed
forward is estimated from the motors of legs that are in stance by the clock, whose feet are assumed to stand still.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.configuration import Within
from surefoot.errors import SurefootError, choices
from surefoot.robot import RobotDescription
from surefoot.task.foot_paths import FootPaths

OBSERVATIONS = ("roll", "pitch", "roll_rate", "pitch_rate", "motor_angles", "motor_speeds", "reference_phase")
"""Observations of the controller, in this order."""
HISTORY = 25
"""Default number of observations over which the speed is estimated: .15 s of control steps of 6 ms."""
_STEP = 1e-4
"""Time step [s] of the numerical derivative of a foot's position."""
_EDGE = 0.2
"""Part of a stance at its begin, and at its end, that is left out: the foot may be in the air."""

Gain = Annotated[float, Within(-100, 100)]


@dataclass(frozen=True)
class RaibertConfig:
    """Gains of the controller."""

    speed: Gain = 0.0
    """k: how much further ahead a foot lands for a speed above the desired one [m per m/s]."""
    pitch: Gain = 0.0
    """Length that front legs gain, and hind legs lose, with pitch, per metre from the base's middle [m/m/rad]."""
    pitch_rate: Gain = 0.0
    """The same for the rate of pitch [m/m/(rad/s)]."""
    roll: Gain = 0.0
    """Length that right legs gain, and left legs lose, with roll, per metre from the base's middle [m/m/rad]."""
    roll_rate: Gain = 0.0
    """The same for the rate of roll [m/m/(rad/s)]."""
    lag: Annotated[float, Within(0, 1)] = 0.045
    """Delay of measured legs behind their reference: latency of readings and servos [s]."""
    reach: Annotated[float, Within(0, 1)] = 0.04
    """Greatest shift of a foot, forward or upward [m]."""


class RaibertController:
    """The controller as a policy; its only memory is the history of observations.

    Args:
        robot: its legs.
        reference: the foot trajectories.
        gains: one number each; all but `lag` and `reach` also (N, 1), where each of N robots has its own.
        observations: parts of the observation; they must be `OBSERVATIONS`.
        history: number of observations in its input, over which the speed is estimated.

    Raises:
        SurefootError: other observations.
    """

    def __init__(
        self,
        robot: RobotDescription,
        reference: FootPaths,
        gains: RaibertConfig,
        observations: tuple[str, ...] = OBSERVATIONS,
        history: int = HISTORY,
    ) -> None:
        if observations != OBSERVATIONS:
            raise SurefootError(
                f"observations are {choices(observations)}; Raibert's controller takes {choices(OBSERVATIONS)}"
            )
        self.robot, self.reference, self.gains, self.history = robot, reference, gains, history
        # Places of the legs relative to their middle, x forward and y left [m].
        self._place = robot.leg_mounts[:, :2] - robot.leg_mounts[:, :2].mean(axis=0)

    def _parts(self, observation: ArrayLike) -> list[Array]:
        """Return IMU (H, N, 4), motor angles and speeds (H, N, M) and cycles of the clock (H, N), the newest first."""
        rows = np.asarray(observation, float)
        rows, motors = np.moveaxis(rows.reshape(len(rows), self.history, -1), 1, 0), self.robot.num_motors
        *parts, clock = np.split(rows, [4, 4 + motors, 4 + 2 * motors], axis=-1)
        return [*parts, np.arctan2(clock[..., 0], clock[..., 1]) / (2 * np.pi)]

    def speed(self, observation: ArrayLike) -> Array:
        """Return the estimated speed forward (N,) [m/s]: of legs in stance, mean over the history; NaN without any.

        A foot that stands moves relative to the base as the base does relative to the ground, with the opposite sign;
        the rate of pitch moves it by its distance below the base.
        """
        imu, angle, rate, cycle = self._parts(observation)
        part = self.reference.cycle_phase(cycle - self.gains.lag * np.reshape(self.reference.frequency, -1))
        part /= self.reference.duty_factor
        leg, motors = self.robot.leg_geometry, self.robot.leg_motor_index
        theta, turn = angle[..., motors], rate[..., motors]
        ahead, behind = (leg.foot_in_plane(theta + sign * _STEP * turn) for sign in (1.0, -1.0))
        forward, below = (ahead - behind)[..., 0] / (2 * _STEP), (ahead + behind)[..., 1] / 2
        speeds = -forward - imu[..., 3:] * (below + self.robot.leg_mounts[:, 2])
        standing = (part > _EDGE) & (part < 1.0 - _EDGE) & np.isfinite(speeds)
        count = standing.sum(axis=(0, 2))
        total = np.where(standing, speeds, 0.0).sum(axis=(0, 2))
        speed: Array = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        return speed

    def feedback(self, observation: ArrayLike) -> Array:
        """Return feedback (N, C L) in leg space for observations (N, O * history); none on abduction."""
        imu, _, _, cycle = (part[0] for part in self._parts(observation))
        gains, reference = self.gains, self.reference
        # Without an estimate, as in a flight longer than the history, feet land on their trajectory.
        excess = np.nan_to_num(self.speed(observation)[:, None] - reference.speed)
        forward = (reference.duty_factor / reference.frequency / 2 + gains.speed) * excess
        roll, pitch, roll_rate, pitch_rate = imu.T[..., None]
        nose = gains.pitch * pitch + gains.pitch_rate * pitch_rate
        side = gains.roll * roll + gains.roll_rate * roll_rate
        # Only legs in stance turn the base; they begin and end it at their trajectory's height.
        weight = np.sin(np.pi * np.minimum(reference.cycle_phase(cycle) / reference.duty_factor, 1.0))
        upward = weight * (side * self._place[:, 1] - nose * self._place[:, 0])
        shift = np.clip(np.stack([forward, upward], -1), -gains.reach, gains.reach)
        path = reference.path(cycle)
        leg = self.robot.leg_geometry
        shifted, nominal = np.stack(leg.plane_pose(path + shift)), np.stack(leg.plane_pose(path))
        # A foot that would be out of reach stays on its trajectory.
        moved = np.where(np.isfinite(shifted).all(axis=0), shifted - nominal, 0.0)
        level = [np.zeros_like(moved[0])] * (len(leg.coordinates) - 2)
        return np.concatenate([*level, *moved], axis=1)
