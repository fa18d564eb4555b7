r"""Leg space, the interface of all kinds of legs, and the five-bar leg, in closed form.

Leg space is the same for every kind: (abduction,) swing, extension. Positive abduction moves the foot away from the
robot's middle plane, positive swing moves it backward, positive extension makes the leg longer.

The pose of a five-bar leg is (swing s, extension e) in leg space and (theta_1, theta_2) in motor space (Tan et al.
2018, figure 3):

    theta_1 = e + s        theta_2 = e - s

theta is measured from straight up; motor 1 turns its upper link forward, motor 2 backward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.configuration import NotNegative, Positive
from surefoot.errors import SurefootError


class Legs(Protocol):
    """The kinematics of a robot's L legs, all of one kind with m motors and C coordinates each.

    Poses in leg space have the shape (..., C, L), motor angles (..., L, m), in the order of the sheet's `legs.order`.
    """

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates of leg space, in order: (abduction,) swing, extension."""

    @property
    def units(self) -> tuple[str, ...]:
        """Their units; the unit 1 of an extension is the length of the straight leg."""

    @property
    def length(self) -> float:
        """Length of the straight leg, hip to foot [m]."""

    def to_motors(self, pose: ArrayLike) -> Array:
        """Return the motor angles (..., L, m) [rad] of poses (..., C, L); NaN out of reach."""

    def to_pose(self, angles: ArrayLike) -> Array:
        """Return the poses (..., C, L) for motor angles (..., L, m) [rad]."""

    def foot_in_plane(self, angles: ArrayLike) -> Array:
        """Return the feet (..., L, 2) [m] in their legs' planes from the hip axis, x forward and z up."""

    def plane_pose(self, foot: ArrayLike) -> tuple[Array, Array]:
        """Return the swing and extension (..., L) that bring feet to (..., L, 2) [m] in the plane; NaN out of reach."""

    def foot_position(self, angles: ArrayLike) -> Array:
        """Return the feet (..., L, 3) [m] from the legs' mounts, in the base frame."""

    def foot_pose(self, foot: ArrayLike) -> Array:
        """Return the poses (..., C, L) that bring feet to (..., L, 3) [m] from the legs' mounts; NaN out of reach.

        A leg without abduction stays in its plane, whatever y.
        """

    def jacobian(self, angles: ArrayLike) -> Array:
        """Return the derivatives (..., L, 3, m) [m/rad] of `foot_position` by the motor angles."""

    def foot_link_angles(self, angles: ArrayLike, foot: Array) -> Array:
        """Return the orientation (..., L, 2) [rad] of the feet's links in the base frame.

        Abduction about +x, then, in the leg's plane, the angle of the line from knee to foot about +y from straight
        down. `foot` (..., L, 3) is what `foot_position` returns for the angles.
        """

    def closes(self, angles: ArrayLike) -> NDArray[np.bool_]:
        """Return whether each leg (..., L) can have these motor angles."""

    def knee_angles(self, angles: ArrayLike) -> Array:
        """Return the angles (..., L, knees) [rad] of joints without a motor, as the URDF has them."""


@dataclass(frozen=True)
class FiveBar:
    """Lengths [m] of a five-bar leg and its kinematics in its plane: x forward, z up from the motor axis.

    The foot is the end of the lower link of motor 2, its rounding included. All legs of a robot are alike.
    """

    upper: Positive
    """Motor axis to knee, both upper links."""
    lower: tuple[Positive, Positive]
    """Knee to pin joint, on the lower link of motor 1 and of motor 2."""
    foot: Positive
    """Knee to the foot's end, along the lower link of motor 2."""
    foot_radius: NotNegative
    """Radius of the foot's rounded end."""

    coordinates: ClassVar[tuple[str, ...]] = ("swing", "extension")
    units: ClassVar[tuple[str, ...]] = ("rad", "rad")

    def __post_init__(self) -> None:
        """Refuse a foot that is rounder than its link is long."""
        if self.foot_radius >= self.foot > 0:
            raise SurefootError(
                f"leg_geometry.foot_radius is {self.foot_radius:g}; it must be from 0 to foot {self.foot:g} m"
            )

    @property
    def length(self) -> float:
        """Length of the straight leg [m]."""
        return self.upper + self.foot

    def to_motors(self, pose: ArrayLike) -> Array:
        """Return the motor angles (..., L, 2) [rad] of poses (..., 2, L) [rad]."""
        swing, extension = np.moveaxis(np.asarray(pose, float), -2, 0)
        return np.stack([extension + swing, extension - swing], axis=-1)

    def to_pose(self, angles: ArrayLike) -> Array:
        """Return swing and extension (..., 2, L) [rad] for motor angles (..., L, 2) [rad]."""
        theta_1, theta_2 = _split(angles)
        return np.stack([(theta_1 - theta_2) / 2, (theta_1 + theta_2) / 2], axis=-2)

    def knees(self, angles: ArrayLike) -> tuple[Array, Array]:
        """Return the positions (..., 2) [m] of both knees, x forward and z up from the motor axis."""
        theta_1, theta_2 = _split(angles)
        knee_1 = self.upper * np.stack([np.sin(theta_1), np.cos(theta_1)], -1)
        knee_2 = self.upper * np.stack([-np.sin(theta_2), np.cos(theta_2)], -1)
        return knee_1, knee_2

    def pin(self, angles: ArrayLike) -> Array:
        """Return the pin joint (..., 2) [m], where circles around the knees meet away from the motors.

        NaN where the lower links are too short to meet.
        """
        knee_1, knee_2 = self.knees(angles)
        return _corner(knee_2, self.lower[1], knee_1, self.lower[0])

    def foot_in_plane(self, angles: ArrayLike) -> Array:
        """Return the position (..., 2) [m] of the foot's end from the motor axis; NaN where no loop closes."""
        _, knee_2 = self.knees(angles)
        return knee_2 + (self.pin(angles) - knee_2) * (self.foot / self.lower[1])

    def foot_position(self, angles: ArrayLike) -> Array:
        """Return the position (..., 3) [m] of the foot's end from the leg's mount, in the base frame."""
        x, z = _split(self.foot_in_plane(angles))
        return np.stack([x, np.zeros_like(x), z], -1)

    def foot_pose(self, foot: ArrayLike) -> Array:
        """Return the poses (..., 2, L) [rad] that bring feet to (..., L, 3) [m] from the legs' mounts, y left out."""
        return np.stack(self.plane_pose(np.asarray(foot, float)[..., ::2]), axis=-2)

    def jacobian(self, angles: ArrayLike) -> Array:
        """Return the derivatives (..., 3, 2) [m/rad] of `foot_position`: the lower links keep their lengths.

        With the pin p and knees k_i: (p - k_i) . (dp - dk_i) = 0 for both.
        """
        theta_1, theta_2 = _split(angles)
        speed_1 = self.upper * np.stack([np.cos(theta_1), -np.sin(theta_1)], -1)
        speed_2 = self.upper * np.stack([-np.cos(theta_2), -np.sin(theta_2)], -1)
        along = self.pin(angles)[..., None, :] - np.stack(self.knees(angles), -2)
        right = np.eye(2) * np.sum(along * np.stack([speed_1, speed_2], -2), -1)[..., None]
        knee_speed = np.stack([np.zeros_like(speed_2), speed_2], -1)
        plane = knee_speed + (np.linalg.solve(along, right) - knee_speed) * (self.foot / self.lower[1])
        return np.insert(plane, 1, 0.0, axis=-2)

    def foot_link_angles(self, angles: ArrayLike, foot: Array) -> Array:
        """Return the orientation (..., 2) [rad] of the lower link of motor 2: no abduction, and its angle about +y."""
        _, theta_2 = _split(angles)
        link = np.zeros((*theta_2.shape, 2))
        ahead, above = foot[..., 0] + self.upper * np.sin(theta_2), foot[..., 2] - self.upper * np.cos(theta_2)
        link[..., 1] = np.arctan2(-ahead, -above)
        return link

    def plane_pose(self, foot: ArrayLike) -> tuple[Array, Array]:
        """Return the swing and extension (...) [rad] that bring the foot's end to (..., 2) [m] from the motor axis.

        The inverse of `foot_in_plane`, with the knee of motor 1 in front and that of motor 2 behind; NaN out of reach.
        """
        foot, axis = np.asarray(foot, float), np.zeros(2)
        knee_2 = _corner(axis, self.upper, foot, self.foot)
        pin = knee_2 + (foot - knee_2) * (self.lower[1] / self.foot)
        knee_1 = _corner(pin, self.lower[0], axis, self.upper)
        # Straight legs turn past pi, so the branch is cut at -pi/2.
        angles = np.arctan2([knee_1[..., 0], -knee_2[..., 0]], [knee_1[..., 1], knee_2[..., 1]])
        theta_1, theta_2 = (angles + np.pi / 2) % (2 * np.pi) - np.pi / 2
        return (theta_1 - theta_2) / 2, (theta_1 + theta_2) / 2

    def knee_angles(self, angles: ArrayLike) -> Array:
        """Return the angles (..., 2) [rad] of both lower links about +y from their upper links; 0 continues them."""
        theta = np.asarray(angles, float) * [1.0, -1.0]
        links = self.pin(angles)[..., None, :] - np.stack(self.knees(angles), -2)
        turn = (np.arctan2(links[..., 0], links[..., 1]) - theta + np.pi) % (2 * np.pi) - np.pi
        # The knee of motor 1 bends past pi when the leg is short, so the branch is cut at 0 instead.
        return np.stack([turn[..., 0] % (2 * np.pi), -(-turn[..., 1] % (2 * np.pi))], -1)

    def closes(self, angles: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the loop can close at these motor angles (..., 2)."""
        return np.asarray(np.isfinite(self.pin(angles)).all(-1))


def _split(pairs: ArrayLike) -> tuple[Array, Array]:
    """Return the parts (...) of pairs (..., 2)."""
    array = np.asarray(pairs, float)
    return array[..., 0], array[..., 1]


def _corner(a: Array, side_a: float, b: Array, side_b: float) -> Array:
    """Return the corner (..., 2) of a triangle with corners a and b to the right of the line from a to b.

    `side_a` and `side_b` are its distances from a and b. NaN where they are too short or too long to meet.
    """
    across = b - a
    distance = np.linalg.norm(across, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = (distance**2 + side_a**2 - side_b**2) / (2 * distance)
        height = np.sqrt(side_a**2 - along**2)
        unit = across / distance
    return a + along * unit + height * np.stack([unit[..., 1], -unit[..., 0]], -1)
