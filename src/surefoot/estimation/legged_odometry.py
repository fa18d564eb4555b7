"""A velocity estimator from legged odometry: a Kalman filter over what the standing feet imply.

Its state is the velocity of the base, after Bledt et al. (2018, "MIT Cheetah 3: Design and Control of a Robust, Dynamic
Quadruped Robot") and Bloesch et al. (2013, "State Estimation for Legged Robots on Unstable and Slippery Terrain"). The
position of the base and of its footholds is left out: nothing measures it, and the velocity does not depend on it.

    prediction    v' = -w x v + a           a: specific force less gravity; without an accelerometer a random walk
    measurement   v  = v_i + noise          v_i: implied by foot i while it rolls without slipping, see `foot_odometry`

The load on a foot says how likely it stands. A foot that slips, or swings with a load, is rejected by its distance d
from the others and from the prediction: weights are (1 + d^2 / c)^-2, the function of Geman and McClure (1987), found
by iteration, beginning with the weights from the loads. A foot that carries much slips less: its information grows with
the root of its load.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.estimation.foot_odometry import FootObservations, FootOdometry
from surefoot.estimation.interface import MotionReadings, VelocityEstimate
from surefoot.robot import GRAVITY, RobotDescription

STANDING_LOAD = 0.8
"""Load on a foot, over an equal share of the weight, at which it stands as likely as not. Feet that carry less are
often dragged: in a trot of the Minitaur a foot on the ground implies 0.3 m/s too little on average."""
LOAD_WIDTH = 0.15
"""Width of the logistic curve over the load: friction and inertia of the links change torques by about as much."""
FOOT_NOISE = 0.08
"""Standard deviation [sqrt(g l)] of the velocity that a foot with its share of the weight implies: slips, edges."""
DEGREES = 2.5
"""Squared distance of a foot from the estimate, in standard deviations, at which its weight is a quarter. Less rejects
slip better, and follows pushes and impacts less."""
REWEIGHTINGS = 2
"""Times that the weights of feet are computed again."""
ACCELERATION = 0.5
"""Standard deviation of the acceleration [g] without an accelerometer: feet that touch down on stairs stop the base."""
ACCELERATION_TIME = 0.3
"""Time [sqrt(l / g)] for which such an acceleration lasts."""
MEASURED_ACCELERATION = 0.3
"""Standard deviation of a measured acceleration [g]: a sample of each control step misses parts of impacts. Of 0.2,
0.3 and 0.5 it is the best compromise; errors are not smaller than without an accelerometer, see results/estimation."""
NO_LOAD = -1e3
"""Load of a leg that can't close: its foot does not stand."""
START = 0.1
"""Standard deviation of the velocity at the start [sqrt(g l)]: robots stand."""
HEIGHT_INFORMATION = 3.0
"""Information of the predicted height relative to the height over a standing foot: feet stand at different heights."""
NO_INFORMATION = 1e-6
"""The same at the start, where the height is unknown."""

_EYE = np.eye(3)


class LeggedOdometry:
    """Velocity estimator of N robots of a kind; see `VelocityEstimator`.

    Args:
        robot: legs, motors and weight.
        num_envs: number of robots.
    """

    def __init__(self, robot: RobotDescription, num_envs: int = 1) -> None:
        self._odometry, self._num_envs = FootOdometry(robot), num_envs
        length, time = robot.leg_geometry.length, robot.natural_time
        speed = length / time
        self._foot_variance = (FOOT_NOISE * speed) ** 2
        self._walk = (ACCELERATION * GRAVITY) ** 2 * ACCELERATION_TIME * time
        self._measured_walk = (MEASURED_ACCELERATION * GRAVITY) ** 2 * ACCELERATION_TIME * time
        self._nearness = np.array([1.0, 1.0, 1.0, 0.0]) / (DEGREES * self._foot_variance)
        self._start_variance = (START * speed) ** 2
        self.reset()

    def reset(self) -> None:
        """Forget all readings; the robots stand still at the next ones."""
        self._odometry.reset()
        self._velocity = np.zeros((self._num_envs, 1, 3))
        self._variance = np.full((self._num_envs, 1, 1), self._start_variance)
        self._height = np.zeros((self._num_envs, 1, 1))
        self._height_information = np.full((self._num_envs, 1, 1), NO_INFORMATION)

    def start(self, rows: NDArray[np.int64], readings: MotionReadings) -> None:
        """Forget the readings of some robots, and take their first new ones, at which they stand still.

        Args:
            rows: indices of the robots (n,); all robots at first.
            readings: readings of these robots.
        """
        self._odometry.start(rows, readings)
        # A copy, because estimates share it.
        self._velocity, self._height = self._velocity.copy(), self._height.copy()
        self._velocity[rows], self._variance[rows] = 0.0, self._start_variance
        self._height[rows], self._height_information[rows] = 0.0, NO_INFORMATION

    def arrays(self) -> dict[str, Array]:
        """Return the arrays that an exact resume needs, by name; their first axis is the robots."""
        own = {name: getattr(self, f"_{name}") for name in ("velocity", "variance", "height", "height_information")}
        return own | self._odometry.arrays()

    def update(self, readings: MotionReadings) -> VelocityEstimate:
        """Take the readings of a control step and return the estimate for their time."""
        feet = self._odometry.update(readings)
        velocity, load, above = feet.velocity, feet.load, feet.height[:, :, None]
        if not feet.is_finite:
            load = _known_load(load, readings.expected_load)
            finite = np.asarray(np.isfinite(velocity).all(axis=-1, keepdims=True))  # a leg that can't close
            velocity, above = (np.where(finite, values, 0.0) for values in (velocity, above))
            load = np.where(finite[..., 0], load, NO_LOAD)
        standing = 0.5 + 0.5 * np.tanh((load - STANDING_LOAD) * (0.5 / LOAD_WIDTH))
        # What each foot implies, and 1; the last row is the prediction.
        rows = np.empty((self._num_envs, standing.shape[1] + 1, 4))
        rows[:, :-1, :3], rows[..., 3] = velocity, 1.0
        duration = readings.duration[:, None, None]
        self._predict(readings.accelerometer, feet, standing, duration)
        contact = self._correct(rows, standing, np.sqrt(np.maximum(load, 0.0)))
        self._update_height(feet.up, above, contact, duration)
        return VelocityEstimate(self._velocity[:, 0], self._variance * _EYE, self._height[:, 0, 0], contact[:, 0])

    def _predict(self, accelerometer: Array | None, feet: FootObservations, standing: Array, duration: Array) -> None:
        change = self._velocity @ feet.cross_turn
        if accelerometer is not None:
            change += (accelerometer - GRAVITY * feet.up)[:, None]
            walk = self._measured_walk
        else:
            # A robot without a foot on the ground falls freely.
            flight = np.multiply.reduce(1.0 - standing, axis=1, keepdims=True)
            change -= (GRAVITY * flight * feet.up)[:, None]
            walk = self._walk
        self._velocity = self._velocity + change * duration
        self._variance = self._variance + walk * duration

    def _correct(self, rows: Array, standing: Array, firmness: Array) -> Array:
        """Correct the velocity; return the probability (N, 1, L) that each foot stands and rolls.

        Args:
            rows: velocity that each foot implies, and 1 (N, L + 1, 4); the last row is filled here.
            standing: probability that each foot stands (N, L).
            firmness: information of a standing foot relative to one that carries its share of the weight (N, L).
        """
        # In units of the noise of a foot.
        rows[:, -1:, :3] = self._velocity
        weights = np.empty((self._num_envs, 1, rows.shape[1]))
        implied, feet = rows[:, :-1], weights[:, 0, :-1]
        firm = standing * firmness
        weights[..., -1:], feet[:] = self._foot_variance / self._variance, firm
        for _ in range(REWEIGHTINGS + 1):
            total = weights @ rows
            mean = total / total[..., 3:]
            error = implied - mean
            far = (error * error) @ self._nearness
            far += 1.0
            far *= far
            np.divide(firm, far, out=feet)
        self._velocity, self._variance = mean[..., :3], self._foot_variance / total[..., 3:]
        return (standing / far)[:, None]

    def _update_height(self, up: Array, above: Array, contact: Array, duration: Array) -> None:
        """Update the height.

        Args:
            up: unit vector away from the ground (N, 3).
            above: height of each foot's lowest point above the base's origin (N, L, 1) [m].
            contact: probability that each foot stands (N, 1, L).
            duration: time since the readings before (N, 1, 1) [s].
        """
        predicted = self._height + (self._velocity @ up[:, :, None]) * duration
        total = self._height_information + np.add.reduce(contact, axis=2, keepdims=True)
        self._height = (self._height_information * predicted - contact @ above) / total
        self._height_information[:] = HEIGHT_INFORMATION


def _known_load(load: Array, expected: Array | None) -> Array:
    """Return loads (N, L). Unknown loads follow a reference gait; without one, a foot stands as likely as not."""
    return np.where(np.isfinite(load), load, STANDING_LOAD if expected is None else expected * load.shape[1])
