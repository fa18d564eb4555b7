"""Foot trajectories in the legs' planes.

A foot's cycle begins with its touchdown. In stance it goes backward by its stroke at constant speed; in swing it goes
forward again on a cubic curve that begins and ends with the speed of the stance, so that it lands without a jerk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot.leg import Legs

PER_LEG_QUANTITIES = ("stroke", "clearance", "duty_factor", "phase", "height", "offset", "depth")
"""Quantities that each leg has of its own."""
LENGTHS = ("stroke", "clearance", "height", "offset", "depth")
"""Quantities that are lengths."""
_SAMPLES = 360
"""Samples of a cycle at which the reach of the legs is checked."""


@dataclass(frozen=True)
class FootPaths:
    """Paths of feet; arrays (L,), or (N, L) where each of N robots has its own.

    Raises:
        SurefootError: a path out of the leg's reach.
    """

    legs: tuple[str, ...]
    leg: Legs
    frequency: Array
    """Cycles a second [Hz], () or (N, 1)."""
    stroke: Array
    """How far a foot goes backward in stance, relative to the base [m]; below 0: forward."""
    clearance: Array
    """How far it is lifted in the middle of its swing [m]."""
    duty_factor: Array
    """Fraction of the cycle in stance."""
    phase: Array
    """When its cycle begins, in cycles."""
    height: Array
    """Height of the motor axis over the foot's end at touchdown and lift-off [m]."""
    offset: Array
    """Position of the middle of the stroke, forward from the motor axis [m]."""
    depth: Array
    """How far it is pressed below that height in the middle of its stance [m]."""
    extent: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)
    """Lowest and highest value of each coordinate of leg space over all legs and times."""

    def __post_init__(self) -> None:
        """Reject paths out of reach."""
        paths = self.path(np.linspace(0.0, 1.0, _SAMPLES, endpoint=False)[:, None])
        poses = self.leg.plane_pose(paths)
        lost = ~np.isfinite(poses[0])
        if lost.any():
            place, (x, z) = np.argwhere(lost)[0], paths[lost][0]
            raise SurefootError(
                f"reference.foot: the foot of {self.legs[place[-1]]} goes to {x:.3f} m before and {-z:.3f} m below its "
                "motors, out of the leg's reach; change height, offset, stroke, depth or clearance"
            )
        extent = [(float(part.min()), float(part.max())) for part in poses]
        object.__setattr__(self, "extent", (*[(0.0, 0.0)] * (len(self.leg.coordinates) - 2), *extent))

    @property
    def period(self) -> Any:
        """Duration of a cycle [s], a number; (N,) where robots have paths of their own."""
        period = 1.0 / np.reshape(self.frequency, -1)
        return float(period[0]) if self.frequency.ndim == 0 else period

    @property
    def speed(self) -> Array:
        """Speed [m/s] at which feet go backward in stance: the base's speed, if they do not slip."""
        return self.stroke * self.frequency / self.duty_factor

    def shares(self, cycle: ArrayLike) -> Array:
        """Return the elapsed fraction of each leg's own cycle (..., N, L), 0 to 1, after cycles (..., N)."""
        return np.asarray((np.asarray(cycle, float)[..., None] - self.phase) % 1.0)

    def swing_phase(self, cycle: ArrayLike) -> Array:
        """Return the elapsed fraction of each leg's swing (..., N, L), 0 to 1, after cycles (..., N).

        It is negative in stance.
        """
        return np.asarray((self.shares(cycle) - self.duty_factor) / (1.0 - self.duty_factor))

    def curve(self, cycle: ArrayLike) -> tuple[Array, Array]:
        """Return where feet are along their strokes, .5 (front) to -.5, and above `height` [m], after cycles (..., N).

        Both (..., N, L).
        """
        share, duty = self.shares(cycle), self.duty_factor
        stance = share < duty
        part = np.where(stance, share / duty, (share - duty) / (1.0 - duty))
        # Slope at both ends of the swing, in strokes over a swing: the speed of the stance.
        slope = -(1.0 - duty) / duty
        forward = -0.5 + part**2 * (3.0 - 2.0 * part) + slope * part * (1.0 - part) * (1.0 - 2.0 * part)
        bump = np.where(stance, -self.depth, self.clearance) * (1.0 - np.cos(2.0 * np.pi * part)) / 2.0
        return np.where(stance, 0.5 - part, forward), bump

    def path(self, cycle: ArrayLike) -> Array:
        """Return the positions (..., N, L, 2) [m] of the feet's ends after cycles (..., N), x forward and z up."""
        along, bump = self.curve(cycle)
        return np.stack(np.broadcast_arrays(self.offset + self.stroke * along, bump - self.height), -1)

    def pose(self, time: ArrayLike) -> Array:
        """Return the poses (N, C, L) in leg space at times (N,) [s], without abduction."""
        swing, extension = self.leg.plane_pose(self.path(np.asarray(time, float) * np.reshape(self.frequency, -1)))
        level = [np.zeros_like(swing)] * (len(self.leg.coordinates) - 2)
        return np.stack([*level, swing, extension], axis=-2)

    @classmethod
    def stacked(cls, paths: Sequence[FootPaths]) -> FootPaths:
        """Return the paths of N robots, out of one robot's paths each."""
        first = paths[0]
        values: dict[str, Any] = {name: np.stack([getattr(one, name) for one in paths]) for name in PER_LEG_QUANTITIES}
        frequency = np.array([[one.frequency] for one in paths], float)
        return cls(first.legs, first.leg, frequency, **values)

    def to_dict(self) -> dict[str, Any]:
        """Return the `FootConfig` that makes them again, as JSON values."""
        values = {name: dict(zip(self.legs, getattr(self, name).tolist(), strict=True)) for name in PER_LEG_QUANTITIES}
        return {"frequency": float(self.frequency), **values}
