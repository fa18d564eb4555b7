"""Foot trajectories in the legs' planes.

A foot's cycle begins at touchdown. In stance the foot moves backward by its stroke at constant speed. In swing it moves
forward along a cubic curve that starts and ends with the stance velocity, so that velocity does not jump at touchdown.
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
"""Quantities with one value per leg."""
LENGTHS = ("stroke", "clearance", "height", "offset", "depth")
"""Quantities that are lengths."""
_SAMPLES = 360
"""Number of phases of a cycle at which the reach of the legs is checked."""


@dataclass(frozen=True)
class FootPaths:
    """Periodic foot trajectories of L legs. Arrays are (L,), or (N, L) for N robots with different trajectories.

    Raises:
        SurefootError: a trajectory out of the leg's reach.
    """

    legs: tuple[str, ...]
    leg: Legs
    frequency: Array
    """Cycles a second [Hz], () or (N, 1)."""
    stroke: Array
    """Distance that a foot moves backward in stance, relative to the base [m]; negative: forward."""
    clearance: Array
    """Lift of the foot in the middle of the swing [m]."""
    duty_factor: Array
    """Fraction of the cycle in stance."""
    phase: Array
    """Phase offset of the foot's cycle [cycles]."""
    height: Array
    """Height of the motor axis above the end of the foot at touchdown and lift-off [m]."""
    offset: Array
    """Position of the middle of the stroke, forward from the motor axis [m]."""
    depth: Array
    """Depth below `height` to which the foot is commanded in the middle of the stance [m]."""
    extent: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)
    """Minimum and maximum of each coordinate of leg space over all legs and times."""

    def __post_init__(self) -> None:
        """Reject trajectories out of reach."""
        paths = self.path(np.linspace(0.0, 1.0, _SAMPLES, endpoint=False)[:, None])
        poses = self.leg.plane_pose(paths)
        lost = ~np.isfinite(poses[0])
        if lost.any():
            place, (x, z) = np.argwhere(lost)[0], paths[lost][0]
            raise SurefootError(
                f"reference.foot: the foot of {self.legs[place[-1]]} moves {x:.3f} m ahead of and {-z:.3f} m below "
                "its motors, out of the leg's reach; change height, offset, stroke, depth or clearance"
            )
        extent = [(float(part.min()), float(part.max())) for part in poses]
        object.__setattr__(self, "extent", (*[(0.0, 0.0)] * (len(self.leg.coordinates) - 2), *extent))

    @property
    def period(self) -> Any:
        """Duration of a cycle [s]: a number, or (N,) if robots have different trajectories."""
        period = 1.0 / np.reshape(self.frequency, -1)
        return float(period[0]) if self.frequency.ndim == 0 else period

    @property
    def speed(self) -> Array:
        """Speed of feet relative to the base in stance [m/s]: the speed of the base, unless feet slip."""
        return self.stroke * self.frequency / self.duty_factor

    def cycle_phase(self, cycle: ArrayLike) -> Array:
        """Return the phase of each leg's cycle (..., N, L), 0 to 1, after cycles (..., N)."""
        return np.asarray((np.asarray(cycle, float)[..., None] - self.phase) % 1.0)

    def swing_phase(self, cycle: ArrayLike) -> Array:
        """Return the phase of each leg's swing (..., N, L), 0 to 1 and negative in stance, after cycles (..., N)."""
        return np.asarray((self.cycle_phase(cycle) - self.duty_factor) / (1.0 - self.duty_factor))

    def curve(self, cycle: ArrayLike) -> tuple[Array, Array]:
        """Return positions of feet after cycles (..., N), normalized along their strokes, and vertical [m].

        Returns:
            Position along the stroke, from 0.5 (front) to -0.5 (back), and height relative to `height` [m], (..., N, L)
            each.
        """
        phase, duty = self.cycle_phase(cycle), self.duty_factor
        stance = phase < duty
        # Phase of the stance or of the swing, 0 to 1.
        part = np.where(stance, phase / duty, (phase - duty) / (1.0 - duty))
        # Slope at both ends of the swing, in strokes per swing: equal to the velocity in stance.
        slope = -(1.0 - duty) / duty
        forward = -0.5 + part**2 * (3.0 - 2.0 * part) + slope * part * (1.0 - part) * (1.0 - 2.0 * part)
        bump = np.where(stance, -self.depth, self.clearance) * (1.0 - np.cos(2.0 * np.pi * part)) / 2.0
        return np.where(stance, 0.5 - part, forward), bump

    def path(self, cycle: ArrayLike) -> Array:
        """Return foot positions (..., N, L, 2) [m] after cycles (..., N): x forward and z up from the motor axis."""
        along, bump = self.curve(cycle)
        return np.stack(np.broadcast_arrays(self.offset + self.stroke * along, bump - self.height), -1)

    def pose(self, time: ArrayLike) -> Array:
        """Return the leg poses (N, C, L) in leg space at times (N,) [s], with zero abduction."""
        swing, extension = self.leg.plane_pose(self.path(np.asarray(time, float) * np.reshape(self.frequency, -1)))
        level = [np.zeros_like(swing)] * (len(self.leg.coordinates) - 2)
        return np.stack([*level, swing, extension], axis=-2)

    @classmethod
    def stack(cls, paths: Sequence[FootPaths]) -> FootPaths:
        """Combine the trajectories of N single robots into a batch."""
        first = paths[0]
        values: dict[str, Any] = {name: np.stack([getattr(one, name) for one in paths]) for name in PER_LEG_QUANTITIES}
        frequency = np.array([[one.frequency] for one in paths], float)
        return cls(first.legs, first.leg, frequency, **values)

    def to_dict(self) -> dict[str, Any]:
        """Return the equivalent `FootConfig` as JSON values."""
        values = {name: dict(zip(self.legs, getattr(self, name).tolist(), strict=True)) for name in PER_LEG_QUANTITIES}
        return {"frequency": float(self.frequency), **values}
