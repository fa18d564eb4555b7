"""Kinematics of omnidirectional stepping: leg poses for strides, lifts and footholds, within the legs' reach."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.foot_paths import FootPaths

_LOAD_TRANSFER_FRACTION = 0.15
"""Fraction of the stance over which a leg loads after touchdown, and over which it unloads before lift-off."""
_REACH_DIRECTIONS = 16
"""Number of directions in which the reach is sampled."""
_REACH_LENGTHS = 50
"""Number of step lengths, up to the longest step, at which the reach is sampled."""
_OFFSET_END_PHASE = 0.8
"""Swing phase at which a foot has its full foothold offset: early, because soft legs lag."""
_LIFT_END_PHASE = 0.2
"""Swing phase at which a foot has its full additional lift."""
_LOWERING_FRACTION = 0.25
"""Fraction of the swing, at its end, in which the additional lift is removed."""
_REACH_ASPECT_RATIO = 0.5
"""Ratio of the lateral to the longitudinal axis of the ellipse of reachable footholds."""


@dataclass(frozen=True)
class SteppingKinematics:
    """Leg poses of a robot with L legs whose feet follow strides in any direction.

    Raises:
        SurefootError: feet are lifted up to the height of their motors.
    """

    robot: RobotDescription
    feet: FootPaths
    """Clearance, phases and posture of the feet. The stroke is the maximum stride."""
    clearance_rise: float = 0.0
    """Increase of the clearance at the maximum stride, relative to the clearance when stepping in place."""
    height_rise: float = 0.0
    """Increase of the base height at the maximum stride, relative to the height when stepping in place."""
    foothold_radius: float = 0.0
    """Maximum distance [m] of footholds from the ends of their strides, see `Footholds`."""
    touch_clearance: float = 0.0
    """Maximum additional lift [m] of feet after contact in swing, see `ContactReflex`."""
    neutral_feet: Array = field(init=False, repr=False, compare=False)
    """Neutral foot positions relative to the legs' mounts (L, 3) [m]; z is the height."""
    _reach: float = field(init=False, repr=False, compare=False, default=0.0)
    """Longitudinal semi-axis [m] of the ellipse around the neutral positions that all feet can reach at full depth."""

    def __post_init__(self) -> None:
        """Compute neutral foot positions and reach."""
        if self.touch_clearance and np.any(self.feet.clearance + self.touch_clearance >= self.feet.height):
            raise SurefootError(
                f"reference.touch_clearance lifts feet by {self.touch_clearance:.3f} m, up to their motors: with "
                f"clearance it must be less than height, {float(np.min(self.feet.height)):.3f} m"
            )
        legs, resting = self.robot.leg_geometry, self._resting_angles()
        _, aside, below = legs.foot_position(resting).T
        axis = below - legs.foot_in_plane(resting)[:, 1]
        neutral_feet = np.stack(np.broadcast_arrays(self.feet.offset, aside, axis - self.feet.height), -1)
        object.__setattr__(self, "neutral_feet", neutral_feet)
        if self.foothold_radius:
            object.__setattr__(self, "_reach", self._find_reach())

    def _resting_angles(self) -> Array:
        """Return the motor angles (L, m) of legs in the resting pose without abduction and swing."""
        pose = np.array(self.robot.rest)
        pose[:-1] = 0.0
        return self.robot.leg_geometry.to_motors(np.repeat(pose[:, None], len(self.feet.legs), axis=1))

    def _find_reach(self) -> float:
        longest = float(self.feet.stroke.max()) / 2 + self.foothold_radius
        length = np.linspace(0.0, longest, _REACH_LENGTHS)[:, None]
        turn = np.linspace(0.0, 2 * np.pi, _REACH_DIRECTIONS, endpoint=False)
        offsets = np.stack(
            [
                length * np.cos(turn),
                _REACH_ASPECT_RATIO * length * np.sin(turn),
                np.zeros((_REACH_LENGTHS, _REACH_DIRECTIONS)),
            ],
            axis=-1,
        )
        lowest = self.neutral_feet - [
            [0.0, 0.0, depth] for depth in np.broadcast_to(self.feet.depth, len(self.neutral_feet))
        ]
        poses = self.robot.leg_geometry.foot_pose(offsets[..., None, :] + lowest)
        is_reached = np.isfinite(poses).all(axis=(1, 2, 3))
        return float(length[int(np.argmin(is_reached)) - 1 if not is_reached.all() else -1, 0])

    def pose(self, state: CommandState, strides: Array, stride_fraction: Array) -> Array:
        """Return the leg poses (..., N, C, L) in leg space for the state's phases (..., N); NaN out of reach.

        Args:
            state: phases, stepping amplitudes, lifts and footholds.
            strides: strides forward and to the left (N, L, 2) [m].
            stride_fraction: ratio of the longest stride to the maximum stride (N,).
        """
        along, bump = self.feet.curve(state.phase)
        active = state.activity[:, None]
        step = (active * along)[..., None] * strides
        if self.clearance_rise or self.height_rise:
            lifted = np.where(bump > 0.0, bump * (1.0 + self.clearance_rise * stride_fraction[:, None]), bump)
            bump = lifted - self.height_rise * stride_fraction[:, None] * self.feet.height
        lift_fraction = np.zeros_like(bump)
        if self.touch_clearance and state.lift is not None:
            raised = self._lift_profile(state.phase) * state.lift
            bump, lift_fraction = bump + raised, raised / self.touch_clearance
        if state.lift_off is not None and state.landing is not None:
            offset = self._foothold_offset(state.phase, state.lift_off, state.landing)
            # Lifted feet reach less far to the side, and not at all near the axis of abduction.
            offset[..., 1] *= np.maximum(1.0 - 2.0 * lift_fraction, 0.0)
            step = step + offset
            step = step / np.maximum(1.0, self.reach_ratio(step))[..., None]
        step[..., 1] *= 1.0 - lift_fraction
        foot = np.concatenate([step, (active * bump)[..., None]], axis=-1) + self.neutral_feet
        return self.robot.leg_geometry.foot_pose(foot)

    def _lift_profile(self, phase: Array) -> Array:
        """Return the profile of the additional lift over the swing (..., N, L), 0 to 1: fast up, held, down."""
        swing = self.feet.swing_phase(phase)
        return np.asarray(np.clip(np.minimum(swing / _LIFT_END_PHASE, (1.0 - swing) / _LOWERING_FRACTION), 0.0, 1.0))

    def _foothold_offset(self, phase: Array, lift_off: Array, landing: Array) -> Array:
        """Return the offset of feet from their nominal stride positions (..., N, L, 2) [m]: a smooth step in swing."""
        swing = np.clip(self.feet.swing_phase(phase) / _OFFSET_END_PHASE, 0.0, 1.0)[..., None]
        blend = np.where(swing > 0.0, swing**2 * (3.0 - 2.0 * swing), 1.0)
        return np.asarray(lift_off + blend * (landing - lift_off))

    def reach_ratio(self, step: Array) -> Array:
        """Return the ratio (...) of the distance of feet from their neutral positions to the reach.

        Args:
            step: positions of feet relative to their neutral positions, forward and to the left (..., 2) [m].
        """
        return np.asarray(np.hypot(step[..., 0], step[..., 1] / _REACH_ASPECT_RATIO) / self._reach)

    def load(self, state: CommandState) -> Array:
        """Return the fraction of the weight on each leg (N, L), equal for all legs in stance."""
        phase, duty = self.feet.cycle_phase(state.phase), self.feet.duty_factor
        from_edge = np.minimum(phase, duty - phase) / duty
        carried = np.clip(from_edge / _LOAD_TRANSFER_FRACTION, 0.0, 1.0)
        carried = carried / np.maximum(carried.sum(axis=1, keepdims=True), 0.5)
        active = state.activity[:, None]
        return np.asarray(active * carried + (1.0 - active) / len(self.feet.legs))
