"""Closed-form kinematics of serial legs with (abduction,) hip and knee.

The foot moves in the leg plane, which abduction turns about the x axis of the base; hip and knee axes are normal to it.
In the plane, x is forward and z up from the hip axis. h and k are the hip and knee angles about the +y axis of the
base. phi_1 and phi_2 are the directions of upper and lower link at zero angles, measured from straight down (an angle a
points to (-sin a, -cos a)):

    upper link at  u = h + phi_1,   lower link at  u + beta,   beta = k + phi_2 - phi_1
    length  r^2 = l_1^2 + l_2^2 + 2 l_1 l_2 cos beta
    swing   s = u + atan2(l_2 sin beta, l_1 + l_2 cos beta)
    extension  e = r / (l_1 + l_2)

The knee bend beta is 0 for the straight leg, positive for knees that point forward, negative for knees that point
backward.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot.data_sheet import Leg
from surefoot.robot.leg import FootKinematics

_AXIS_TOLERANCE = 1e-6
"""Tolerance of the cosine between a joint axis and an axis of the base."""
_MIN_LENGTH = 1e-3
"""Minimum length of a link [m]."""


@dataclass(frozen=True)
class SerialLegs:
    """Kinematics of L serial legs with two or three motors each; arrays (L,) unless stated otherwise.

    Motor angles theta and joint angles about the base's +x (abduction) and +y (hip, knee) axes differ by a sign:
    joint angle = turn * theta.
    """

    turn: Array
    """Sign of each motor (L, m), 1 or -1."""
    side: Array
    """1 for legs on the left, -1 on the right: positive abduction moves the foot away from the sagittal plane."""
    hip: Array
    """Position (L, 2) of the hip axis relative to the abduction axis at zero angles, y and z in the base frame [m]; y
    includes all lateral offsets of the leg plane. Zero without abduction."""
    upper: Array
    """Distance l_1 between hip and knee axes [m]."""
    lower: Array
    """Distance l_2 between the knee axis and the foot's centre [m]."""
    upper_angle: Array
    """Direction phi_1 of the upper link at zero angles [rad]."""
    lower_angle: Array
    """Direction phi_2 of the lower link at zero angles [rad]."""
    knee: Array
    """Sign of beta: 1 for knees that point forward, -1 for knees that point backward."""

    @classmethod
    def from_positions(
        cls, legs: Sequence[Leg], mounts: Array, positions: Array, axes: Array, signs: Array, feet: Array
    ) -> SerialLegs:
        """Compute the geometry from joint axes and foot positions at zero angles, all in the base frame.

        Args:
            legs: names of the legs and their motors, and knee directions.
            mounts: positions (L, 3) [m] to which `foot_position` is relative.
            positions: points (L, m, 3) [m] on the joint axes.
            axes: directions (L, m, 3) of the joint axes.
            signs: ratio of joint angle to motor angle (L, m), 1 or -1.
            feet: centres (L, 3) [m] of the feet.

        Raises:
            SurefootError: an axis is not along the base's x (abduction) or y (hip, knee), or a link has no length.
        """
        along = np.array((0, 1, 1)[-positions.shape[1] :])
        cosines = np.take_along_axis(axes, along[None, :, None], axis=2)[..., 0]
        for row, motor in np.argwhere(np.abs(np.abs(cosines) - 1.0) > _AXIS_TOLERANCE):
            x, y, z = axes[row, motor]
            raise SurefootError(
                f"legs.{legs[row].name}: {legs[row].motors[motor]}: its axis at zero is ({x:.3g}, {y:.3g}, {z:.3g}) "
                f"in the base frame; it must be along {'xy'[along[motor]]}"
            )
        hips, knees = positions[:, -2], positions[:, -1]
        links = np.stack([knees - hips, feet - knees])[..., [0, 2]]
        lengths = np.array([[np.linalg.norm(link) for link in row] for row in links])
        for part, row in np.argwhere(~(lengths > _MIN_LENGTH)):
            name = ("hip to knee", "knee to foot")[part]
            raise SurefootError(
                f"legs.{legs[row].name}: the link from {name} is {lengths[part, row]:.3g} m long; it must be over "
                f"{_MIN_LENGTH:g} m long"
            )
        return cls(
            turn=np.sign(cosines) * signs,
            side=np.where(feet[:, 1] >= 0, 1.0, -1.0),
            hip=np.column_stack([feet[:, 1], hips[:, 2]]) - mounts[:, 1:],
            upper=lengths[0],
            lower=lengths[1],
            upper_angle=np.arctan2(-links[0, :, 0], -links[0, :, 1]),
            lower_angle=np.arctan2(-links[1, :, 0], -links[1, :, 1]),
            knee=np.array([1.0 if leg.knee == "forward" else -1.0 for leg in legs]),
        )

    @property
    def abducts(self) -> bool:
        """Whether the legs have a motor for abduction."""
        return self.turn.shape[1] == 3

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the leg-space coordinates."""
        return ("abduction", "swing", "extension") if self.abducts else ("swing", "extension")

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the coordinates; extension is relative to the straight leg's length."""
        return ("rad", "rad", "1") if self.abducts else ("rad", "1")

    @functools.cached_property
    def _link_angles(self) -> Array:
        """Directions of the upper link, and of the lower link from the upper one, at zero angles (L, 2) [rad]."""
        return np.stack([self.upper_angle, self.lower_angle - self.upper_angle], axis=-1)

    @functools.cached_property
    def _plane_turn(self) -> Array:
        """Sign with which hip and knee motors (L, 2) move the foot backward."""
        return -self.turn[:, -2:]

    @functools.cached_property
    def _lengths(self) -> Array:
        """Lengths of upper and lower links (L, 2) [m]."""
        return np.stack([self.upper, self.lower], axis=-1)

    @functools.cached_property
    def length(self) -> float:
        """Mean length of the straight legs [m]."""
        return float(np.mean(self.upper + self.lower))

    def _joints(self, angles: ArrayLike) -> tuple[Array, Array, Array]:
        """Return abduction about +x, upper link angle u and knee bend beta (..., L) [rad] from motor angles."""
        joint = np.asarray(angles, float) * self.turn
        upper = joint[..., -2] + self.upper_angle
        beta = joint[..., -1] + self.lower_angle - self.upper_angle
        return joint[..., 0] if self.abducts else np.zeros_like(upper), upper, beta

    def to_pose(self, angles: ArrayLike) -> Array:
        """Convert motor angles (..., L, m) [rad] to poses (..., C, L)."""
        abduction, upper, beta = self._joints(angles)
        ahead, aside = self.upper + self.lower * np.cos(beta), self.lower * np.sin(beta)
        parts = [upper + np.arctan2(aside, ahead), np.hypot(ahead, aside) / (self.upper + self.lower)]
        return np.stack([self.side * abduction, *parts] if self.abducts else parts, axis=-2)

    def to_motors(self, pose: ArrayLike) -> Array:
        """Convert poses (..., C, L) to motor angles (..., L, m) [rad]; NaN if out of reach."""
        pose = np.asarray(pose, float)
        swing, length = pose[..., -2, :], pose[..., -1, :] * (self.upper + self.lower)
        cosine = (length**2 - self.upper**2 - self.lower**2) / (2 * self.upper * self.lower)
        with np.errstate(invalid="ignore"):
            # The straight leg's cosine may exceed 1 by rounding.
            beta = self.knee * np.arccos(np.where(np.abs(cosine - 1) < 1e-12, 1.0, cosine))
        upper = swing - np.arctan2(self.lower * np.sin(beta), self.upper + self.lower * np.cos(beta))
        joints = [upper - self.upper_angle, beta - self.lower_angle + self.upper_angle]
        if self.abducts:
            joints = [self.side * pose[..., 0, :], *joints]
        return np.stack(joints, axis=-1) * self.turn

    def foot_in_plane(self, angles: ArrayLike) -> Array:
        """Return the foot centres (..., L, 2) [m] in the leg planes relative to the hip axes, x forward and z up."""
        _, upper, beta = self._joints(angles)
        x = -self.upper * np.sin(upper) - self.lower * np.sin(upper + beta)
        z = -self.upper * np.cos(upper) - self.lower * np.cos(upper + beta)
        return np.stack([x, z], axis=-1)

    def plane_pose(self, foot: ArrayLike) -> tuple[Array, Array]:
        """Return swing [rad] and extension (..., L) for foot positions (..., L, 2) [m] in the leg planes.

        NaN if out of reach.
        """
        position = np.asarray(foot, float)
        extension = np.hypot(position[..., 0], position[..., 1]) / (self.upper + self.lower)
        min_extension = np.abs(self.upper - self.lower) / (self.upper + self.lower)
        in_reach = (extension <= 1.0) & (extension >= min_extension)
        swing = np.arctan2(-position[..., 0], -position[..., 1])
        return np.where(in_reach, swing, np.nan), np.where(in_reach, extension, np.nan)

    def foot_position(self, angles: ArrayLike) -> Array:
        """Return the foot centres (..., L, 3) [m] relative to the leg mounts, in the base frame."""
        abduction, _, _ = self._joints(angles)
        plane = self.foot_in_plane(angles)
        y, z = self.hip[:, 0], self.hip[:, 1] + plane[..., 1]
        cos, sin = np.cos(abduction), np.sin(abduction)
        return np.stack([plane[..., 0], cos * y - sin * z, sin * y + cos * z], axis=-1)

    def foot_pose(self, foot: ArrayLike) -> Array:
        """Return the poses (..., C, L) for foot positions (..., L, 3) [m] relative to and below the leg mounts.

        A leg without abduction ignores y and stays in its plane. NaN if out of reach.
        """
        position = np.asarray(foot, float)
        x, y, z = position[..., 0], position[..., 1], position[..., 2]
        if not self.abducts:
            return np.stack(self.plane_pose(np.stack([x, z - self.hip[:, 1]], -1)), axis=-2)
        aside = self.hip[:, 0]
        with np.errstate(invalid="ignore"):
            below = -np.sqrt(y**2 + z**2 - aside**2)
        turned = np.arctan2(z, y) - np.arctan2(below, aside)
        abduction = (turned + np.pi) % (2 * np.pi) - np.pi
        return np.stack([self.side * abduction, *self.plane_pose(np.stack([x, below - self.hip[:, 1]], -1))], axis=-2)

    def foot_kinematics(self, angles: Array) -> FootKinematics:
        """Return the poses of the lower links for motor angles (..., L, m) [rad], and the motors' leverage."""
        joints = angles * self.turn
        joints[..., -2:] += self._link_angles
        joints[..., -1] += joints[..., -2]
        sine, cosine, pose = np.sin(joints), np.cos(joints), np.zeros((*joints.shape[:-1], 5))
        # Reach backward and drop below the hip axis: of the whole leg, and of the lower link.
        reach, drop = self._lengths * sine[..., -2:], self._lengths * cosine[..., -2:]
        reach[..., 0] += reach[..., 1]
        drop[..., 0] += drop[..., 1]
        pose[..., 0], pose[..., 4], z = -reach[..., 0], joints[..., -1], self.hip[:, 1] - drop[..., 0]
        ahead, above = drop * self._plane_turn, reach * self.turn[:, -2:]
        if not self.abducts:
            pose[..., 1], pose[..., 2] = self.hip[:, 0], z
            return FootKinematics(pose, ahead, above, self.length)
        y, cos, sin, turn = self.hip[:, 0], cosine[..., 0], sine[..., 0], self.turn[:, 0]
        pose[..., 1], pose[..., 2], pose[..., 3] = cos * y - sin * z, sin * y + cos * z, joints[..., 0]
        return FootKinematics(pose, ahead, above, self.length, (cos, sin, y * turn, z * turn))

    def is_feasible(self, angles: ArrayLike) -> NDArray[np.bool_]:
        """Return true for each leg (..., L) with finite angles: a serial leg has no loop that must close."""
        return np.isfinite(np.asarray(angles, float)).all(axis=-1)

    def knee_angles(self, angles: ArrayLike) -> Array:
        """Return an empty array (..., L, 0): every joint has a motor."""
        return np.zeros((*np.shape(angles)[:-1], 0))
