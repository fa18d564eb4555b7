r"""Leg space, the interface of all kinds of legs, and the closed-form kinematics of the five-bar leg.

Leg space is the same for all legs: (abduction,) swing, extension. Positive abduction moves the foot away from the
robot's sagittal plane, positive swing moves it backward, positive extension makes the leg longer.

The pose of a five-bar leg is (swing s, extension e) in leg space and (theta_1, theta_2) in motor space (Tan et al.
2018, figure 3):

    theta_1 = e + s        theta_2 = e - s

theta is measured from straight up; motor 1 turns its upper link forward, motor 2 backward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.configuration import NotNegative, Positive
from surefoot.errors import SurefootError

MIN_LEVERAGE = 0.01
"""Area between the speeds that both motors give a foot, relative to the squared length of the leg, below which torques
say nothing about the force along the leg."""


class FootKinematics(NamedTuple):
    """Poses of the feet's links, and how motors move and load feet, for L legs with m motors."""

    pose: Array
    """Position of the foot from the mount in the base frame [m] and orientation of its link [rad] (..., L, 5).

    Orientation: abduction about +x, then, in the leg's plane, the angle of the line from knee to foot about +y from
    straight down.
    """
    ahead: Array
    """Derivatives of the position's x in the plane with respect to the last two motor angles (..., L, 2) [m/rad]."""
    above: Array
    """Derivatives of its z in the plane (..., L, 2) [m/rad]."""
    length: float
    """Length of the straight leg [m]."""
    abduction: tuple[Array, Array, Array, Array] | None = None
    """Cosine and sine of the abduction (..., L), and in the plane's frame the position of the foot from the abduction
    axis, y (L,) and z (..., L), times the motor's sign [m]. None without abduction."""

    @property
    def jacobian(self) -> Array:
        """Jacobian (..., L, 3, m) [m/rad] of the position of the foot with respect to the motor angles."""
        if self.abduction is None:
            return np.stack([self.ahead, np.zeros_like(self.ahead), self.above], axis=-2)
        cos, sin, aside, lever = self.abduction
        abducted = np.stack([np.zeros_like(lever), -sin * aside - cos * lever, cos * aside - sin * lever], axis=-1)
        cos, sin = cos[..., None], sin[..., None]
        in_plane = np.stack([self.ahead, -sin * self.above, cos * self.above], axis=-2)
        return np.concatenate([abducted[..., None], in_plane], axis=-1)

    def force(self, torque: Array) -> Array:
        """Return the forces f (..., L, 3) [N] on the feet in the base frame that balance motor torques (..., L, m).

        The power of force and torques is zero, J^T f = -torque. Directions with less leverage are left out, and the
        force normal to the plane of a leg without abduction is 0.
        """
        min_lever, in_plane = MIN_LEVERAGE * self.length, torque[..., -2:]
        x, z, swapped = self.ahead, self.above, in_plane[..., ::-1]
        area = x[..., 0] * z[..., 1] - z[..., 0] * x[..., 1]
        along, upward = z * swapped, x * swapped
        ahead, above = along[..., 0] - along[..., 1], upward[..., 1] - upward[..., 0]
        if np.fmin.reduce(np.abs(area), axis=None) < min_lever * self.length:
            weak = np.abs(area) < min_lever * self.length
            area = np.where(weak, (x * x + z * z).sum(axis=-1), area)
            ahead, above = (
                np.where(weak, -(part * in_plane).sum(axis=-1), force) for part, force in ((x, ahead), (z, above))
            )
        result = np.zeros((*area.shape, 3))
        result[..., 0] = ahead / area
        above = above / area
        if self.abduction is None:
            result[..., 2] = above
            return result
        cos, sin, aside, lever = self.abduction
        if np.fmin.reduce(np.abs(lever), axis=None) < min_lever:
            lever = np.where(np.abs(lever) < min_lever, np.inf, lever)
        normal = (torque[..., 0] + aside * above) / lever
        result[..., 1], result[..., 2] = cos * normal - sin * above, sin * normal + cos * above
        return result


class Legs(Protocol):
    """Kinematics of a robot's L legs, all of one kind with m motors and C coordinates each.

    Poses in leg space have the shape (..., C, L), motor angles (..., L, m); legs are in the order of the data sheet's
    `legs.order`.
    """

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the leg-space coordinates in order: (abduction,) swing, extension."""

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the coordinates; an extension of 1 is the length of the straight leg."""

    @property
    def length(self) -> float:
        """Length of the straight leg, hip to foot [m]."""

    def to_motors(self, pose: ArrayLike) -> Array:
        """Convert poses (..., C, L) to motor angles (..., L, m) [rad]; NaN if out of reach."""

    def to_pose(self, angles: ArrayLike) -> Array:
        """Convert motor angles (..., L, m) [rad] to poses (..., C, L)."""

    def foot_in_plane(self, angles: ArrayLike) -> Array:
        """Return the foot positions (..., L, 2) [m] in the leg planes relative to the hip axis, x forward and z up."""

    def plane_pose(self, foot: ArrayLike) -> tuple[Array, Array]:
        """Return swing and extension (..., L) for foot positions (..., L, 2) [m] in the plane; NaN if out of reach."""

    def foot_position(self, angles: ArrayLike) -> Array:
        """Return the foot positions (..., L, 3) [m] relative to the leg mounts, in the base frame."""

    def foot_pose(self, foot: ArrayLike) -> Array:
        """Return the poses (..., C, L) for foot positions (..., L, 3) [m] relative to the mounts; NaN if out of reach.

        A leg without abduction ignores y and stays in its plane.
        """

    def foot_kinematics(self, angles: Array) -> FootKinematics:
        """Return the poses of the feet's links for motor angles (..., L, m) [rad], and the motors' leverage."""

    def is_feasible(self, angles: ArrayLike) -> NDArray[np.bool_]:
        """Return whether each leg (..., L) can assume these motor angles."""

    def knee_angles(self, angles: ArrayLike) -> Array:
        """Return the URDF joint angles (..., L, knees) [rad] of the passive knee joints."""


@dataclass(frozen=True)
class FiveBar:
    """Link lengths [m] of a five-bar leg, and its kinematics in the leg plane: x forward, z up from the motor axis.

    The foot is the end of the lower link of motor 2, including its rounded tip. All legs of a robot have equal lengths.
    """

    upper: Positive
    """Length of the upper links, from motor axis to knee."""
    lower: tuple[Positive, Positive]
    """Distances from knee to pin joint, for the lower links of motor 1 and motor 2."""
    foot: Positive
    """Distance from knee to the tip of the foot, along the lower link of motor 2."""
    foot_radius: NotNegative
    """Radius of the foot's rounded tip."""

    coordinates: ClassVar[tuple[str, ...]] = ("swing", "extension")
    units: ClassVar[tuple[str, ...]] = ("rad", "rad")

    def __post_init__(self) -> None:
        """Reject a foot radius that is not smaller than the length of its link."""
        if self.foot_radius >= self.foot > 0:
            raise SurefootError(
                f"leg_geometry.foot_radius is {self.foot_radius:g}; it must be from 0 to foot {self.foot:g} m"
            )

    @property
    def length(self) -> float:
        """Length of the straight leg [m]."""
        return self.upper + self.foot

    def to_motors(self, pose: ArrayLike) -> Array:
        """Convert poses (..., 2, L) [rad] to motor angles (..., L, 2) [rad]."""
        swing, extension = np.moveaxis(np.asarray(pose, float), -2, 0)
        return np.stack([extension + swing, extension - swing], axis=-1)

    def to_pose(self, angles: ArrayLike) -> Array:
        """Convert motor angles (..., L, 2) [rad] to swing and extension (..., 2, L) [rad]."""
        theta_1, theta_2 = _unstack(angles)
        return np.stack([(theta_1 - theta_2) / 2, (theta_1 + theta_2) / 2], axis=-2)

    def knees(self, angles: ArrayLike) -> tuple[Array, Array]:
        """Return the positions (..., 2) [m] of both knees relative to the motor axis, x forward and z up."""
        theta_1, theta_2 = _unstack(angles)
        knee_1 = self.upper * np.stack([np.sin(theta_1), np.cos(theta_1)], -1)
        knee_2 = self.upper * np.stack([-np.sin(theta_2), np.cos(theta_2)], -1)
        return knee_1, knee_2

    def pin(self, angles: ArrayLike) -> Array:
        """Return the position (..., 2) [m] of the pin joint that connects both lower links.

        It is the intersection of circles around the knees that is farther from the motors. NaN if the lower links are
        too short to meet.
        """
        knee_1, knee_2 = self.knees(angles)
        return _triangle_corner(knee_2, self.lower[1], knee_1, self.lower[0])

    def foot_in_plane(self, angles: ArrayLike) -> Array:
        """Return the position (..., 2) [m] of the foot's tip from the motor axis; NaN if the loop can't close."""
        _, knee_2 = self.knees(angles)
        return knee_2 + (self.pin(angles) - knee_2) * (self.foot / self.lower[1])

    def foot_position(self, angles: ArrayLike) -> Array:
        """Return the position (..., 3) [m] of the foot's tip relative to the leg mount, in the base frame."""
        x, z = _unstack(self.foot_in_plane(angles))
        return np.stack([x, np.zeros_like(x), z], -1)

    def foot_pose(self, foot: ArrayLike) -> Array:
        """Return the poses (..., 2, L) [rad] for foot positions (..., L, 3) [m] from the mounts; y is ignored."""
        return np.stack(self.plane_pose(np.asarray(foot, float)[..., ::2]), axis=-2)

    def foot_kinematics(self, angles: Array) -> FootKinematics:
        """Return the poses of the lower links of motor 2 for motor angles (..., 2) [rad], and the motors' leverage."""
        x, z = self.upper * np.sin(angles), self.upper * np.cos(angles)
        x[..., 1] *= -1.0
        # From knee 2 to knee 1, and to the pin.
        x_12, z_12 = x[..., 0] - x[..., 1], z[..., 0] - z[..., 1]
        with np.errstate(invalid="ignore", divide="ignore"):
            inverse = 1.0 / (x_12 * x_12 + z_12 * z_12)
            along = 0.5 + (0.5 * (self.lower[1] ** 2 - self.lower[0] ** 2)) * inverse
            aside = np.sqrt(self.lower[1] ** 2 * inverse - along * along)
        x_pin, z_pin = along * x_12 + aside * z_12, along * z_12 - aside * x_12
        # The pin keeps its distance from knee 1, while the link turns about knee 2.
        x_1, z_1 = x_pin - x_12, z_pin - z_12
        turn = (x_1[..., None] * z - z_1[..., None] * x) / (x_1 * z_pin - z_1 * x_pin)[..., None]
        ratio, pose = self.foot / self.lower[1], np.zeros((*along.shape, 5))
        x_foot, z_foot = ratio * x_pin, ratio * z_pin
        ahead, above = z_foot[..., None] * turn, x_foot[..., None] * -turn
        ahead[..., 1] -= z[..., 1]
        above[..., 1] += x[..., 1]
        pose[..., 0], pose[..., 2], pose[..., 4] = x[..., 1] + x_foot, z[..., 1] + z_foot, np.arctan2(-x_pin, -z_pin)
        return FootKinematics(pose, ahead, above, self.length)

    def plane_pose(self, foot: ArrayLike) -> tuple[Array, Array]:
        """Return swing and extension (...) [rad] for foot positions (..., 2) [m] relative to the motor axis.

        This is the inverse of `foot_in_plane` with the knee of motor 1 in front and the knee of motor 2 behind; NaN if
        out of reach.
        """
        foot, axis = np.asarray(foot, float), np.zeros(2)
        knee_2 = _triangle_corner(axis, self.upper, foot, self.foot)
        pin = knee_2 + (foot - knee_2) * (self.lower[1] / self.foot)
        knee_1 = _triangle_corner(pin, self.lower[0], axis, self.upper)
        # Motor angles of straight legs exceed pi, so the branch cut is at -pi/2.
        angles = np.arctan2([knee_1[..., 0], -knee_2[..., 0]], [knee_1[..., 1], knee_2[..., 1]])
        theta_1, theta_2 = (angles + np.pi / 2) % (2 * np.pi) - np.pi / 2
        return (theta_1 - theta_2) / 2, (theta_1 + theta_2) / 2

    def knee_angles(self, angles: ArrayLike) -> Array:
        """Return the angles (..., 2) [rad] of the lower links about +y; 0 is the direction of the upper link."""
        theta = np.asarray(angles, float) * [1.0, -1.0]
        links = self.pin(angles)[..., None, :] - np.stack(self.knees(angles), -2)
        turn = (np.arctan2(links[..., 0], links[..., 1]) - theta + np.pi) % (2 * np.pi) - np.pi
        # The knee of motor 1 bends past pi when the leg is short, so its branch cut is at 0.
        return np.stack([turn[..., 0] % (2 * np.pi), -(-turn[..., 1] % (2 * np.pi))], -1)

    def is_feasible(self, angles: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the loop can close at these motor angles (..., 2)."""
        return np.asarray(np.isfinite(self.pin(angles)).all(-1))


def _unstack(pairs: ArrayLike) -> tuple[Array, Array]:
    """Split pairs (..., 2) into their two components (...)."""
    array = np.asarray(pairs, float)
    return array[..., 0], array[..., 1]


def _triangle_corner(a: Array, side_a: float, b: Array, side_b: float) -> Array:
    """Return the third corner (..., 2) of a triangle, to the right of the line from corner a to corner b.

    `side_a` and `side_b` are its distances from a and b. NaN if no such triangle exists.
    """
    across = b - a
    distance = np.linalg.norm(across, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = (distance**2 + side_a**2 - side_b**2) / (2 * distance)
        height = np.sqrt(side_a**2 - along**2)
        unit = across / distance
    return a + along * unit + height * np.stack([unit[..., 1], -unit[..., 0]], -1)
