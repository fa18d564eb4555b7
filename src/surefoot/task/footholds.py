"""Choice of footholds next to holes, on a map of terrain heights, for the feet of a `FollowingReference`.

When a foot starts to swing, the nominal end of its stride is looked up on the map. If there is a hole, the foot lands
on the nearest suitable point of the map within a radius, and keeps the offset during stance. Holes are points that a
morphological closing (dilation, then erosion) along the map's rows or columns raises: gaps, but not steps, slopes or
wide hollows. Ground far below its neighbourhood is also a hole, because the far side of a gap may be beyond the map.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.rotations import from_base_frame
from surefoot.task.commands import CommandState
from surefoot.task.component import RobotComponent
from surefoot.task.height_scan import POLICY_GRID
from surefoot.task.reference import FollowingReference
from surefoot.task.state import RobotState
from surefoot.world.interface import SensorReadings

MIN_HOLE_DEPTH = 0.35
"""Minimum depth of a hole below its surroundings, in lengths of the straight leg."""
_CLOSING_WIDTH = 9
"""Width of the closing in map points. Narrower depressions are holes, which a foot can step over."""
_MIN_CLIFF_DEPTH, _CLIFF_WINDOW = 0.6, 7
"""Minimum depth of a hole below the highest point in a window of this many map points, in lengths of the leg, for gaps
whose far side is beyond the map. No stairs are that steep."""
MAX_FOOTHOLD_DEPTH = 1.5
"""Maximum depth of a foothold below the ground under the robot, for depressions of any width, in lengths of the leg."""
FOOTHOLD_FIXED_PHASE = 0.3
"""Swing phase after which the foothold no longer changes."""
_LEVEL_RADIUS, _LEVEL_QUANTILE = 0.6, 0.7
"""Half side of the square around the base's origin from which the ground level is estimated, in lengths of the leg, and
quantile of the heights in it. On stepping stones, stones cover more of the square than the gaps between them."""
_MIN_HOLE_POINTS = 30
"""Minimum number of hole points on the map, including the points next to holes, that activates the gait over holes."""
_BLEND_IN_TIME, _BLEND_OUT_TIME = 1.0, 3.0
"""Times over which the gait over holes is blended in and out [sqrt(l / g)]."""
_MIN_LEARNING_RATE = 0.3
"""Minimum weight of a new landing in the running mean of landing errors."""
_CHANGE_COST = 1.0
"""Relative cost of moving away from the foothold chosen before in this swing (1: same as deviating from the nominal
one)."""
_HOLE_COST, _MARGIN_COST = 1000.0, 2.0
"""Cost of a foothold in a hole or next to one, higher than the cost of any distance, and cost of a foothold one point
further away, since maps are shifted and landings scatter. Unit: squared map spacings."""
_MIN_LOW_POINTS = 3
"""Minimum number of low points in a 3 by 3 window that makes its middle a hole, even if the median filter removes
it."""
_CELL_CORNERS = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
"""Index offsets of the four map points around a position, relative to the point behind it and to its right."""


class Footholds(RobotComponent):
    """Foothold choice for N robots with L legs.

    Args:
        reference: reference gait with a `foothold_radius`.
        num_envs: number of robots.
    """

    prefix = "footholds"
    changing = ("lift_off", "landing", "missed", "landed", "swung", "over_holes")

    def __init__(self, reference: FollowingReference, num_envs: int) -> None:
        self.reference, robot = reference.over_holes or reference, reference.robot
        self._has_gait_over_holes = reference.over_holes is not None
        ahead, left = (np.array(places) for places in POLICY_GRID.scale(robot))
        self._shape, self._corner = (len(ahead), len(left)), np.array([ahead[0], left[0]])
        length = robot.leg_geometry.length
        self._spacing = POLICY_GRID.spacing * length
        radius = reference.foothold_radius / self._spacing
        self._free_axes = np.array([1, "abduction" in robot.coordinates])
        """1 for each axis (forward, left) along which footholds can move, otherwise 0 (2,)."""
        steps = np.arange(-np.floor(radius), np.floor(radius) + 1)
        around = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
        self._offsets = np.unique(around[np.linalg.norm(around, axis=1) <= radius + 1e-9] * self._free_axes, axis=0)
        """Candidate footholds, as map index offsets from the point nearest to the end of a stride (K, 2)."""
        self._neutral_feet = robot.leg_mounts + self.reference.neutral_feet
        """Neutral foot positions relative to the base's origin (L, 3) [m]."""
        near = [np.flatnonzero(np.abs(np.array(places)) <= _LEVEL_RADIUS * length) for places in (ahead, left)]
        self._footprint = tuple(slice(places[0], places[-1] + 1) for places in near)
        self._hole_depth, self._cliff_depth = MIN_HOLE_DEPTH * length, _MIN_CLIFF_DEPTH * length
        self._max_depth = MAX_FOOTHOLD_DEPTH * length
        self.lift_off, self.landing, self.missed = np.zeros((3, num_envs, len(self._neutral_feet), 2))
        """Offset of feet from their nominal stride position at lift-off and at landing, and mean error of landings
        due to feedback and soft legs: forward and to the left (N, L, 2) [m] each."""
        self.landed = np.zeros((num_envs, len(self._neutral_feet)))
        """Number of landings of each foot (N, L)."""
        self.swung = np.zeros(self.landed.shape, np.bool_)
        """Whether feet were in swing in the last control step (N, L)."""
        self.over_holes = np.zeros(num_envs)
        """Blend weight of the gait over holes (N,), 0 to 1."""

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Start episodes with nominal footholds."""
        for name in self.changing:
            getattr(self, name)[rows] = 0
        self.publish(state)

    def after_step(self, state: RobotState) -> None:
        """Choose footholds on the newest map, or keep them if there is no map."""
        assert state.gait_state is not None
        if state.heights is not None:
            self.choose(state.heights, state.gait_state, state.readings, state.duration)
        self.publish(state)

    def publish(self, state: RobotState) -> None:
        """Write the footholds to the gait's state."""
        assert state.gait_state is not None
        state.gait_state = replace(
            state.gait_state, lift_off=self.lift_off, landing=self.landing, over_holes=self.over_holes
        )

    def choose(self, heights: Array, state: CommandState, readings: SensorReadings, step: Array) -> None:
        """Choose the footholds of feet in early swing.

        Args:
            heights: terrain heights at the points of `POLICY_GRID` (N, P) [m].
            state: commands and phases of the gait.
            readings: sensor readings, from which landing errors are measured.
            step: duration of the control step (N,) [s].
        """
        reference, cost = self.reference, self._cost(heights)
        holes = (cost >= _HOLE_COST).sum(axis=(1, 2)) >= _MIN_HOLE_POINTS
        change = step / (np.where(holes, _BLEND_IN_TIME, _BLEND_OUT_TIME) * reference.robot.natural_time)
        self.over_holes = np.clip(self.over_holes + np.where(holes, change, -change), 0.0, 1.0)
        phase = reference.feet.swing_phase(state.phase)
        swings = phase > 0.0
        ends = self._stride_ends(state)
        self._learn_landing_error(self.swung & ~swings & self.is_active[:, None], ends, readings)
        best = self._best(cost, ends + self._drift(state), np.where(self.swung & swings, _CHANGE_COST, 0.0))
        self.swung = swings
        self.lift_off = np.where(swings[..., None], self.lift_off, self.landing)
        self.landing = np.where((swings & (phase < FOOTHOLD_FIXED_PHASE))[..., None], best, self.landing)

    def _best(self, cost: Array, ends: Array, change_weight: Array) -> Array:
        """Return the offset of the best foothold from the end of each stride (N, L, 2) [m].

        Candidates are the end of the stride itself and the points of the map around it.

        Args:
            cost: costs of the map's points (N, X, Y).
            ends: ends of strides, relative to the base's origin (N, L, 2) [m].
            change_weight: weights of the squared distance from the previous choice (N, L).
        """
        place = ((ends - self._corner) / self._spacing)[:, :, None]
        points = np.rint(place) + self._offsets
        # The end of a stride lies between points of the map: it costs as much as the worst of the four around it.
        nominal = self._at(cost, np.floor(place) + _CELL_CORNERS).max(axis=-1, keepdims=True)
        terrain_cost = np.concatenate([nominal, self._at(cost, points)], axis=-1)
        offset = np.concatenate([np.zeros_like(place), (points - place) * self._free_axes], axis=2)
        change = offset - self.landing[:, :, None] / self._spacing
        total = terrain_cost + (offset**2).sum(axis=-1) + change_weight[..., None] * (change**2).sum(axis=-1)
        best = np.take_along_axis(offset, np.argmin(total, axis=-1)[..., None, None], axis=2)
        return np.asarray(self._spacing * best[:, :, 0])

    def _at(self, cost: Array, points: Array) -> Array:
        """Return the costs (N, L, K) at map indices (N, L, K, 2), which are clipped to the map."""
        i, j = np.moveaxis(np.clip(points, 0, np.array(self._shape) - 1).astype(np.int64), -1, 0)
        return np.asarray(cost[np.arange(len(cost))[:, None, None], i, j])

    @property
    def is_active(self) -> NDArray[np.bool_]:
        """Whether feet fully use the chosen footholds (N,); false while another gait is blended in."""
        return self.over_holes == 1.0 if self._has_gait_over_holes else np.ones(len(self.over_holes), np.bool_)

    def landing_places(self, state: CommandState) -> Array:
        """Return where feet will land, in the heading frame relative to the current base origin (N, L, 2) [m]."""
        return self._stride_ends(state) + self._drift(state) + self.landing

    def _stride_ends(self, state: CommandState) -> Array:
        """Return the nominal ends of strides relative to the base's origin (N, L, 2) [m]."""
        step = 0.5 * state.activity[:, None, None] * self.reference.strides(state.command)
        return np.asarray(self._neutral_feet[:, :2] + step)

    def _drift(self, state: CommandState) -> Array:
        """Return the mean landing error plus the motion of the base until the landing (N, L, 2) [m]."""
        feet, command = self.reference.feet, state.command
        phase = feet.swing_phase(state.phase)
        remaining = (1.0 - phase) * (1.0 - feet.duty_factor) / self.reference.frequency(command)[:, None]
        return np.asarray(self.missed + np.where(phase > 0.0, remaining, 0.0)[..., None] * command[:, None, :2])

    def _learn_landing_error(self, lands: NDArray[np.bool_], ends: Array, readings: SensorReadings) -> None:
        """Update the mean landing error `missed` of feet that land.

        Args:
            lands: whether each foot lands in this control step (N, L).
            ends: ends of strides, relative to the base's origin (N, L, 2) [m].
            readings: sensor readings, from which foot positions are computed.
        """
        feet = self.reference.robot.foot_positions(readings.motor_angle)
        places = from_base_frame(feet, readings.roll_pitch_yaw[:, None])[..., :2]
        self.landed += lands
        rate = lands * np.maximum(_MIN_LEARNING_RATE, 1.0 / np.maximum(self.landed, 1.0))
        self.missed += rate[..., None] * (places - ends - self.landing - self.missed)

    def _cost(self, heights: Array) -> Array:
        """Return the foothold cost of each map point (N, X, Y) [squared map spacings]."""
        heights = heights.reshape(len(heights), *self._shape)
        # The median removes single points that are wrong or unknown.
        grid = _filter(heights, 3, _median)
        closed = np.maximum(_closing(grid, 1), _closing(grid, 2))
        # A corner between two flights of stairs looks like a valley, but is not below the robot's ground level.
        rows, columns = self._footprint
        level = np.quantile(grid[:, rows, columns], _LEVEL_QUANTILE, axis=(1, 2))[:, None, None]
        above = _filter(grid, _CLIFF_WINDOW, _maximum)
        holes, unfiltered = (
            ((closed - low > self._hole_depth) | (above - low > self._cliff_depth))
            & (low < level - 0.5 * self._hole_depth)
            | (low < level - self._max_depth)
            for low in (grid, heights)
        )
        # The median removes gaps that are one point wide. Wrong points come in ones or twos.
        holes |= unfiltered & (_filter(unfiltered.astype(float), 3, _sum) >= _MIN_LOW_POINTS)
        near = _filter(holes.astype(float), 3, _maximum)
        return np.asarray(_HOLE_COST * (holes + near) + _MARGIN_COST * _filter(near, 3, _maximum))


def _filter(grid: Array, width: int, combine: Callable[[list[Array]], Array]) -> Array:
    """Filter grids (N, X, Y) with a window of `width` points, first along rows and then along columns.

    Values are mirrored at the border, so that a median also removes single points there.
    """
    for axis in (1, 2):
        grid = _combine_along(_pad(grid, axis, width // 2, "reflect"), axis, width, combine)
    return grid


def _closing(grid: Array, axis: int) -> Array:
    """Return the morphological closing of grids (N, X, Y) along an axis: valleys are filled up to their lower side.

    A closing along one axis does not mistake the slanted edge of a step at the border of the map for a valley. Border
    values are repeated beyond the map.
    """
    wide = _pad(grid, axis, 2 * (_CLOSING_WIDTH // 2), "edge")
    return _combine_along(_combine_along(wide, axis, _CLOSING_WIDTH, _maximum), axis, _CLOSING_WIDTH, _minimum)


def _pad(grid: Array, axis: int, border: int, mode: Literal["reflect", "edge"]) -> Array:
    """Pad grids (N, X, Y) at both ends of an axis."""
    return np.pad(grid, [(border, border) if k == axis else (0, 0) for k in range(3)], mode=mode)


def _combine_along(grid: Array, axis: int, width: int, combine: Callable[[list[Array]], Array]) -> Array:
    """Combine all windows of `width` neighbouring points along an axis."""
    count = grid.shape[axis] - width + 1
    return combine([grid[(slice(None),) * axis + (slice(k, k + count),)] for k in range(width)])


def _maximum(parts: list[Array]) -> Array:
    """Return the elementwise maximum (dilation)."""
    return functools.reduce(np.maximum, parts)


def _minimum(parts: list[Array]) -> Array:
    """Return the elementwise minimum (erosion)."""
    return functools.reduce(np.minimum, parts)


def _sum(parts: list[Array]) -> Array:
    """Return the elementwise sum (count)."""
    return functools.reduce(np.add, parts)


def _median(parts: list[Array]) -> Array:
    """Return the elementwise median of three arrays."""
    one, two, three = parts
    return np.asarray(np.maximum(np.minimum(one, two), np.minimum(np.maximum(one, two), three)))
