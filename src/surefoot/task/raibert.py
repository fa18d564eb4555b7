"""Raibert's controller: classical feedback on top of foot trajectories.

As in Raibert 1986, "Legged Robots That Balance", three parts control a quadruped: foot placement controls the speed,
leg lengths in stance control roll and pitch, and a clock generates the gait. A foot lands at

    x = v T / 2 + k (v - v_d)

ahead of its leg's neutral position, with the forward speed v, the desired speed v_d and the stance duration T. The
stroke of the trajectory is already v_d T, so the controller adds (T / 2 + k) (v - v_d).

Inputs are measurements of the robot: roll, pitch and their rates, motor angles and speeds, and the clock. The forward
speed is estimated from the motors of legs that are in stance by the clock, assuming that their feet do not slip.
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
"""Default number of observations over which the speed is estimated: 0.15 s with control steps of 6 ms."""
_DERIVATIVE_STEP = 1e-4
"""Time step [s] of the numerical derivative of a foot's position."""
_STANCE_MARGIN = 0.2
"""Fraction of the stance that is excluded at its start and end, because the foot may still be in the air."""

Gain = Annotated[float, Within(-100, 100)]


@dataclass(frozen=True)
class RaibertConfig:
    """Gains of the controller."""

    speed: Gain = 0.0
    """Gain k from the speed error to the foot placement [m per m/s]."""
    pitch: Gain = 0.0
    """Gain from pitch to leg length, per metre from the base's middle; front legs extend, hind legs shorten
    [m/m/rad]."""
    pitch_rate: Gain = 0.0
    """Gain from pitch rate to leg length, per metre from the base's middle [m/m/(rad/s)]."""
    roll: Gain = 0.0
    """Gain from roll to leg length, per metre from the base's middle; right legs extend, left legs shorten
    [m/m/rad]."""
    roll_rate: Gain = 0.0
    """Gain from roll rate to leg length, per metre from the base's middle [m/m/(rad/s)]."""
    lag: Annotated[float, Within(0, 1)] = 0.045
    """Delay of measured legs relative to the reference: latency of readings and servos [s]."""
    reach: Annotated[float, Within(0, 1)] = 0.04
    """Maximum shift of a foot, forward or upward [m]."""


class RaibertController:
    """Raibert's controller as a policy, whose only memory is the history of observations.

    Args:
        robot: the robot.
        reference: foot trajectories.
        gains: gains. All but `lag` and `reach` may also be (N, 1), for N robots with different gains.
        observations: names of the task's observations, which must be `OBSERVATIONS`.
        history: number of observations in the input, over which the speed is estimated.

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
        # Positions of the legs' mounts relative to their centre, x forward and y left [m].
        self._mounts = robot.leg_mounts[:, :2] - robot.leg_mounts[:, :2].mean(axis=0)

    def _split(self, observation: ArrayLike) -> list[Array]:
        """Return IMU (H, N, 4), motor angles (H, N, M), speeds (H, N, M) and clock [cycles] (H, N), newest first."""
        rows = np.asarray(observation, float)
        rows, motors = np.moveaxis(rows.reshape(len(rows), self.history, -1), 1, 0), self.robot.num_motors
        *parts, clock = np.split(rows, [4, 4 + motors, 4 + 2 * motors], axis=-1)
        return [*parts, np.arctan2(clock[..., 0], clock[..., 1]) / (2 * np.pi)]

    def speed(self, observation: ArrayLike) -> Array:
        """Return the estimated forward speed (N,) [m/s], a mean over legs in stance and the history; NaN without any.

        A foot in stance moves relative to the base with the opposite of the base's velocity over the ground, plus the
        pitch rate times its distance below the base.
        """
        imu, angle, rate, cycle = self._split(observation)
        part = self.reference.cycle_phase(cycle - self.gains.lag * np.reshape(self.reference.frequency, -1))
        part /= self.reference.duty_factor
        leg, motors = self.robot.leg_geometry, self.robot.leg_motor_index
        theta, turn = angle[..., motors], rate[..., motors]
        later, earlier = (leg.foot_in_plane(theta + sign * _DERIVATIVE_STEP * turn) for sign in (1.0, -1.0))
        forward, below = (later - earlier)[..., 0] / (2 * _DERIVATIVE_STEP), (later + earlier)[..., 1] / 2
        speeds = -forward - imu[..., 3:] * (below + self.robot.leg_mounts[:, 2])
        in_stance = (part > _STANCE_MARGIN) & (part < 1.0 - _STANCE_MARGIN) & np.isfinite(speeds)
        count = in_stance.sum(axis=(0, 2))
        total = np.where(in_stance, speeds, 0.0).sum(axis=(0, 2))
        speed: Array = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        return speed

    def feedback(self, observation: ArrayLike) -> Array:
        """Return feedback (N, C L) in leg space for observations (N, O * history), with zero abduction."""
        imu, _, _, cycle = (part[0] for part in self._split(observation))
        gains, reference = self.gains, self.reference
        # Without a speed estimate, as in a flight phase longer than the history, feet land on their trajectory.
        excess = np.nan_to_num(self.speed(observation)[:, None] - reference.speed)
        forward = (reference.duty_factor / reference.frequency / 2 + gains.speed) * excess
        roll, pitch, roll_rate, pitch_rate = imu.T[..., None]
        nose = gains.pitch * pitch + gains.pitch_rate * pitch_rate
        side = gains.roll * roll + gains.roll_rate * roll_rate
        # Only legs in stance turn the base. At touchdown and lift-off, feet are on their trajectory.
        weight = np.sin(np.pi * np.minimum(reference.cycle_phase(cycle) / reference.duty_factor, 1.0))
        upward = weight * (side * self._mounts[:, 1] - nose * self._mounts[:, 0])
        shift = np.clip(np.stack([forward, upward], -1), -gains.reach, gains.reach)
        path = reference.path(cycle)
        leg = self.robot.leg_geometry
        shifted, nominal = np.stack(leg.plane_pose(path + shift)), np.stack(leg.plane_pose(path))
        # Feet whose shifted position is out of reach stay on their trajectory.
        moved = np.where(np.isfinite(shifted).all(axis=0), shifted - nominal, 0.0)
        level = [np.zeros_like(moved[0])] * (len(leg.coordinates) - 2)
        return np.concatenate([*level, *moved], axis=1)
