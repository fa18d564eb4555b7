"""A quadruped with serial legs as a URDF or MJCF describes it.

All places and directions are in the base's frame with all joints at zero, x forward and z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.robot.rigid_body import RigidBody

LEGS = ("front_left", "front_right", "back_left", "back_right")
"""Names of the legs, in order."""
Knees = Literal["forward", "backward", "inward", "outward"]
"""Where knees point: all forward or backward, or front and back ones towards each other or apart."""
_KNEE_SIGNS = {
    "forward": [1, 1, 1, 1],
    "backward": [-1, -1, -1, -1],
    "inward": [-1, -1, 1, 1],
    "outward": [1, 1, -1, -1],
}


@dataclass(frozen=True)
class ImportedJoint:
    """A hinge of a leg, as the file has it."""

    name: str
    place: Array
    """A point on its axis (3,) [m]."""
    axis: Array
    """Its direction (3,), of length 1."""
    limits: tuple[float, float] | None
    """Least and greatest angle [rad]."""
    torque: float | None
    """Greatest torque [N m]."""
    speed: float | None
    """Greatest speed [rad/s]."""
    damping: float
    """Viscous friction [N m s/rad]."""
    friction: float
    """Coulomb friction [N m]."""
    rotor_inertia: float
    """Inertia of the rotor at the joint [kg m2]."""


@dataclass(frozen=True)
class ImportedLeg:
    """A chain of hinges from the base to a foot."""

    joints: tuple[ImportedJoint, ...]
    bodies: tuple[RigidBody, ...]
    """What each joint turns, up to the next one; in the base's frame."""
    foot: Array
    """Centre of the foot (3,) [m]."""
    foot_radius: float
    """[m]"""
    foot_source: str = ""
    """How the foot was recognized."""

    @property
    def links(self) -> tuple[Array, Array]:
        """Upper and lower link in the leg's plane, hip to knee and knee to foot: x and z (2,) [m]."""
        hip, knee = (joint.place for joint in self.joints[-2:])
        return (knee - hip)[[0, 2]], (self.foot - knee)[[0, 2]]

    @property
    def lengths(self) -> tuple[float, float]:
        """Lengths of upper and lower link [m]."""
        upper, lower = self.links
        return float(np.linalg.norm(upper)), float(np.linalg.norm(lower))

    @property
    def knee_range(self) -> tuple[float, float] | None:
        """Least and greatest bend beta of the knee [rad] (see `serial_leg`) by its limits; None if it has none."""
        knee, (upper, lower) = self.joints[-1], self.links
        if knee.limits is None or knee.limits[1] - knee.limits[0] > 2 * math.pi:
            return None
        angle = math.atan2(-lower[0], -lower[1]) - math.atan2(-upper[0], -upper[1])
        at_zero = (angle + math.pi) % (2 * math.pi) - math.pi
        low, high = sorted(knee.axis[1] * limit + at_zero for limit in knee.limits)
        return low, high

    @property
    def knee_sign(self) -> int:
        """1 if the middle of the knee's range points forward, -1 if backward, 0 if the range does not show it."""
        middle = sum(self.knee_range or (0.0, 0.0)) / 2
        return 0 if abs(middle) < 0.1 else int(math.copysign(1, middle))


@dataclass(frozen=True)
class ImportedRobot:
    """A quadruped as a file describes it."""

    name: str
    path: Path
    base: RigidBody
    base_box: tuple[Array, Array]
    """Centre and half of the sides (3,) [m] of a box around the base."""
    legs: tuple[ImportedLeg, ...]
    """In the order of `LEGS`."""
    forward: str
    """Direction in the file's frame that is forward."""
    notes: tuple[str, ...] = ()
    """What was guessed or left out."""

    @property
    def mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return self.base.mass + sum(body.mass for leg in self.legs for body in leg.bodies)

    @property
    def length(self) -> float:
        """Mean length of the straight legs [m]."""
        return float(np.mean([sum(leg.lengths) for leg in self.legs]))

    def knee_signs(self, knees: Knees | None) -> tuple[list[int], bool]:
        """Return 1 for each leg whose knee points forward, -1 backward; and whether that is certain.

        Without `knees`, the joints' limits decide; knees whose limits do not show it point backward.
        """
        if knees is not None:
            return _KNEE_SIGNS[knees], True
        signs = [leg.knee_sign for leg in self.legs]
        return [sign or -1 for sign in signs], all(signs)
