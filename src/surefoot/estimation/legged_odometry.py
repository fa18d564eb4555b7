"""A velocity estimator from legged odometry: a Kalman filter over what the standing feet imply.

Its state is the velocity of the base, after Bledt et al. (2018, "MIT Cheetah 3: Design and Control of a Robust, Dynamic
Quadruped Robot") and Bloesch et al. (2013, "State Estimation for Legged Robots on Unstable and Slippery Terrain"). The
position of the base and of its footholds is left out: nothing measures it, and the velocity does not depend on it.

    prediction    v' = -w x v + a           a: specific force less gravity; without an accelerometer a random walk
    measurement   v  = v_i + noise          v_i: implied by foot i while it rolls without slipping, see `foot_odometry`

The load on a foot says how likely it stands. A foot that slips, or swings with a load, is rejected by its distance d
from the others and from the prediction: weights are (1 + d^2 / c)^-2, the function of Geman and McClure (1987), found
by iteration, beginning with the weights from the loads.
"""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.estimation.foot_odometry import FootObservations, FootOdometry, cross
from surefoot.estimation.interface import MotionReadings, VelocityEstimate
from surefoot.robot import GRAVITY, RobotDescription

STANDING_LOAD = 0.8
"""Load on a foot, over an equal share of the weight, at which it stands as likely as not. Feet that carry less are
often dragged: in a trot of the Minitaur a foot on the ground implies 0.3 m/s too little on average."""
LOAD_WIDTH = 0.15
"""Width of the logistic curve over the load: friction and inertia of the links change torques by about as much."""
FOOT_NOISE = 0.08
"""Standard deviation [sqrt(g l)] of the velocity that a standing foot implies: soft soles give way and spring back."""
DEGREES = 3.0
"""Squared distance of a foot from the estimate, in standard deviations, at which its weight is a quarter. Less rejects
slip better, and follows pushes and impacts less."""
REWEIGHTINGS = 3
"""Times that the weights of feet are computed again."""
ACCELERATION = 0.4
"""Standard deviation of the acceleration [g] without an accelerometer: feet that touch down on stairs stop the base."""
ACCELERATION_TIME = 0.3
"""Time [sqrt(l / g)] for which such an acceleration lasts."""
MEASURED_ACCELERATION = 0.05
"""Standard deviation of a measured acceleration [g]: a tilt of 0.05 rad that the IMU does not know."""
START = 0.1
"""Standard deviation of the velocity at the start [sqrt(g l)]: robots stand."""
HEIGHT_NOISE = 0.1
"""Standard deviation of the height over a standing foot [l]: the attitude's error over the distance of the foot."""
HEIGHT_CHANGE = 0.1
"""Standard deviation of the change of the ground's height under the feet in the time sqrt(l / g), [l]."""

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
        self._start_variance = (START * speed) ** 2
        self._height_variance = (HEIGHT_NOISE * length) ** 2
        self._height_walk = (HEIGHT_CHANGE * length) ** 2 / time
        self.reset()

    def reset(self) -> None:
        """Forget all readings; the robots stand still at the next ones."""
        self._odometry.reset()
        self._velocity = np.zeros((self._num_envs, 3))
        self._variance = np.full((self._num_envs, 3), self._start_variance)
        self._height = np.zeros(self._num_envs)
        self._height_uncertainty = np.full(self._num_envs, 1e6 * self._height_variance)

    def update(self, readings: MotionReadings) -> VelocityEstimate:
        """Take the readings of a control step and return the estimate for their time."""
        feet = self._odometry.update(readings)
        implied, standing = feet.velocity, _standing(feet, readings.expected_load)
        finite = np.isfinite(implied)
        if not finite.all():  # a leg that can't close
            standing = np.where(finite.all(axis=-1), standing, 0.0)
            implied = np.where(finite, implied, 0.0)
        self._predict(readings, feet.up, standing)
        contact = self._correct(implied, standing)
        self._update_height(readings.duration, feet, contact)
        covariance = self._variance[:, :, None] * _EYE
        return VelocityEstimate(self._velocity.copy(), covariance, self._height.copy(), contact)

    def _predict(self, readings: MotionReadings, up: Array, standing: Array) -> None:
        duration = readings.duration[:, None]
        change, walk = -cross(readings.angular_velocity_base, self._velocity), self._walk
        if readings.accelerometer is not None:
            change, walk = change + readings.accelerometer - GRAVITY * up, self._measured_walk
        else:
            # A robot without a foot on the ground falls freely.
            change -= GRAVITY * up * (1.0 - standing).prod(axis=1)[:, None]
        self._velocity += change * duration
        self._variance += walk * duration

    def _correct(self, implied: Array, standing: Array) -> Array:
        """Correct the velocity by what feet imply (N, L, 3); return the probability that each stands and rolls."""
        # In units of the noise of a foot.
        information, weight = self._foot_variance / self._variance, standing
        prior, limit = information * self._velocity, DEGREES * self._foot_variance
        for _ in range(REWEIGHTINGS + 1):
            total = information + weight.sum(axis=1)[:, None]
            velocity = (prior + (weight[:, None] @ implied)[:, 0]) / total
            error = implied - velocity[:, None]
            weight = standing * (limit / (limit + (error * error).sum(axis=-1))) ** 2
        self._velocity, self._variance = velocity, self._foot_variance / total
        return weight

    def _update_height(self, duration: Array, feet: FootObservations, contact: Array) -> None:
        self._height += (self._velocity * feet.up).sum(axis=1) * duration
        self._height_uncertainty += self._height_walk * duration
        above = (feet.contact_point * feet.up[:, None]).sum(axis=-1)
        weight = contact / self._height_variance
        total = 1.0 / self._height_uncertainty + weight.sum(axis=1)
        below = np.where(contact > 0.0, -weight * above, 0.0).sum(axis=1)
        self._height = (self._height / self._height_uncertainty + below) / total
        self._height_uncertainty = 1.0 / total


def _standing(feet: FootObservations, expected: Array | None) -> Array:
    """Return the probability that each foot stands (N, L), from its load; without torques, from the expected load."""
    load, finite = feet.load, np.isfinite(feet.load)
    if not finite.all():
        # Where nothing is known about the load, a foot stands as likely as not.
        otherwise = STANDING_LOAD if expected is None else expected * load.shape[1]
        load = np.where(finite, load, otherwise)
    return np.asarray(1.0 / (1.0 + np.exp(np.minimum((STANDING_LOAD - load) / LOAD_WIDTH, 50.0))))
