"""Foot trajectories: references given by the path of each foot.

A foot's cycle begins with its touchdown. In stance it goes backward by its stroke at constant speed; in swing it goes
forward again on a cubic curve that begins and ends with the speed of the stance, so that it lands without a jerk.

A `FootReference` repeats in the legs' planes. The strides of a `FollowingReference` have the commanded speed and
direction: with the commanded velocity v and yaw rate w, the foot of a leg mounted at r goes backward by (v + w x r)
times the time of stance, times a gain for what is lost to slip and soft legs. Without commands feet are lifted on the
spot; a robot that stands keeps them on the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.robot.leg import Legs
from surefoot.task.commands import MAX_HEADING_ERROR, CommandState

QUANTITIES = ("stroke", "clearance", "duty_factor", "phase", "height", "offset", "depth")
"""What each leg has of its own."""
LENGTHS = ("stroke", "clearance", "height", "offset", "depth")
"""Those that are lengths."""
FOLLOWING = (
    "stride_gain",
    "frequency_rise",
    "turn_gain",
    "clearance_rise",
    "height_rise",
    "foothold_radius",
    "touch_clearance",
)
"""Numbers of a `FollowingReference` that `ReferenceConfig` has by the same names."""
_LOADING = 0.15
"""Part of the stance in which a leg takes over its share of the weight, and in which it gives it back."""
RATE_STEP = 0.002
"""Half of the time [s] over which the velocity of a pose is taken."""
ACCELERATION_STEP = 0.01
"""Half of the time [s] over which the acceleration of a pose is taken: it jumps where feet touch down and lift off."""
_SAMPLES = 360
_PHASES = 48
_TURNS = 16
_ARRIVED = 0.8
"""Part of the swing after which a foot is beside its stride by as much as it lands: soft legs lag."""
_RISEN, _LOWERED = 0.2, 0.25
"""Parts of the swing in which a foot gets its lift by touch, and gives it back."""
_ASIDE = 0.5
"""Axis to the side of the ellipse in which footholds are, over that ahead."""


@dataclass(frozen=True)
class FootReference:
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
    """Part of the cycle in stance."""
    phase: Array
    """When its cycle begins, in cycles."""
    height: Array
    """Of the motor axis over the foot's end at touchdown and lift-off [m]."""
    offset: Array
    """Of the middle of the stroke, forward from the motor axis [m]."""
    depth: Array
    """How far it is pressed below that height in the middle of its stance [m]."""
    velocity_feedforward: float = 0.0
    """Time [s] by which commands lead along the velocity of the pose; k_d / k_p makes up for an actuator's damping."""
    _extent: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuse paths out of reach."""
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
        object.__setattr__(self, "_extent", (*[(0.0, 0.0)] * (len(self.leg.coordinates) - 2), *extent))

    @property
    def period(self) -> Any:
        """Time [s] after which the reference repeats, a number; (N,) where robots have paths of their own."""
        period = 1.0 / np.reshape(self.frequency, -1)
        return float(period[0]) if self.frequency.ndim == 0 else period

    @property
    def speed(self) -> Array:
        """Speed [m/s] at which feet go backward in stance: the base's, if they do not slip."""
        return self.stroke * self.frequency / self.duty_factor

    def shares(self, cycle: ArrayLike) -> Array:
        """Return the part of each leg's own cycle that is over (..., N, L), 0 to 1, after cycles (..., N)."""
        return np.asarray((np.asarray(cycle, float)[..., None] - self.phase) % 1.0)

    def swing_part(self, cycle: ArrayLike) -> Array:
        """Return the part of each leg's swing that is over (..., N, L), 0 to 1, after cycles (..., N); less: stance."""
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
        """Return the places (..., N, L, 2) [m] of the feet's ends after cycles (..., N), x forward and z up."""
        along, bump = self.curve(cycle)
        return np.stack(np.broadcast_arrays(self.offset + self.stroke * along, bump - self.height), -1)

    @classmethod
    def stacked(cls, references: Sequence[FootReference]) -> FootReference:
        """Return the paths of N robots, one reference each."""
        first = references[0]
        values: dict[str, Any] = {name: np.stack([getattr(one, name) for one in references]) for name in QUANTITIES}
        frequency = np.array([[one.frequency] for one in references], float)
        return cls(first.legs, first.leg, frequency, **values)

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at times (N,) [s] since the episode's start: no abduction, whatever the state."""
        swing, extension = self.leg.plane_pose(self.path(np.asarray(time, float) * np.reshape(self.frequency, -1)))
        level = [np.zeros_like(swing)] * (len(self.leg.coordinates) - 2)
        return np.stack([*level, swing, extension], axis=-2)

    def pose_rate(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the velocities (N, C, L) of the poses at times (N,) [s], in units of leg space a second."""
        time = np.asarray(time, float)
        return (self.pose(time + RATE_STEP) - self.pose(time - RATE_STEP)) / (2 * RATE_STEP)

    def extent(self) -> tuple[tuple[float, float], ...]:
        """Return the lowest and highest value of each coordinate over all legs and times."""
        return self._extent

    def to_dict(self) -> dict[str, Any]:
        """Return the `ReferenceConfig` that makes it again, as JSON values."""
        values = {name: dict(zip(self.legs, getattr(self, name).tolist(), strict=True)) for name in QUANTITIES}
        ahead = {"velocity_feedforward": self.velocity_feedforward} if self.velocity_feedforward else {}
        return {"kind": "foot", "foot": {"frequency": float(self.frequency), **values}, **ahead}


@dataclass(frozen=True)
class FollowingReference:
    """Feet that follow commands.

    Raises:
        SurefootError: a stride out of the legs' reach.
    """

    robot: RobotDescription
    feet: FootReference
    """Frequency, clearance, phases and posture of the feet; its stroke is the longest stride."""
    limits: CommandLimits
    """Commands that are followed."""
    stride_gain: float
    """Length of a stride over that of a foot that does not slip."""
    frequency_rise: float
    """Frequency gained at the greatest stride, over the frequency on the spot."""
    turn_gain: float = 1.0
    """What a stride has for turning, over that of a foot that does not slip. Legs without abduction turn a robot only
    as far as they make feet slide."""
    clearance_rise: float = 0.0
    """Clearance gained at the greatest stride, over that on the spot."""
    height_rise: float = 0.0
    """Height gained at the greatest stride, over that on the spot."""
    foothold_radius: float = 0.0
    """Greatest distance [m] by which feet land beside the places of their strides, see `Footholds`."""
    touch_clearance: float = 0.0
    """Greatest height [m] by which feet are lifted further that meet something, see `ContactReflex`."""
    acceleration_feedforward: float = 0.0
    """Square of the time [s^2] by which commands lead along the acceleration of the pose."""
    weight_feedforward: float = 0.0
    """Angle by which commands lead, over the lever arm of the weight [rad/m]."""
    over_holes: FollowingReference | None = None
    """The gait while the map of heights has holes, see `Footholds`."""
    places: Array = field(init=False, repr=False)
    """Feet below the legs' mounts, (L, 3) [m] from the mounts; z is the height."""
    _extent: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)
    _reach: float = field(init=False, repr=False, compare=False, default=0.0)

    def __post_init__(self) -> None:
        """Check that legs reach every stride."""
        if self.touch_clearance and np.any(self.feet.clearance + self.touch_clearance >= self.feet.height):
            raise SurefootError(
                f"reference.touch_clearance lifts feet by {self.touch_clearance:.3f} m, up to their motors: with "
                f"clearance it must be less than height, {float(np.min(self.feet.height)):.3f} m"
            )
        legs, resting = self.robot.leg_geometry, self._resting()
        _, aside, below = legs.foot_position(resting).T
        axis = below - legs.foot_in_plane(resting)[:, 1]
        places = np.stack(np.broadcast_arrays(self.feet.offset, aside, axis - self.feet.height), -1)
        object.__setattr__(self, "places", places)
        poses = self.pose(0.0, self._extremes())
        if not np.isfinite(poses).all():
            leg = self.feet.legs[int(np.argwhere(~np.isfinite(poses))[0][-1])]
            raise SurefootError(
                f"reference.foot: a stride of {leg} is out of the leg's reach; "
                "change height, stroke, depth or clearance"
            )
        extent = tuple((float(part.min()), float(part.max())) for part in np.moveaxis(poses, -2, 0))
        object.__setattr__(self, "_extent", extent)
        if self.foothold_radius:
            object.__setattr__(self, "_reach", self._find_reach())
            if self.touch_clearance and not np.isfinite(self.pose(0.0, self._beside_extremes())).all():
                raise SurefootError(
                    "reference.foothold_radius and reference.touch_clearance together lead feet out of the legs' "
                    "reach; make one of them less"
                )

    def _find_reach(self) -> float:
        """Return how far ahead [m] all feet reach from their places, in an ellipse, when they are lowest."""
        most = float(self.feet.stroke.max()) / 2 + self.foothold_radius
        length, turn = np.linspace(0.0, most, 50)[:, None], np.linspace(0.0, 2 * np.pi, _TURNS, endpoint=False)
        aside = np.stack([length * np.cos(turn), _ASIDE * length * np.sin(turn), np.zeros((50, _TURNS))], axis=-1)
        lowest = self.places - [[0.0, 0.0, depth] for depth in np.broadcast_to(self.feet.depth, len(self.places))]
        poses = self.robot.leg_geometry.foot_pose(aside[..., None, :] + lowest)
        reached = np.isfinite(poses).all(axis=(1, 2, 3))
        return float(length[int(np.argmin(reached)) - 1 if not reached.all() else -1, 0])

    def _resting(self) -> Array:
        """Return the motor angles (L, m) of legs without abduction or swing."""
        pose = np.array(self.robot.rest)
        pose[:-1] = 0.0
        return self.robot.leg_geometry.to_motors(np.repeat(pose[:, None], len(self.feet.legs), axis=1))

    def _extremes(self) -> CommandState:
        """Return the states in which legs are furthest from their places: strides all around, at every phase."""
        corners = np.array(np.meshgrid(*zip(self.limits.low, self.limits.high, strict=True))).reshape(3, -1).T
        rate = np.max(np.abs(self.limits.yaw_rate)) + self.limits.heading_gain * MAX_HEADING_ERROR
        corners[:, 2] = np.where(corners[:, 2] > 0, rate, -rate)
        corners = np.concatenate([corners, corners * [1, 1, 0], np.zeros((1, 3))])
        phase = np.tile(np.arange(_PHASES) / _PHASES, len(corners))
        lift = np.full((len(phase), len(self.feet.legs)), self.touch_clearance)
        return CommandState(np.repeat(corners, _PHASES, axis=0), np.ones(len(phase)), phase, lift=lift)

    def _beside_extremes(self) -> CommandState:
        """Return states of `_extremes` with feet lifted by all heights, and footholds all around their places."""
        states = self._extremes()
        every = np.arange(0, len(states.phase), 4)  # a quarter of the phases: this is done whenever a robot is made
        turns, lifts, radii = np.arange(8) / 8, np.linspace(0.0, 1.0, 6), np.linspace(0.25, 1.0, 4)
        turn, lift, radius, k = (grid.ravel() for grid in np.meshgrid(turns, lifts, radii, every, indexing="ij"))
        way = np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], axis=-1)
        beside = np.repeat((self.foothold_radius * radius[:, None] * way)[:, None], len(self.feet.legs), axis=1)
        height = np.repeat(self.touch_clearance * lift[:, None], len(self.feet.legs), axis=1)
        return CommandState(states.command[k], states.activity[k], states.phase[k], beside, beside, height)

    @property
    def period(self) -> float:
        """Time of a step on the spot [s]."""
        return float(self.feet.period)

    def _on_the_spot(self, command: Array) -> tuple[Array, Array]:
        """Return the strides (N, L, 2) [m] that commands (N, 3) need at the frequency on the spot, and their share.

        The share (N,) is that of the longest over the longest allowed, at most 1.
        """
        x, y = self.robot.leg_mounts[:, 0], self.robot.leg_mounts[:, 1] + self.places[:, 1]
        turn = self.turn_gain * command[:, 2:]
        forward, aside = command[:, :1] - turn * y, command[:, 1:2] + turn * x
        if "abduction" not in self.robot.coordinates:
            aside = np.zeros_like(aside)
        stance = self.feet.duty_factor / self.feet.frequency
        stride = self.stride_gain * stance[:, None] * np.stack([forward, aside], -1)
        share = np.linalg.norm(stride, axis=-1) / np.maximum(self.feet.stroke, 1e-9)
        return stride, np.minimum(share.max(axis=-1), 1.0)

    def strides(self, command: Array) -> Array:
        """Return the strides (N, L, 2) [m] forward and to the left for commands (N, 3), no longer than allowed.

        A higher frequency comes with longer strides, so that feet keep the commanded speed.
        """
        stride, share = self._on_the_spot(command)
        stride = stride / (1.0 + self.frequency_rise * share)[:, None, None]
        length = np.linalg.norm(stride, axis=-1, keepdims=True)
        return np.asarray(stride * np.minimum(1.0, self.feet.stroke[:, None] / np.maximum(length, 1e-9)))

    def frequency(self, command: Array, over_holes: Array | None = None) -> Array:
        """Return the frequency (N,) [Hz] at commands (N, 3) and the share of the gait over holes (N,)."""
        _, share = self._on_the_spot(command)
        own = np.asarray(self.feet.frequency * (1.0 + self.frequency_rise * share))
        if over_holes is None or self.over_holes is None:
            return own
        return np.asarray(own + over_holes * (self.over_holes.frequency(command) - own))

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at the state's commands and phases; the times (N,) are not used."""
        assert state is not None
        pose = self._own_pose(state)
        if self.over_holes is None or state.over_holes is None or not state.over_holes.any():
            return pose
        other = self.over_holes._own_pose(replace(state, lift=None))
        return np.asarray(pose + state.over_holes[:, None, None] * (other - pose))

    def _own_pose(self, state: CommandState) -> Array:
        """Return the poses (N, C, L) without those of the gait over holes."""
        along, bump = self.feet.curve(state.phase)
        active = state.activity[:, None]
        step = (active * along)[..., None] * self.strides(state.command)
        if self.clearance_rise or self.height_rise:
            _, share = self._on_the_spot(state.command)
            lifted = np.where(bump > 0.0, bump * (1.0 + self.clearance_rise * share[:, None]), bump)
            bump = lifted - self.height_rise * share[:, None] * self.feet.height
        high = np.zeros_like(bump)
        if self.touch_clearance and state.lift is not None:
            raised = self._raised(state.phase) * state.lift
            bump, high = bump + raised, raised / self.touch_clearance
        if state.lift_off is not None and state.landing is not None:
            beside = self._beside(state.phase, state.lift_off, state.landing)
            # High feet are not in reach of legs far to their side, and near the axis of abduction of none.
            beside[..., 1] *= np.maximum(1.0 - 2.0 * high, 0.0)
            step = step + beside
            step = step / np.maximum(1.0, self.reached(step))[..., None]
        step[..., 1] *= 1.0 - high
        foot = np.concatenate([step, (active * bump)[..., None]], axis=-1) + self.places
        return self.robot.leg_geometry.foot_pose(foot)

    def _raised(self, phase: Array) -> Array:
        """Return the share of the lift by touch that feet have (N, L): soon, and to the end of the swing."""
        part = self.feet.swing_part(phase)
        return np.asarray(np.clip(np.minimum(part / _RISEN, (1.0 - part) / _LOWERED), 0.0, 1.0))

    def _beside(self, phase: Array, lift_off: Array, landing: Array) -> Array:
        """Return how far feet are beside the places of their strides (N, L, 2) [m]."""
        part = np.clip(self.feet.swing_part(phase) / _ARRIVED, 0.0, 1.0)[..., None]
        over = np.where(part > 0.0, part**2 * (3.0 - 2.0 * part), 1.0)
        return np.asarray(lift_off + over * (landing - lift_off))

    def reached(self, step: Array) -> Array:
        """Return how much of their reach feet take (...), that are beside their places by steps (..., 2) [m]."""
        return np.asarray(np.hypot(step[..., 0], step[..., 1] / _ASIDE) / self._reach)

    def swings(self, state: CommandState) -> NDArray[np.bool_]:
        """Return whether legs are in swing (N, L)."""
        return np.asarray((self.feet.swing_part(state.phase) > 0.0) & (state.activity[:, None] > 0.5))

    def load(self, state: CommandState) -> Array:
        """Return the share of the weight that each leg carries (N, L), of legs in stance alike."""
        share, duty = self.feet.shares(state.phase), self.feet.duty_factor
        part = np.minimum(share, duty - share) / duty
        carried = np.clip(part / _LOADING, 0.0, 1.0)
        carried = carried / np.maximum(carried.sum(axis=1, keepdims=True), 0.5)
        active = state.activity[:, None]
        return np.asarray(active * carried + (1.0 - active) / len(self.feet.legs))

    @property
    def velocity_feedforward(self) -> float:
        """Time [s] by which commands lead along the velocity of the pose."""
        return self.feet.velocity_feedforward

    def pose_rate(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the rates (N, C, L) [leg space units per second] of the poses at the state's commands and phases."""
        assert state is not None
        change = RATE_STEP * self.frequency(state.command)
        before, after = (self.pose(time, replace(state, phase=state.phase + sign * change)) for sign in (-1, 1))
        return (after - before) / (2 * RATE_STEP)

    def pose_acceleration(self, state: CommandState) -> Array:
        """Return the second derivatives (N, C, L) of the poses at the state's commands and phases."""
        change = ACCELERATION_STEP * self.frequency(state.command)
        before, now, after = (self.pose(0.0, replace(state, phase=state.phase + k * change)) for k in (-1, 0, 1))
        return (after - 2.0 * now + before) / ACCELERATION_STEP**2

    def extent(self) -> tuple[tuple[float, float], ...]:
        """Return the lowest and highest value of each coordinate over all legs, phases and commands."""
        return self._extent

    def to_dict(self) -> dict[str, Any]:
        """Return the `ReferenceConfig` that makes it again, as JSON values."""
        always = ("stride_gain", "frequency_rise", "turn_gain")
        names = (*FOLLOWING, "acceleration_feedforward", "weight_feedforward")
        values = {name: getattr(self, name) for name in names}
        gains: dict[str, Any] = {name: value for name, value in values.items() if value or name in always}
        if self.over_holes is not None:
            other = self.over_holes
            foot = other.feet.to_dict()["foot"]
            numbers = {name: getattr(other, name) for name in ("stride_gain", "frequency_rise")}
            gains["over_holes"] = {"foot": foot, **numbers}
        return {**self.feet.to_dict(), "kind": "follow", **gains}
