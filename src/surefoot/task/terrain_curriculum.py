"""Terrain curriculum: robots that cover the commanded distance start on more difficult tiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.rotations import in_heading_frame
from surefoot.seeding import generators
from surefoot.task.command_tracking import is_success, step_distances
from surefoot.task.component import Component
from surefoot.task.state import EnvState
from surefoot.task.terrain import TerrainConfig
from surefoot.world.terrain import TerrainField

MIN_COVERED_FRACTION = 0.5
"""Fraction of the commanded distance below which a robot is moved down a level."""
MIN_COMMANDED_DISPLACEMENT = 2.5
"""Distance [m] from the start to which the commands of an episode must lead before it changes the level: the first
`START_HALF_SIDE` of it is level ground, and commands that turn in circles never leave that place."""


class TerrainCurriculum(Component):
    """Choice of the tiles on which robots start, by how much of the commanded distance they covered.

    Args:
        config: terrain configuration with `sizes`.
        tiles: field of tiles built from it.
        num_envs: number of robots N.
        seed: seed of the levels and columns, with one random stream per robot.
    """

    prefix = "terrain"
    changing = ("level", "column", "commanded", "covered", "led", "begun")

    def __init__(self, config: TerrainConfig, tiles: TerrainField, num_envs: int, seed: int) -> None:
        self.config, self.tiles = config, tiles
        self._streams = generators(seed, "terrain", num_envs)
        self.level = np.array([stream.integers(config.start_level + 1) for stream in self._streams])
        # Kinds of terrain are spread evenly over any number of robots.
        columns, robots = len(tiles.kinds), np.arange(num_envs)
        self.column = robots * columns // num_envs if num_envs < columns else robots % columns
        self.commanded, self.covered = np.zeros((2, num_envs))
        self.led = np.zeros((num_envs, 2))
        """Displacement since the start if the commands had been followed exactly (N, 2) [m], in the world frame."""
        self.begun = np.zeros(num_envs, np.bool_)

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Streams of random numbers, one per robot."""
        return {"terrain_streams": self._streams}

    def before_reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Raise or lower the level of robots whose episodes ended, and choose their tiles."""
        state.start_place[rows] = self.begin(rows, state.terminated[rows])

    def after_step(self, state: EnvState) -> None:
        """Add the distances of the control step, except for robots that diverged or wait for a reset."""
        velocity = state.command_error[:, :2] + state.filtered_command[:, :2]
        self.record(state.command[:, :2], velocity, state.before.roll_pitch_yaw[:, 2], state.duration * ~state.idle)

    def metrics(self) -> Mapping[str, Any]:
        """Return the mean level by kind of terrain."""
        return {"levels": self.levels()}

    def begin(self, rows: NDArray[np.int64], fell: NDArray[np.bool_]) -> Array:
        """Update levels and return the positions (n, 2) [m] where robots start next.

        Args:
            rows: indices of the robots (n,).
            fell: whether their last episodes ended in a fall (n,).
        """
        if self.config.curriculum:
            commanded, covered = self.commanded[rows], self.covered[rows]
            displacement = np.linalg.norm(self.led[rows], axis=1)
            is_rated = self.begun[rows] & (displacement >= MIN_COMMANDED_DISPLACEMENT)
            up = is_rated & is_success(commanded, covered, ~fell)
            down = self.begun[rows] & fell | is_rated & (covered < MIN_COVERED_FRACTION * commanded)
            self.level[rows] += up.astype(np.int64) - down
            for i in rows[self.level[rows] >= self.config.levels]:
                self.level[i] = self._streams[i].integers(self.config.levels)
            self.level[rows] = np.maximum(self.level[rows], 0)
        self.commanded[rows] = self.covered[rows] = 0.0
        self.led[rows] = 0.0
        self.begun[rows] = True
        starts: Array = self.tiles.starts[self.level[rows], self.column[rows]]
        return starts

    def record(self, command: Array, velocity: Array, yaw: Array, duration: Array) -> None:
        """Add the distances of a control step.

        Args:
            command: commanded speeds forward and to the left (N, 2) [m/s].
            velocity: velocity of the base in its heading frame (N, 2) [m/s].
            yaw: yaw at the start of the step (N,) [rad].
            duration: duration of the step (N,) [s].
        """
        commanded, covered = step_distances(command, velocity, duration)
        self.commanded += commanded
        self.covered += covered
        displacement = np.column_stack([command * duration[:, None], np.zeros(len(command))])
        self.led += in_heading_frame(displacement, -yaw)[:, :2]

    def levels(self) -> Mapping[str, float]:
        """Return the mean level of the robots on each kind of terrain that has any."""
        kinds = np.array(self.tiles.kinds)[self.column]
        return {name: float(self.level[kinds == name].mean()) for name in dict.fromkeys(kinds.tolist())}


class EpisodeStarts(Component):
    """Positions and headings of robots whose episodes start.

    Args:
        heading: maximum heading to either side [deg].
        num_envs: number of robots.
        seed: seed of the headings, with one random stream per robot.
    """

    def __init__(self, heading: float, num_envs: int, seed: int) -> None:
        self._limit = np.radians(heading)
        self._streams = generators(seed, "heading", num_envs if heading else 0)

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Streams of random numbers, one per robot, if headings are random."""
        return {"heading_streams": self._streams}

    def before_reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Place the robots on their tiles with random headings."""
        limit, streams = self._limit, self._streams
        headings = np.array([streams[i].uniform(-limit, limit) if streams else 0.0 for i in rows])
        state.world.place(rows, state.start_place[rows], headings)
