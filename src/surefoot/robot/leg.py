r"""Leg space and the five-bar leg, in closed form.

A leg's pose is (swing s, extension e) in leg space and (theta_1, theta_2) in motor space (Tan et al. 2018,
figure 3):

    theta_1 = e + s        theta_2 = e - s

theta is measured from straight up; motor 1 turns its upper link forward, motor 2 backward. Positive extension
makes the leg longer, positive swing moves the foot backward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError


def leg_to_motor(swing: ArrayLike, extension: ArrayLike) -> tuple[Array, Array]:
    """Return the motor angles (theta_1, theta_2) [rad] of legs at swing and extension [rad]; any shape, broadcast."""
    s, e = np.asarray(swing, float), np.asarray(extension, float)
    return e + s, e - s


def motor_to_leg(theta_1: ArrayLike, theta_2: ArrayLike) -> tuple[Array, Array]:
    """Return the swing and extension [rad] of legs with motors at theta_1 and theta_2 [rad]; any shape, broadcast."""
    t1, t2 = np.asarray(theta_1, float), np.asarray(theta_2, float)
    return (t1 - t2) / 2, (t1 + t2) / 2


@dataclass(frozen=True)
class FiveBar:
    """Lengths [m] of a five-bar leg and its kinematics in its plane: x forward, z up from the motor axis."""

    upper: float
    """Motor axis to knee, both upper links."""
    lower: tuple[float, float]
    """Knee to pin joint, on the lower link of motor 1 and of motor 2."""
    foot: float
    """Knee to the foot's end, along the lower link of motor 2."""
    foot_radius: float
    """Radius of the foot's rounded end."""

    def __post_init__(self) -> None:
        """Refuse lengths that are not over zero."""
        for key, value in (("upper", self.upper), ("lower", min(self.lower)), ("foot", self.foot)):
            if not value > 0:
                raise SurefootError(f"leg_geometry.{key} is {value:g}; a length must be over 0 m")
        if not 0 <= self.foot_radius < self.foot:
            raise SurefootError(
                f"leg_geometry.foot_radius is {self.foot_radius:g}; it must be from 0 to foot {self.foot:g} m"
            )

    def knees(self, theta_1: ArrayLike, theta_2: ArrayLike) -> tuple[Array, Array]:
        """Return the positions (..., 2) [m] of both knees, x forward and z up from the motor axis."""
        t1, t2 = np.asarray(theta_1, float), np.asarray(theta_2, float)
        knee_1 = self.upper * np.stack([np.sin(t1), np.cos(t1)], -1)
        knee_2 = self.upper * np.stack([-np.sin(t2), np.cos(t2)], -1)
        return knee_1, knee_2

    def pin(self, theta_1: ArrayLike, theta_2: ArrayLike) -> Array:
        """Return the position (..., 2) [m] of the pin joint, where circles around the knees meet away from the motors.

        NaN where the lower links are too short to meet.
        """
        knee_1, knee_2 = self.knees(theta_1, theta_2)
        return _corner(knee_2, self.lower[1], knee_1, self.lower[0])

    def foot_position(self, theta_1: ArrayLike, theta_2: ArrayLike) -> Array:
        """Return the position (..., 2) [m] of the foot's end from the motor axis; NaN where no loop closes."""
        _, knee_2 = self.knees(theta_1, theta_2)
        pin = self.pin(theta_1, theta_2)
        return knee_2 + (pin - knee_2) * (self.foot / self.lower[1])

    def leg_pose(self, foot: ArrayLike) -> tuple[Array, Array]:
        """Return the swing and extension (...) [rad] that bring the foot's end to (..., 2) [m] from the motor axis.

        The inverse of `foot_position`, with the knee of motor 1 in front and that of motor 2 behind; NaN out of reach.
        """
        foot, axis = np.asarray(foot, float), np.zeros(2)
        knee_2 = _corner(axis, self.upper, foot, self.foot)
        pin = knee_2 + (foot - knee_2) * (self.lower[1] / self.foot)
        knee_1 = _corner(pin, self.lower[0], axis, self.upper)
        # Straight legs turn past pi, so the branch is cut at -pi/2.
        angles = np.arctan2([knee_1[..., 0], -knee_2[..., 0]], [knee_1[..., 1], knee_2[..., 1]])
        return motor_to_leg(*((angles + np.pi / 2) % (2 * np.pi) - np.pi / 2))

    def knee_angles(self, theta_1: ArrayLike, theta_2: ArrayLike) -> tuple[Array, Array]:
        """Return the angles [rad] of both lower links about +y from their upper links; 0 continues the upper link."""
        knee_1, knee_2 = self.knees(theta_1, theta_2)
        pin = self.pin(theta_1, theta_2)

        def turn(start: Array, angle: Array) -> Array:
            along = pin - start
            return (np.arctan2(along[..., 0], along[..., 1]) - angle + np.pi) % (2 * np.pi) - np.pi

        # The knee of motor 1 bends past pi when the leg is short, so the branch is cut at 0 instead.
        t1, t2 = np.asarray(theta_1, float), np.asarray(theta_2, float)
        return turn(knee_1, t1) % (2 * np.pi), -(-turn(knee_2, -t2) % (2 * np.pi))

    def closes(self, theta_1: ArrayLike, theta_2: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the loop can close at these motor angles."""
        return np.asarray(np.isfinite(self.pin(theta_1, theta_2)).all(-1))


def _corner(a: Array, side_a: float, b: Array, side_b: float) -> Array:
    """Return the corner (..., 2) of a triangle with corners a and b to the right of the way from a to b.

    `side_a` and `side_b` are its distances from a and b. NaN where they are too short or too long to meet.
    """
    across = b - a
    distance = np.linalg.norm(across, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = (distance**2 + side_a**2 - side_b**2) / (2 * distance)
        height = np.sqrt(side_a**2 - along**2)
        unit = across / distance
    return a + along * unit + height * np.stack([unit[..., 1], -unit[..., 0]], -1)
