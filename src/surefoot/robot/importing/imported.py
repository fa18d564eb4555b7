"""Data of an imported quadruped with serial legs, as read from a URDF or MJCF."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.robot.appearance import VisualPart
from surefoot.robot.rigid_body import RigidBody

LEGS = ("front_left", "front_right", "back_left", "back_right")
"""Names of the legs, in order."""
_PARTS = ("hip", "upper", "lower")
"""Names of the links of a leg; a leg with two hinges has no hip link."""
Knees = Literal["forward", "backward", "inward", "outward"]
"""Direction of the knees: all forward or backward, or front and back knees towards each other or apart."""
KNEE_SIGNS: dict[Knees, list[int]] = {
    "forward": [1, 1, 1, 1],
    "backward": [-1, -1, -1, -1],
    "inward": [-1, -1, 1, 1],
    "outward": [1, 1, -1, -1],
}
"""Sign of each leg's knee, in the order of `LEGS`: 1 points forward, -1 backward."""
_MIN_BEND = 0.1
"""Minimum knee bend [rad] in a pose that shows the direction of the knee."""


@dataclass(frozen=True)
class ImportedRobot:
    """A robot with four legs in the order of `LEGS`, each with m hinges: (abduction,) hip, knee.

    Positions and directions are in the base frame with all joints at zero, x forward and z up. Numbers that the file
    lacks are NaN.
    """

    name: str
    path: Path
    forward: str
    """Direction in the file's frame that is forward, such as "+x"."""
    base: RigidBody
    base_box: tuple[Array, Array]
    """Centre and half side lengths (3,) [m] of a box around the base."""
    joints: tuple[tuple[str, ...], ...]
    """Names of the hinges by leg (4, m)."""
    bodies: tuple[tuple[RigidBody, ...], ...]
    """Rigid body that each hinge turns (4, m)."""
    axis_points: Array
    """Position of each joint, a point on its axis (4, m, 3) [m]."""
    axes: Array
    """Directions of the joint axes (4, m, 3), exactly along x or y."""
    limits: Array
    """Ranges of the joint angles (4, m, 2) [rad]."""
    kp: Array
    """Stiffness of the joint controllers (4, m) [N m/rad]."""
    kd: Array
    """Damping of the joint controllers (4, m) [N m s/rad]."""
    torque: Array
    """Torque limits (4, m) [N m]."""
    speed: Array
    """Speed limits (4, m) [rad/s]."""
    damping: Array
    """Viscous friction (4, m) [N m s/rad]; 0 where the file's damping is the controller's kd."""
    friction: Array
    """Coulomb friction (4, m) [N m]."""
    rotor_inertia: Array
    """Rotor inertias reflected to the joints (4, m) [kg m2]."""
    feet: Array
    """Centres of the feet (4, 3) [m]."""
    foot_radius: Array
    """Radii of the feet (4,) [m]."""
    parts: tuple[VisualPart, ...] = ()
    """Visual parts in the frames of the links `base` and `link_names`, whose axes are parallel to the base frame and
    whose origins are at their hinges."""
    links_without_mesh: tuple[str, ...] = ()
    """Links with a mesh that could not be read, which are drawn as primitive shapes."""
    poses: tuple[tuple[str, Array], ...] = ()
    """Named poses in the file or in an SRDF next to it: source and angles (4, m) [rad], NaN where unknown."""
    damping_is_kd: bool = False
    """Whether the joint damping in the file was used as `kd`."""
    motor_order: tuple[str, ...] = ()
    """Names of the hinges in the order of the file's actuators; empty if the file has no such order."""
    notes: tuple[str, ...] = ()
    """What was guessed or left out."""
    warnings: tuple[str, ...] = ()
    """Likely errors in the file, and what to do."""

    @property
    def link_names(self) -> tuple[tuple[str, ...], ...]:
        """Names of the links that the hinges turn (4, m)."""
        return tuple(tuple(f"{leg}_{part}" for part in _PARTS[-len(self.joints[0]) :]) for leg in LEGS)

    @property
    def mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return self.base.mass + sum(body.mass for leg in self.bodies for body in leg)

    @property
    def links(self) -> Array:
        """Vectors of upper and lower links in the leg planes, from hip to knee to foot: x and z (2, 4, 2) [m]."""
        hips, knees = self.axis_points[:, -2], self.axis_points[:, -1]
        return np.stack([knees - hips, self.feet - knees])[..., [0, 2]]

    @property
    def length(self) -> float:
        """Mean length of the straight legs [m]."""
        return float(np.linalg.norm(self.links, axis=-1).sum(axis=0).mean())

    @property
    def knee_bends(self) -> Array:
        """Ranges of the knee bends beta (4, 2) [rad], see `serial_leg`; NaN without limits."""
        limits = np.where(np.ptp(self.limits[:, -1:], axis=-1) <= 2 * math.pi, self.limits[:, -1], np.nan)
        return np.sort(self._bends(limits.T).T)

    def _bends(self, angles: Array) -> Array:
        """Return the knee bends beta (..., 4) [rad] at knee angles (..., 4) [rad]."""
        upper, lower = np.arctan2(-self.links[..., 0], -self.links[..., 1])
        at_zero = (lower - upper + math.pi) % (2 * math.pi) - math.pi
        bends: Array = self.axes[:, -1, 1] * angles + at_zero
        return bends

    def to_leg_space(self, angles: Array) -> Array:
        """Convert joint angles (4, m) [rad] to leg space (4, m): (abduction,) swing and extension of each leg."""
        upper_length, lower_length = np.linalg.norm(self.links, axis=-1)
        at_zero = np.arctan2(-self.links[0, :, 0], -self.links[0, :, 1])
        bend = self._bends(angles[:, -1])
        ahead, aside = upper_length + lower_length * np.cos(bend), lower_length * np.sin(bend)
        swing = self.axes[:, -2, 1] * angles[:, -2] + at_zero + np.arctan2(aside, ahead)
        swing = (swing + math.pi) % (2 * math.pi) - math.pi
        extension = np.hypot(ahead, aside) / (upper_length + lower_length)
        side = np.where(self.feet[:, 1] >= 0, 1.0, -1.0)
        abduction = [side * self.axes[:, 0, 0] * angles[:, 0]] if angles.shape[1] == 3 else []
        return np.stack([*abduction, swing, extension], axis=1)

    def guess_knees(self) -> tuple[Knees, str, bool]:
        """Return the direction of the knees, its source, and whether it is a guess.

        The sources are the centres of the knee ranges, then named poses in which all knees are bent, and finally joint
        names: robots with joints HAA, HFE and KFE (ANYmal, HyQ, Solo) have knees that point inward, most others
        backward.
        """
        candidates = [("the knees' limits", self.knee_bends.mean(axis=1))]
        candidates += [(source, self._bends(angles[:, -1])) for source, angles in self.poses]
        for source, bends in candidates:
            for knees, signs in KNEE_SIGNS.items():
                if (bends * signs >= _MIN_BEND).all():
                    return knees, source, False
        if all("KFE" in leg[-1].upper() for leg in self.joints):
            return "inward", "joints named KFE as in ANYmal and Solo, whose knees point inward", True
        return "backward", "neither the knees' limits nor a pose in the file shows it", True
