"""Where the feet of a `FollowingReference` land on a map of heights: beside holes.

When a foot begins to swing, the place where its stride would end is looked up on the map. If there is a hole, it lands
on the nearest point of the map beside it, within a radius. In stance it keeps that place. A hole is what a
morphological closing (a dilation, then an erosion) along the map's rows or columns raises: gaps, and no steps, slopes
or wide hollows. So is ground far below what is next to it, as the other side of a gap may be beyond the map.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.task.commands import CommandState
from surefoot.task.component import RobotComponent
from surefoot.task.height_scan import POLICY_GRID
from surefoot.task.reference import FollowingReference
from surefoot.task.state import RobotState
from surefoot.world.interface import SensorReadings

MIN_HOLE_DEPTH = 0.35
"""Depth of a hole, from what is around it, in lengths of the straight leg."""
_WIDTH = 9
"""Points that a hole is less wide than: a foot can step over it."""
_MIN_CLIFF_DEPTH, _NEAR = 0.6, 7
"""Depth of a hole, in lengths of the leg, from the highest of as many points around it as this: the other side of a gap
may be beyond the map. No stairs are that steep."""
DEEP = 1.5
"""Depth below where a robot stands from which ground is no foothold, however wide it is, in lengths of the leg."""
FOOTHOLD_FIXED_PHASE = 0.3
"""Part of the swing after which the foothold stays."""
_LEVEL_RADIUS, _LEVEL_QUANTILE = 0.6, 0.7
"""Distance from the base's origin up to which a robot stands, in lengths of the leg, and the quantile of the heights
there that is its level: stones are more of it than the ground between them."""
_MIN_HOLE_POINTS = 30
"""Points that holes have, with those beside them, for which a gait over holes begins."""
_BLEND_IN_TIME, _BLEND_OUT_TIME = 1.0, 3.0
"""Times in which it begins and ends [sqrt(l / g)]."""
_MIN_LEARNING_RATE = 0.3
"""Share of what a landing changes in the mean of what feet have missed their places by."""
_CHANGE_COST = 1.0
"""Weight of the squared distance from the place chosen before in this swing, over that from the stride's own end."""
_HOLE_COST, _MARGIN = 1000.0, 2.0
"""What a foothold in a hole or on a point next to one costs, more than any distance, and what one next to those points
costs, as maps are shifted and landings scatter: squared distances in spacings of the map."""
_ROW = 3
"""Low points among the nine around one, itself with them, from which it is a hole even where the median sees none."""
_CELL = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
"""Points around a place on the map, from the one behind it and to its right."""


class Footholds(RobotComponent):
    """Places where feet of N robots with L legs lift off and land.

    Args:
        reference: with `foothold_radius`.
        num_envs: robots.
    """

    prefix = "footholds"
    changing = ("lift_off", "landing", "missed", "landed", "swung", "over_holes")

    def __init__(self, reference: FollowingReference, num_envs: int) -> None:
        self.reference, robot = reference.over_holes or reference, reference.robot
        self._changes = reference.over_holes is not None
        ahead, left = (np.array(places) for places in POLICY_GRID.scale(robot))
        self._shape, self._corner = (len(ahead), len(left)), np.array([ahead[0], left[0]])
        length = robot.leg_geometry.length
        self._spacing = POLICY_GRID.spacing * length
        radius = reference.foothold_radius / self._spacing
        self._ways = np.array([1, "abduction" in robot.coordinates])
        """Whether feet can be moved ahead and aside (2,)."""
        steps = np.arange(-np.floor(radius), np.floor(radius) + 1)
        around = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
        self._around = np.unique(around[np.linalg.norm(around, axis=1) <= radius + 1e-9] * self._ways, axis=0)
        """Points of the map on which feet may land, from the one nearest to the end of a stride (K, 2)."""
        self._neutral_feet = robot.leg_mounts + self.reference.places
        """Feet below the legs' mounts, from the base's origin (L, 3) [m]."""
        near = [np.flatnonzero(np.abs(np.array(places)) <= _LEVEL_RADIUS * length) for places in (ahead, left)]
        self._footprint = tuple(slice(places[0], places[-1] + 1) for places in near)
        self._hole, self._cliff, self._deep = MIN_HOLE_DEPTH * length, _MIN_CLIFF_DEPTH * length, DEEP * length
        self.lift_off, self.landing, self.missed = np.zeros((3, num_envs, len(self._neutral_feet), 2))
        """How far feet stood beside the places of their strides when they lifted off, how far they land beside them,
        and how far from there feedback and soft legs have let them land: forward and to the left (N, L, 2) [m]."""
        self.landed = np.zeros((num_envs, len(self._neutral_feet)))
        """How often feet have landed (N, L)."""
        self.swung = np.zeros(self.landed.shape, np.bool_)
        """Whether they were swinging (N, L)."""
        self.over_holes = np.zeros(num_envs)
        """Share of the gait over holes (N,)."""

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Let robots stand on the places of their strides."""
        for name in self.changing:
            getattr(self, name)[rows] = 0
        self.publish(state)

    def after_step(self, state: RobotState) -> None:
        """Choose footholds on the newest map; without one they stay."""
        assert state.gait_state is not None
        if state.heights is not None:
            self.choose(state.heights, state.gait_state, state.readings, state.duration)
        self.publish(state)

    def publish(self, state: RobotState) -> None:
        """Write the footholds to what the gait follows."""
        assert state.gait_state is not None
        state.gait_state = replace(
            state.gait_state, lift_off=self.lift_off, landing=self.landing, over_holes=self.over_holes
        )

    def choose(self, heights: Array, state: CommandState, readings: SensorReadings, step: Array) -> None:
        """Choose footholds for what the gait follows now.

        Args:
            heights: maps (N, P) [m], those of the grid `POLICY_GRID`.
            state: commands and phases.
            readings: what robots measure.
            step: duration of the control step (N,) [s].
        """
        reference, cost = self.reference, self._cost(heights)
        holes = (cost >= _HOLE_COST).sum(axis=(1, 2)) >= _MIN_HOLE_POINTS
        change = step / (np.where(holes, _BLEND_IN_TIME, _BLEND_OUT_TIME) * reference.robot.natural_time)
        self.over_holes = np.clip(self.over_holes + np.where(holes, change, -change), 0.0, 1.0)
        part = reference.feet.swing_phase(state.phase)
        swings = part > 0.0
        ends = self._stride_ends(state)
        self._learn(self.swung & ~swings & self.follows[:, None], ends, readings)
        best = self._best(cost, ends + self._ahead(state), np.where(self.swung & swings, _CHANGE_COST, 0.0))
        self.swung = swings
        self.lift_off = np.where(swings[..., None], self.lift_off, self.landing)
        self.landing = np.where((swings & (part < FOOTHOLD_FIXED_PHASE))[..., None], best, self.landing)

    def _best(self, cost: Array, ends: Array, keeps: Array) -> Array:
        """Return how far beside the ends of their strides feet should land (N, L, 2) [m]: not at all, or on a point.

        Args:
            cost: of the points of maps (N, X, Y).
            ends: from the base's origin (N, L, 2) [m].
            keeps: weights of the distance from the present choice (N, L).
        """
        place = ((ends - self._corner) / self._spacing)[:, :, None]
        points = np.rint(place) + self._around
        # A foot that lands where its stride ends is on none of the points: all those around it count.
        stays = self._at(cost, np.floor(place) + _CELL).max(axis=-1, keepdims=True)
        there = np.concatenate([stays, self._at(cost, points)], axis=-1)
        beside = np.concatenate([np.zeros_like(place), (points - place) * self._ways], axis=2)
        change = beside - self.landing[:, :, None] / self._spacing
        total = there + (beside**2).sum(axis=-1) + keeps[..., None] * (change**2).sum(axis=-1)
        best = np.take_along_axis(beside, np.argmin(total, axis=-1)[..., None, None], axis=2)
        return np.asarray(self._spacing * best[:, :, 0])

    def _at(self, cost: Array, points: Array) -> Array:
        """Return the costs (N, L, K) of points (N, L, K, 2) of maps, or of the nearest ones at the border."""
        i, j = np.moveaxis(np.clip(points, 0, np.array(self._shape) - 1).astype(np.int64), -1, 0)
        return np.asarray(cost[np.arange(len(cost))[:, None, None], i, j])

    @property
    def follows(self) -> NDArray[np.bool_]:
        """Whether feet go to their footholds (N,), not as another gait has them."""
        return self.over_holes == 1.0 if self._changes else np.ones(len(self.over_holes), np.bool_)

    def landing_places(self, state: CommandState) -> Array:
        """Return where feet will land in the heading frame, from the base's origin now (N, L, 2) [m]."""
        return self._stride_ends(state) + self._ahead(state) + self.landing

    def _stride_ends(self, state: CommandState) -> Array:
        """Return where strides end, from the base's origin (N, L, 2) [m]."""
        step = 0.5 * state.activity[:, None, None] * self.reference.strides(state.command)
        return np.asarray(self._neutral_feet[:, :2] + step)

    def _ahead(self, state: CommandState) -> Array:
        """Return what there is beside (N, L, 2) [m]: what feet miss, and how far the base goes until they land."""
        feet, command = self.reference.feet, state.command
        part = feet.swing_phase(state.phase)
        rest = (1.0 - part) * (1.0 - feet.duty_factor) / self.reference.frequency(command)[:, None]
        return np.asarray(self.missed + np.where(part > 0.0, rest, 0.0)[..., None] * command[:, None, :2])

    def _learn(self, lands: NDArray[np.bool_], ends: Array, readings: SensorReadings) -> None:
        """Take from feet that land (N, L) how far they are from the ends of their strides (N, L, 2) and `landing`."""
        roll, pitch, _ = readings.roll_pitch_yaw.T[..., None]
        x, y, z = np.moveaxis(self.reference.robot.foot_positions(readings.motor_angle), -1, 0)
        y, z = y * np.cos(roll) - z * np.sin(roll), y * np.sin(roll) + z * np.cos(roll)
        places = np.stack([x * np.cos(pitch) + z * np.sin(pitch), y], axis=-1)
        self.landed += lands
        share = lands * np.maximum(_MIN_LEARNING_RATE, 1.0 / np.maximum(self.landed, 1.0))
        self.missed += share[..., None] * (places - ends - self.landing - self.missed)

    def _cost(self, heights: Array) -> Array:
        """Return what points of maps cost as footholds (N, X, Y) [squared spacings of the map]."""
        heights = heights.reshape(len(heights), *self._shape)
        # The median leaves out points that are wrong or not known.
        grid = _filter(heights, 3, _median)
        closed = np.maximum(_closing(grid, 1), _closing(grid, 2))
        # Stairs that meet in a corner are a valley, but not below where a robot stands.
        rows, columns = self._footprint
        level = np.quantile(grid[:, rows, columns], _LEVEL_QUANTILE, axis=(1, 2))[:, None, None]
        above = _filter(grid, _NEAR, _maximum)
        holes, unfiltered = (
            ((closed - low > self._hole) | (above - low > self._cliff)) & (low < level - 0.5 * self._hole)
            | (low < level - self._deep)
            for low in (grid, heights)
        )
        # Of a gap that is one point wide the median leaves nothing; wrong points are alone, or two.
        holes |= unfiltered & (_filter(unfiltered.astype(float), 3, _total) >= _ROW)
        beside = _filter(holes.astype(float), 3, _maximum)
        return np.asarray(_HOLE_COST * (holes + beside) + _MARGIN * _filter(beside, 3, _maximum))


def _filter(grid: Array, width: int, combine: Callable[[list[Array]], Array]) -> Array:
    """Return grids (N, X, Y) of which each point combines those around it: of a row of `width` points, then of columns.

    Beyond the border are its mirrored numbers, so that a median leaves out single ones there too.
    """
    for axis in (1, 2):
        grid = _combine_along(_pad(grid, axis, width // 2, "reflect"), axis, width, combine)
    return grid


def _closing(grid: Array, axis: int) -> Array:
    """Return the closing of grids (N, X, Y) along an axis: what is lower than both sides is raised to the lower one.

    Along one axis, as a slanting edge of a step that goes out of the map is none of its valleys then. Beyond the border
    its numbers go on.
    """
    wide = _pad(grid, axis, 2 * (_WIDTH // 2), "edge")
    return _combine_along(_combine_along(wide, axis, _WIDTH, _maximum), axis, _WIDTH, _minimum)


def _pad(grid: Array, axis: int, border: int, mode: Literal["reflect", "edge"]) -> Array:
    """Return grids (N, X, Y) with a border at both ends of an axis."""
    return np.pad(grid, [(border, border) if k == axis else (0, 0) for k in range(3)], mode=mode)


def _combine_along(grid: Array, axis: int, width: int, combine: Callable[[list[Array]], Array]) -> Array:
    """Return the combinations of `width` points along an axis of grids, as many as are within them."""
    count = grid.shape[axis] - width + 1
    return combine([grid[(slice(None),) * axis + (slice(k, k + count),)] for k in range(width)])


def _maximum(parts: list[Array]) -> Array:
    """Return the greatest number of each place: a dilation."""
    return functools.reduce(np.maximum, parts)


def _minimum(parts: list[Array]) -> Array:
    """Return the least number of each place: an erosion."""
    return functools.reduce(np.minimum, parts)


def _total(parts: list[Array]) -> Array:
    """Return the sum of each place: a count."""
    return functools.reduce(np.add, parts)


def _median(parts: list[Array]) -> Array:
    """Return the median of each place of three numbers."""
    one, two, three = parts
    return np.asarray(np.maximum(np.minimum(one, two), np.minimum(np.maximum(one, two), three)))
