"""Kinematics of feet that step in any direction: poses for strides, lifts and footholds, and the legs' reach."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.foot_paths import FootPaths

_LOAD_TRANSFER_FRACTION = 0.15
"""Fraction of the stance in which a leg takes over its share of the weight, and in which it gives it back."""
_TURNS = 16
"""Directions in which the reach is searched."""
_LENGTHS = 50
"""Lengths up to the longest step at which the reach is searched."""
_OFFSET_END_PHASE = 0.8
"""Fraction of the swing after which a foot is beside its stride by as much as it lands: soft legs lag."""
_LIFT_END_PHASE = 0.2
"""Fraction of the swing in which a foot gets its lift by touch."""
_LOWERING_FRACTION = 0.25
"""Fraction of the swing in which it gives that lift back."""
_ASIDE = 0.5
"""Ratio of the ellipse's axis to the side, in which footholds are, to its axis ahead."""


@dataclass(frozen=True)
class FootKinematics:
    """Poses of a robot's L legs whose feet go along strides.

    Raises:
        SurefootError: feet that are lifted up to their motors.
    """

    robot: RobotDescription
    feet: FootPaths
    """Clearance, phases and posture of the feet; its stroke is the longest stride."""
    clearance_rise: float = 0.0
    """Clearance gained at the longest stride, relative to the clearance on the spot."""
    height_rise: float = 0.0
    """Height gained at the longest stride, relative to the height on the spot."""
    foothold_radius: float = 0.0
    """Maximum distance [m] by which feet land beside the ends of their strides, see `Footholds`."""
    touch_clearance: float = 0.0
    """Maximum height [m] by which feet are lifted further that meet something, see `ContactReflex`."""
    places: Array = field(init=False, repr=False, compare=False)
    """Feet below the legs' mounts, (L, 3) [m] from the mounts; z is the height."""
    _reach: float = field(init=False, repr=False, compare=False, default=0.0)
    """How far ahead [m] all feet reach from their places, in an ellipse, when they are lowest."""

    def __post_init__(self) -> None:
        """Compute places and reach."""
        if self.touch_clearance and np.any(self.feet.clearance + self.touch_clearance >= self.feet.height):
            raise SurefootError(
                f"reference.touch_clearance lifts feet by {self.touch_clearance:.3f} m, up to their motors: with "
                f"clearance it must be less than height, {float(np.min(self.feet.height)):.3f} m"
            )
        legs, resting = self.robot.leg_geometry, self._resting_angles()
        _, aside, below = legs.foot_position(resting).T
        axis = below - legs.foot_in_plane(resting)[:, 1]
        places = np.stack(np.broadcast_arrays(self.feet.offset, aside, axis - self.feet.height), -1)
        object.__setattr__(self, "places", places)
        if self.foothold_radius:
            object.__setattr__(self, "_reach", self._find_reach())

    def _resting_angles(self) -> Array:
        """Return the motor angles (L, m) of legs without abduction or swing."""
        pose = np.array(self.robot.rest)
        pose[:-1] = 0.0
        return self.robot.leg_geometry.to_motors(np.repeat(pose[:, None], len(self.feet.legs), axis=1))

    def _find_reach(self) -> float:
        most = float(self.feet.stroke.max()) / 2 + self.foothold_radius
        length, turn = np.linspace(0.0, most, _LENGTHS)[:, None], np.linspace(0.0, 2 * np.pi, _TURNS, endpoint=False)
        aside = np.stack([length * np.cos(turn), _ASIDE * length * np.sin(turn), np.zeros((_LENGTHS, _TURNS))], axis=-1)
        lowest = self.places - [[0.0, 0.0, depth] for depth in np.broadcast_to(self.feet.depth, len(self.places))]
        poses = self.robot.leg_geometry.foot_pose(aside[..., None, :] + lowest)
        reached = np.isfinite(poses).all(axis=(1, 2, 3))
        return float(length[int(np.argmin(reached)) - 1 if not reached.all() else -1, 0])

    def pose(self, state: CommandState, strides: Array, share: Array) -> Array:
        """Return the poses (N, C, L) in leg space at the state's phases, NaN out of reach.

        Args:
            state: phases, fraction of full steps, lifts and footholds.
            strides: forward and to the left (N, L, 2) [m].
            share: ratio of the longest of them to the longest allowed (N,).
        """
        along, bump = self.feet.curve(state.phase)
        active = state.activity[:, None]
        step = (active * along)[..., None] * strides
        if self.clearance_rise or self.height_rise:
            lifted = np.where(bump > 0.0, bump * (1.0 + self.clearance_rise * share[:, None]), bump)
            bump = lifted - self.height_rise * share[:, None] * self.feet.height
        high = np.zeros_like(bump)
        if self.touch_clearance and state.lift is not None:
            raised = self._lift_profile(state.phase) * state.lift
            bump, high = bump + raised, raised / self.touch_clearance
        if state.lift_off is not None and state.landing is not None:
            beside = self._foothold_offset(state.phase, state.lift_off, state.landing)
            # High feet are not in reach of legs far to their side, and near the axis of abduction of none.
            beside[..., 1] *= np.maximum(1.0 - 2.0 * high, 0.0)
            step = step + beside
            step = step / np.maximum(1.0, self.reached(step))[..., None]
        step[..., 1] *= 1.0 - high
        foot = np.concatenate([step, (active * bump)[..., None]], axis=-1) + self.places
        return self.robot.leg_geometry.foot_pose(foot)

    def _lift_profile(self, phase: Array) -> Array:
        """Return the fraction of the lift by touch that feet have (N, L): soon, and to the end of the swing."""
        part = self.feet.swing_phase(phase)
        return np.asarray(np.clip(np.minimum(part / _LIFT_END_PHASE, (1.0 - part) / _LOWERING_FRACTION), 0.0, 1.0))

    def _foothold_offset(self, phase: Array, lift_off: Array, landing: Array) -> Array:
        """Return how far feet are beside the places of their strides (N, L, 2) [m]."""
        part = np.clip(self.feet.swing_phase(phase) / _OFFSET_END_PHASE, 0.0, 1.0)[..., None]
        over = np.where(part > 0.0, part**2 * (3.0 - 2.0 * part), 1.0)
        return np.asarray(lift_off + over * (landing - lift_off))

    def reached(self, step: Array) -> Array:
        """Return the ratio to their reach (...) of feet that are beside their places by steps (..., 2) [m]."""
        return np.asarray(np.hypot(step[..., 0], step[..., 1] / _ASIDE) / self._reach)

    def load(self, state: CommandState) -> Array:
        """Return the fraction of the weight that each leg carries (N, L), the same for all legs in stance."""
        share, duty = self.feet.shares(state.phase), self.feet.duty_factor
        part = np.minimum(share, duty - share) / duty
        carried = np.clip(part / _LOAD_TRANSFER_FRACTION, 0.0, 1.0)
        carried = carried / np.maximum(carried.sum(axis=1, keepdims=True), 0.5)
        active = state.activity[:, None]
        return np.asarray(active * carried + (1.0 - active) / len(self.feet.legs))
