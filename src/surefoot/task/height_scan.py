"""Heights of the ground at points around a robot, in its heading frame; exact, or as a robot's map has them."""

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
    """Points around the base, in lengths of the straight leg."""

    ahead: tuple[float, ...]
    """Places ahead of the base's origin, rising."""
    left: tuple[float, ...]
    """Places to its left, rising."""

    @property
    def spacing(self) -> float:
        """Distance of the points."""
        return self.ahead[1] - self.ahead[0]

    def scale(self, robot: RobotDescription) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the places ahead and to the left of the base's origin of a robot, upright [m]."""
        length = robot.leg_geometry.length
        return tuple(length * place for place in self.ahead), tuple(length * place for place in self.left)

    def points(self, robot: RobotDescription) -> Array:
        """Return the points (K, 2) [m] around a robot: x ahead and y to the left of the base's origin, upright."""
        x, y = np.meshgrid(*self.scale(robot), indexing="ij")
        points: Array = np.stack([x.ravel(), y.ravel()], axis=-1)
        return points

    def columns(self) -> list[str]:
        """Return names of the heights at the points, in quarters of a leg; those of the right mirror the left ones."""
        sides = {0.0: "middle"} | {y: f"{'left' if y > 0 else 'right'}{4 * abs(y):g}" for y in self.left if y}
        return [f"ground{4 * x:g}.{sides[y]}" for x in self.ahead for y in self.left]

    def nearest(self, other: Grid) -> dict[str, str]:
        """Return for each of the points the name of another grid's nearest point, by its own name."""
        ahead, left = (
            tuple(places[int(np.argmin(np.abs(np.subtract(places, one))))] for one in own)
            for own, places in ((self.ahead, other.ahead), (self.left, other.left))
        )
        return dict(zip(self.columns(), Grid(ahead, left).columns(), strict=True))


def _places(low: int, high: int, count: int) -> tuple[float, ...]:
    """Return places from `low` to `high` quarters of a leg, `count` to a quarter."""
    return tuple(k / (4 * count) for k in range(low * count, high * count + 1))


POLICY_GRID = Grid(_places(-3, 6, 2), _places(-3, 3, 2))
"""What a policy sees: fine enough to set a foot beside a gap."""
CRITIC_GRID = Grid(_places(-5, 7, 1), _places(-3, 3, 1))
"""What the value network sees."""
MAX_RELATIVE_HEIGHT = 1.0
"""Limit of the heights of a scan [m], up and down from the base's origin."""


def scan_heights(ground: Ground, points: Array, position: Array, yaw: Array) -> Array:
    """Return heights of the ground less those of the bases' origins (N, K) [m], within `MAX_RELATIVE_HEIGHT`.

    Args:
        ground: what they stand on.
        points: of the grid (K, 2) [m].
        position: of the bases (N, 3) in the world [m].
        yaw: of the bases (N,) [rad].
    """
    places = from_heading_frame(points, yaw) + position[:, None, :2]
    heights: Array = np.clip(ground.height(places) - position[:, None, 2], -MAX_RELATIVE_HEIGHT, MAX_RELATIVE_HEIGHT)
    return heights


@dataclass(frozen=True)
class ScanConfig:
    """What a robot's map of heights makes of the ground, for the observation `height_scan`."""

    noise: Annotated[float, Within(0, 1)] = 0.01
    """Standard deviation [m] of each height, anew at every control step."""
    drift: Annotated[float, Within(0, 1)] = 0.02
    """Standard deviation [m] of an error that all heights of an episode share."""
    shift: Annotated[float, Within(0, 1)] = 0.02
    """Standard deviation [m] of an error of where the map is, along x and y, in an episode."""
    holes: Annotated[float, Within(0, 1)] = 0.02
    """Share of points without a height at a control step; they have that under the middle of the base."""
    delay: Annotated[int, Within(0, 50)] = 2
    """Age of the map [control steps]."""

    def __post_init__(self) -> None:
        """Refuse values out of bounds."""
        check_bounds(self, "terrain.scan")


class HeightScanner:
    """A map of heights of N robots with its errors.

    Args:
        config: the errors.
        robot: whose grid.
        num_envs: number of robots N.
        seed: seeds the errors, one stream a robot.
    """

    arrays = ("_past", "_drift")
    """Names of the arrays that change over time."""

    def __init__(self, config: ScanConfig, robot: RobotDescription, num_envs: int, seed: int) -> None:
        self.config, self.points = config, POLICY_GRID.points(robot)
        self.streams = generators(seed, "height scan", num_envs)
        # The newest scan first.
        self._past = np.zeros((config.delay + 1, num_envs, len(self.points)))
        self._drift = np.zeros((num_envs, 3))
        self._middle = int(np.argmin(np.linalg.norm(self.points, axis=1)))

    def reset(self, rows: NDArray[np.int64], ground: Ground, position: Array, yaw: Array) -> None:
        """Draw the errors of new episodes of some robots, whose maps begin where they stand; see `scan_heights`."""
        scale = np.array([self.config.shift, self.config.shift, self.config.drift])
        for i in rows:
            self._drift[i] = scale * self.streams[i].standard_normal(3)
        self._past[:, rows] = self._scan(rows, ground, position[rows], yaw[rows])

    def update(self, ground: Ground, position: Array, yaw: Array) -> None:
        """Take the scan of a control step; see `scan_heights`."""
        self._past[1:] = self._past[:-1].copy()
        self._past[0] = self._scan(np.arange(len(self.streams)), ground, position, yaw)

    @property
    def heights(self) -> Array:
        """What the robots know now (N, K) [m]."""
        return self._past[-1]

    def _scan(self, rows: NDArray[np.int64], ground: Ground, position: Array, yaw: Array) -> Array:
        heights = scan_heights(ground, self.points, position + self._drift[rows], yaw)
        draws = np.array([self.streams[i].random(2 * len(self.points)) for i in rows]).reshape(len(rows), 2, -1)
        # A uniform error of the same deviation: its draws cost a tenth of normal ones.
        heights += self.config.noise * np.sqrt(12.0) * (draws[:, 0] - 0.5)
        return np.where(draws[:, 1] < self.config.holes, heights[:, [self._middle]], heights)


class HeightScan(Component):
    """The map of heights in a task.

    Args:
        scanner: the map with its errors.
    """

    def __init__(self, scanner: HeightScanner) -> None:
        self.scanner = scanner

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays of the scanner that an exact resume needs, by name."""
        return {f"scan_{name}": getattr(self.scanner, name) for name in self.scanner.arrays}

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Streams of random numbers of the errors."""
        return {"scan_streams": self.scanner.streams}

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Begin the maps of new episodes where the robots stand."""
        truth = state.truth
        self.scanner.reset(rows, state.ground, truth.base_position_world, truth.roll_pitch_yaw[:, 2])
        self.publish(state)

    def after_step(self, state: EnvState) -> None:
        """Take the scan of a control step."""
        truth = state.truth
        self.scanner.update(state.ground, truth.base_position_world, truth.roll_pitch_yaw[:, 2])
        self.publish(state)

    def publish(self, state: EnvState) -> None:
        """Write the heights that the robots know to the state."""
        state.heights = self.scanner.heights
