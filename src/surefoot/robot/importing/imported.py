"""A quadruped with serial legs as a URDF or MJCF describes it."""

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
"""What the hinges of a leg turn; a leg of two hinges has no hip."""
Knees = Literal["forward", "backward", "inward", "outward"]
"""Where knees point: all forward or backward, or front and back ones towards each other or apart."""
KNEE_SIGNS: dict[Knees, list[int]] = {
    "forward": [1, 1, 1, 1],
    "backward": [-1, -1, -1, -1],
    "inward": [-1, -1, 1, 1],
    "outward": [1, 1, -1, -1],
}
"""1 for each leg, in the order of `LEGS`, whose knee points forward, -1 backward."""
_MIN_BEND = 0.1
"""Bend [rad] of a knee from which a pose shows where it points."""


@dataclass(frozen=True)
class ImportedRobot:
    """A robot with four legs, in the order of `LEGS`, of m hinges each: (abduction,) hip, knee.

    Places and directions are in the base's frame with all joints at zero, x forward and z up. A number that the file
    does not have is NaN.
    """

    name: str
    path: Path
    forward: str
    """Direction in the file's frame that is forward."""
    base: RigidBody
    base_box: tuple[Array, Array]
    """Centre and half of the sides (3,) [m] of a box around the base."""
    joints: tuple[tuple[str, ...], ...]
    """Names of the hinges by leg, (4, m)."""
    bodies: tuple[tuple[RigidBody, ...], ...]
    """What each hinge turns, up to the next one, (4, m)."""
    places: Array
    """A point on each axis (4, m, 3) [m]."""
    axes: Array
    """Directions of the axes (4, m, 3), exactly along x or y."""
    limits: Array
    """Ranges of the angles (4, m, 2) [rad]."""
    kp: Array
    """Stiffness of the joints' controllers (4, m) [N m/rad]."""
    kd: Array
    """Damping of the joints' controllers (4, m) [N m s/rad]."""
    torque: Array
    """Torque limits (4, m) [N m]."""
    speed: Array
    """Speed limits (4, m) [rad/s]."""
    damping: Array
    """Viscous friction (4, m) [N m s/rad]; a damping that is the controllers' kd is none."""
    friction: Array
    """Coulomb friction (4, m) [N m]."""
    rotor_inertia: Array
    """Inertia of the rotors at the joints (4, m) [kg m2]."""
    feet: Array
    """Centres of the feet (4, 3) [m]."""
    foot_radius: Array
    """Radii of the feet (4,) [m]."""
    parts: tuple[VisualPart, ...] = ()
    """What is drawn, in the frames of the links `base` and `link_names`: along the base's, at their hinges."""
    undrawn: tuple[str, ...] = ()
    """Links of which a mesh is missing in `parts`: primitive shapes are drawn of these."""
    poses: tuple[tuple[str, Array], ...] = ()
    """Poses that the file or one beside it names: where from, and the angles (4, m) [rad], NaN where unknown."""
    damping_is_kd: bool = False
    """Whether the file's damping of the joints is `kd`."""
    motor_order: tuple[str, ...] = ()
    """Names of the hinges in the order of the file's actuators; empty where it does not say."""
    notes: tuple[str, ...] = ()
    """What was guessed or left out."""
    warnings: tuple[str, ...] = ()
    """What is likely wrong in the file, and what to do."""

    @property
    def link_names(self) -> tuple[tuple[str, ...], ...]:
        """Names of what each hinge turns, by leg, (4, m)."""
        return tuple(tuple(f"{leg}_{part}" for part in _PARTS[-len(self.joints[0]) :]) for leg in LEGS)

    @property
    def mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return self.base.mass + sum(body.mass for leg in self.bodies for body in leg)

    @property
    def links(self) -> Array:
        """Upper and lower links in the legs' planes, hip to knee and knee to foot: x and z (2, 4, 2) [m]."""
        hips, knees = self.places[:, -2], self.places[:, -1]
        return np.stack([knees - hips, self.feet - knees])[..., [0, 2]]

    @property
    def length(self) -> float:
        """Mean length of the straight legs [m]."""
        return float(np.linalg.norm(self.links, axis=-1).sum(axis=0).mean())

    @property
    def knee_bends(self) -> Array:
        """Ranges of the bends beta (4, 2) [rad] of the knees (see `serial_leg`); NaN without limits."""
        limits = np.where(np.ptp(self.limits[:, -1:], axis=-1) <= 2 * math.pi, self.limits[:, -1], np.nan)
        return np.sort(self._bends(limits.T).T)

    def _bends(self, angles: Array) -> Array:
        """Return the bends beta (..., 4) [rad] of the knees at angles (..., 4) [rad]."""
        upper, lower = np.arctan2(-self.links[..., 0], -self.links[..., 1])
        at_zero = (lower - upper + math.pi) % (2 * math.pi) - math.pi
        bends: Array = self.axes[:, -1, 1] * angles + at_zero
        return bends

    def to_leg_space(self, angles: Array) -> Array:
        """Return poses (4, m) in leg space, (abduction,) swing and extension of each leg, of angles (4, m) [rad]."""
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
        """Return where knees point, what shows it, and whether that is a guess.

        The middles of the joints' ranges decide, then a pose of the file's in which all knees are bent. If neither
        shows it, names decide: robots with the joint names HAA, HFE, KFE (ANYmal, HyQ, Solo) have knees that point
        inward, most others backward.
        """
        shown = [("the knees' limits", self.knee_bends.mean(axis=1))]
        shown += [(source, self._bends(angles[:, -1])) for source, angles in self.poses]
        for source, bends in shown:
            for knees, signs in KNEE_SIGNS.items():
                if (bends * signs >= _MIN_BEND).all():
                    return knees, source, False
        if all("KFE" in leg[-1].upper() for leg in self.joints):
            return "inward", "joints named KFE, as ANYmal's and Solo's, whose knees point inward", True
        return "backward", "neither the knees' limits nor a pose in the file show it", True
