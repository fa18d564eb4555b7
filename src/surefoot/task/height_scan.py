"""Height scans: terrain heights at points around a robot in its heading frame, exact or with the errors of a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.configuration import Within, check_bounds
from surefoot.robot import RobotDescription
from surefoot.rotations import from_heading_frame
from surefoot.seeding import generators
from surefoot.task.component import Component
from surefoot.task.state import EnvState
from surefoot.world.ground import Ground


@dataclass(frozen=True)
class Grid:
    """Rectangular grid of points around the base, in lengths of the straight leg."""

    ahead: tuple[float, ...]
    """Coordinates forward of the base's origin, ascending."""
    left: tuple[float, ...]
    """Coordinates to the left of the base's origin, ascending."""

    @property
    def spacing(self) -> float:
        """Distance between neighbouring points."""
        return self.ahead[1] - self.ahead[0]

    def scale(self, robot: RobotDescription) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the forward and left coordinates for a robot, in its heading frame [m]."""
        length = robot.leg_geometry.length
        return tuple(length * x for x in self.ahead), tuple(length * y for y in self.left)

    def points(self, robot: RobotDescription) -> Array:
        """Return the points for a robot (K, 2) [m]: x forward and y left of the base's origin in the heading frame."""
        x, y = np.meshgrid(*self.scale(robot), indexing="ij")
        points: Array = np.stack([x.ravel(), y.ravel()], axis=-1)
        return points

    def columns(self) -> list[str]:
        """Return the column names, with coordinates in quarters of a leg; names of left and right mirror each other."""
        sides = {0.0: "middle"} | {y: f"{'left' if y > 0 else 'right'}{4 * abs(y):g}" for y in self.left if y}
        return [f"ground{4 * x:g}.{sides[y]}" for x in self.ahead for y in self.left]

    def nearest(self, other: Grid) -> dict[str, str]:
        """Map the column name of each point to the column name of the nearest point of another grid."""
        ahead, left = (
            tuple(others[int(np.argmin(np.abs(np.subtract(others, coordinate))))] for coordinate in own)
            for own, others in ((self.ahead, other.ahead), (self.left, other.left))
        )
        return dict(zip(self.columns(), Grid(ahead, left).columns(), strict=True))


def _coordinates(low: int, high: int, count: int) -> tuple[float, ...]:
    """Return coordinates from `low` to `high` quarters of a leg, with `count` points per quarter."""
    return tuple(k / (4 * count) for k in range(low * count, high * count + 1))


POLICY_GRID = Grid(_coordinates(-3, 6, 2), _coordinates(-3, 3, 2))
"""Grid that a policy observes, fine enough to step next to a gap."""
CRITIC_GRID = Grid(_coordinates(-5, 7, 1), _coordinates(-3, 3, 1))
"""Grid that the critic observes."""
MAX_RELATIVE_HEIGHT = 1.0
"""Limit to which heights relative to the base's origin are clipped [m], up and down."""


def scan_heights(ground: Ground, points: Array, position: Array, yaw: Array) -> Array:
    """Return terrain heights relative to the bases' origins (N, K) [m], clipped to `MAX_RELATIVE_HEIGHT`.

    Args:
        ground: the ground.
        points: points of the grid (K, 2) [m].
        position: positions of the bases in the world (N, 3) [m].
        yaw: yaw of the bases (N,) [rad].
    """
    places = from_heading_frame(points, yaw) + position[:, None, :2]
    heights: Array = np.clip(ground.height(places) - position[:, None, 2], -MAX_RELATIVE_HEIGHT, MAX_RELATIVE_HEIGHT)
    return heights


@dataclass(frozen=True)
class ScanConfig:
    """Errors of a robot's map of terrain heights, for the observation `height_scan`."""

    noise: Annotated[float, Within(0, 1)] = 0.01
    """Standard deviation [m] of the noise on each height, drawn again in every control step."""
    drift: Annotated[float, Within(0, 1)] = 0.02
    """Standard deviation [m] of a vertical offset of the whole map, drawn once per episode."""
    shift: Annotated[float, Within(0, 1)] = 0.02
    """Standard deviation [m] of a horizontal offset of the whole map along x and y, drawn once per episode."""
    holes: Annotated[float, Within(0, 1)] = 0.02
    """Fraction of points without a height in each control step, which get that under the middle of the base."""
    delay: Annotated[int, Within(0, 50)] = 2
    """Age of the map [control steps]."""

    def __post_init__(self) -> None:
        """Reject values out of bounds."""
        check_bounds(self, "terrain.scan")


class HeightScanner:
    """Maps of terrain heights with errors, for N robots.

    Args:
        config: errors of the maps.
        robot: robot, whose leg length scales the grid.
        num_envs: number of robots N.
        seed: seed of the errors, with one random stream per robot.
    """

    arrays = ("_past", "_drift")
    """Names of the arrays that change over time."""

    def __init__(self, config: ScanConfig, robot: RobotDescription, num_envs: int, seed: int) -> None:
        self.config, self.points = config, POLICY_GRID.points(robot)
        self.streams = generators(seed, "height scan", num_envs)
        # Scans of the last control steps, newest first.
        self._past = np.zeros((config.delay + 1, num_envs, len(self.points)))
        self._drift = np.zeros((num_envs, 3))
        self._middle = int(np.argmin(np.linalg.norm(self.points, axis=1)))

    def reset(self, rows: NDArray[np.int64], ground: Ground, position: Array, yaw: Array) -> None:
        """Draw the errors of new episodes and fill the delay with current scans; arguments as in `scan_heights`."""
        scale = np.array([self.config.shift, self.config.shift, self.config.drift])
        for i in rows:
            self._drift[i] = scale * self.streams[i].standard_normal(3)
        self._past[:, rows] = self._scan(rows, ground, position[rows], yaw[rows])

    def update(self, ground: Ground, position: Array, yaw: Array) -> None:
        """Add the scan of a control step; arguments as in `scan_heights`."""
        self._past[1:] = self._past[:-1].copy()
        self._past[0] = self._scan(np.arange(len(self.streams)), ground, position, yaw)

    @property
    def heights(self) -> Array:
        """Delayed heights that the robots have now (N, K) [m]."""
        return self._past[-1]

    def _scan(self, rows: NDArray[np.int64], ground: Ground, position: Array, yaw: Array) -> Array:
        heights = scan_heights(ground, self.points, position + self._drift[rows], yaw)
        draws = np.array([self.streams[i].random(2 * len(self.points)) for i in rows]).reshape(len(rows), 2, -1)
        # Uniform noise with the same standard deviation, because uniform numbers take a tenth of the time.
        heights += self.config.noise * np.sqrt(12.0) * (draws[:, 0] - 0.5)
        return np.where(draws[:, 1] < self.config.holes, heights[:, [self._middle]], heights)


class HeightScan(Component):
    """Component that provides the map of terrain heights.

    Args:
        scanner: maps with their errors.
    """

    def __init__(self, scanner: HeightScanner) -> None:
        self.scanner = scanner

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays of the scanner that an exact resume needs, by name."""
        return {f"scan_{name}": getattr(self.scanner, name) for name in self.scanner.arrays}

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Random streams of the map errors."""
        return {"scan_streams": self.scanner.streams}

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Start the maps of new episodes at the robots' positions."""
        truth = state.truth
        self.scanner.reset(rows, state.ground, truth.base_position_world, truth.roll_pitch_yaw[:, 2])
        self.publish(state)

    def after_step(self, state: EnvState) -> None:
        """Add the scan of a control step."""
        truth = state.truth
        self.scanner.update(state.ground, truth.base_position_world, truth.roll_pitch_yaw[:, 2])
        self.publish(state)

    def publish(self, state: EnvState) -> None:
        """Write the heights to the state."""
        state.heights = self.scanner.heights
