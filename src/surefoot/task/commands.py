"""Commands in a task: their ranges, how they are drawn in training, and how the gait follows them over time."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.configuration import Within, check_bounds, from_mapping
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors, quote
from surefoot.files import check_readable
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.commands import COMMANDS, STAND, CommandLimits
from surefoot.seeding import generators

Range = tuple[float, float]

_LAST_COMMAND_DURATION = 2.0
"""Time for which the last command of a file is followed [s]."""
_MAX_FILE_SIZE = 1_000_000
"""Size of the largest file of commands that is read."""
MAX_HEADING_ERROR = 0.5
"""Greatest heading error [rad] that is corrected; beyond it the heading that is held follows the robot."""
MAX_STANDING_HEADING_ERROR = 0.15
"""Greatest heading error [rad] that a standing robot keeps, to correct it when it walks again."""


@dataclass(frozen=True)
class CommandConfig:
    """Commands that an episode draws, uniformly; none, if all ranges are (0, 0)."""

    forward: Range = (0.0, 0.0)
    """Least and greatest speed forward."""
    sideways: Range = (0.0, 0.0)
    """Least and greatest speed to the left; robots without abduction have none."""
    yaw_rate: Range = (0.0, 0.0)
    """Least and greatest yaw rate."""
    relative: bool = False
    """Speeds count sqrt(g l), of a leg of length l, and yaw rates sqrt(g / l), else m/s and rad/s. The square of a
    relative speed is the Froude number."""
    acceleration: Annotated[float, Within(0, 100, above=True)] = 0.3
    """How fast the gait follows: speeds in g, yaw rates in g / l."""
    heading_gain: Annotated[float, Within(0, 100)] = 0.0
    """Yaw rate [rad/s] that is added per heading error [rad]; 0: the heading is not held."""
    hold: Annotated[Range, Within(0.01, 3600)] = (2.0, 6.0)
    """Least and greatest time [s] until another command is drawn."""
    stand: Annotated[float, Within(0, 1)] = 0.1
    """Chance that a command means stand."""
    straight: Annotated[float, Within(0, 1)] = 0.15
    """Chance that a command asks for a speed forward only."""
    slowest: Annotated[float, Within(0, 1)] = 0.0
    """Least linear speed of a command that does not mean stand, as a share of the greatest speed forward: slower ones
    get more speed forward or backward, within its range."""
    ramp: Annotated[int, Within(0, 1_000_000)] = 0
    """Curriculum: a robot's first `ramp` commands grow from nothing to what is drawn; 0: none do."""
    schedule: tuple[tuple[float, float, float, float], ...] = ()
    """Commands that are given in place of drawn ones: time in the episode [s], speeds forward and to the left [m/s] and
    yaw rate [rad/s]; each holds until the next, and before the first the robot stands."""
    each: tuple[tuple[float, float, float], ...] = ()
    """Commands that hold for a whole episode in place of drawn ones: robot i follows row i, and begins anew after the
    last one [m/s, m/s, rad/s]."""

    def __post_init__(self) -> None:
        """Refuse values out of bounds and reversed ranges."""
        check_bounds(self, "commands")
        for name in (*COMMANDS, "hold"):
            low, high = getattr(self, name)
            if low > high:
                raise SurefootError(f"commands.{name} is [{low:g}, {high:g}]; the lower bound must come first")
        for k, (time, *_) in enumerate(self.schedule):
            if time < 0 or (k and time <= self.schedule[k - 1][0]):
                raise SurefootError(f"commands: row {k + 1} is at {time:g} s; times start at 0 s or later and increase")
        if self.schedule and self.each:
            raise SurefootError("commands.schedule and commands.each are given; give one of them")

    @property
    def enabled(self) -> bool:
        """Whether the task has commands at all."""
        return any(getattr(self, name) != (0.0, 0.0) for name in COMMANDS)

    def make_generator(self, limits: CommandLimits, num_envs: int, seed: int) -> CommandGenerator:
        """Return the generator of the commands of a batch."""
        if self.schedule:
            return CommandSchedule([self.schedule], limits, num_envs)
        if self.each:
            return CommandSchedule([[(0.0, *row)] for row in self.each], limits, num_envs)
        return CommandSampler(self, limits, num_envs, seed)

    def limits(self, robot: RobotDescription) -> CommandLimits | None:
        """Return what the robot can be commanded, in SI units; None without commands.

        Raises:
            SurefootError: a speed sideways for legs without abduction, unless ranges are relative; a range without 0.
        """
        if not self.enabled:
            return None
        length = robot.leg_geometry.length
        speed, rate = np.sqrt(GRAVITY * length), np.sqrt(GRAVITY / length)
        units = dict(zip(COMMANDS, (speed, speed, rate) if self.relative else (1.0, 1.0, 1.0), strict=True))
        ranges = {name: tuple(float(value * units[name]) for value in getattr(self, name)) for name in COMMANDS}
        if "abduction" not in robot.coordinates and ranges["sideways"] != (0.0, 0.0):
            if not self.relative:
                raise SurefootError(f"commands.sideways is not zero; the legs of {robot.name} have no abduction")
            ranges["sideways"] = (0.0, 0.0)
        linear, turning = self.acceleration * GRAVITY, self.acceleration * GRAVITY / length
        return CommandLimits(
            **ranges,  # type: ignore[arg-type]
            acceleration=(linear, linear, turning),
            deadband=(0.01 * speed, 0.01 * speed, 0.01 * rate),
            heading_gain=self.heading_gain,
        )


def read_schedule(path: Path) -> tuple[tuple[float, float, float, float], ...]:
    """Return the rows of a file of commands over time: CSV with the columns time, forward, sideways and yaw_rate.

    Raises:
        SurefootError: no such file, another kind of file, or rows that `CommandConfig.schedule` refuses.
    """
    names = ("time", *COMMANDS)
    rule = f"a file of commands is CSV with the columns {', '.join(names)}"
    with describe_os_errors(f"commands {path}"):
        check_readable(path, _MAX_FILE_SIZE)
        text = path.read_text(encoding="utf-8", errors="replace")
    with prefix_errors(f"commands {path}"):
        try:
            header, *rows = list(csv.reader(text.splitlines())) or [[]]
            if [name.strip() for name in header] != list(names):
                raise SurefootError(f"its first line is {quote(','.join(header))}; {rule}")
            table = [[float(value) for value in row] for row in rows if row]
        except csv.Error as error:
            raise SurefootError(f"{error}; {rule}") from error
        except ValueError as error:
            raise error if isinstance(error, SurefootError) else SurefootError(f"{error}; {rule}") from error
        if not table:
            raise SurefootError(f"it has no row; {rule}")
        return from_mapping(CommandConfig, {"schedule": table}, "commands").schedule


def schedule_duration(rows: Sequence[Sequence[float]]) -> float:
    """Return how long a run takes that follows rows of time [s] and commands to their end [s]; 0 for none."""
    return rows[-1][0] + _LAST_COMMAND_DURATION if rows else 0.0


class CommandGenerator:
    """Commands to the robots of a batch; this class holds those that it was given last, until an episode starts.

    Args:
        num_envs: robots.
    """

    arrays: tuple[str, ...] = ("command",)
    """Names of the arrays that change over time."""

    def __init__(self, num_envs: int) -> None:
        self.streams: list[np.random.Generator] = []
        self.command = np.zeros((num_envs, 3))
        """Present commands; they may be written."""

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Let robots whose episodes start stand."""
        self.command[rows] = STAND

    def update(self, time: Array) -> None:
        """Set the commands of robots whose episodes are `time` (N,) [s] old."""


class CommandSchedule(CommandGenerator):
    """Gives robots the commands of schedules, within their limits: robot i those of schedule i, in turn.

    Args:
        schedules: rows of time [s] and commands, as of `CommandConfig.schedule`.
        limits: of the commands; None: they are given as they are.
        num_envs: robots.
    """

    def __init__(
        self, schedules: Sequence[Sequence[Sequence[float]]], limits: CommandLimits | None, num_envs: int
    ) -> None:
        super().__init__(num_envs)
        self._schedules = []
        for rows in schedules:
            times, *columns = np.array(rows, float).T
            commands = np.array(columns).T
            if limits is not None:
                commands = np.clip(commands, limits.low, limits.high)
            self._schedules.append((times, np.concatenate([[STAND], commands])))

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Begin the schedules for episodes that start."""
        for i in rows:
            self.command[i] = self.at(0.0, i)

    def update(self, time: Array) -> None:
        """Set the commands of robots whose episodes are `time` (N,) [s] old."""
        for k in range(min(len(self._schedules), len(time))):
            self.command[k :: len(self._schedules)] = self.at(time[k :: len(self._schedules)], k)

    def at(self, time: ArrayLike, robot: int = 0) -> Array:
        """Return a robot's commands (..., 3) at times (...) [s]."""
        times, commands = self._schedules[robot % len(self._schedules)]
        return np.asarray(commands[np.searchsorted(times, np.asarray(time) + 5e-7, side="right")])


class CommandSampler(CommandGenerator):
    """Draws commands for each robot of a batch, each from its own stream.

    Args:
        config: how they are drawn.
        limits: their ranges.
        num_envs: robots.
        seed: seeds the streams.
    """

    arrays = ("command", "until", "drawn")

    def __init__(self, config: CommandConfig, limits: CommandLimits, num_envs: int, seed: int) -> None:
        super().__init__(num_envs)
        self.config, self.limits = config, limits
        self.streams = generators(seed, "commands", num_envs)
        self.until = np.zeros(num_envs)
        """Time in the episode [s] at which another command is drawn, (N,)."""
        self.drawn = np.zeros(num_envs, np.int64)
        """Commands drawn so far."""

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Draw commands for episodes that start."""
        self.until[rows] = 0.0
        self._draw(rows)

    def update(self, time: Array) -> None:
        """Draw other commands for robots whose episodes are `time` (N,) [s] old, where these are due."""
        self._draw(np.flatnonzero(time + 5e-7 >= self.until))

    def _draw(self, rows: NDArray[np.int64]) -> None:
        config, low, high = self.config, self.limits.low, self.limits.high
        slowest = config.slowest * high[0]
        for i in rows:
            # Five numbers each time, whatever the configuration: a robot draws the same in every experiment.
            chance, hold, *shares = self.streams[i].uniform(size=5)
            command = low + np.array(shares) * (high - low)
            if chance < config.stand:
                command[:] = 0.0
            elif chance < config.stand + config.straight:
                command[1:] = 0.0
            if chance >= config.stand and np.hypot(*command[:2]) < slowest:
                ahead = np.copysign(np.sqrt(max(slowest**2 - command[1] ** 2, 0.0)), command[0])
                command[0] = np.clip(ahead, low[0], high[0])
            if config.ramp:
                command *= min(1.0, (self.drawn[i] + 1) / config.ramp)
            self.command[i] = command
            self.until[i] += config.hold[0] + hold * (config.hold[1] - config.hold[0])
            self.drawn[i] += 1


@dataclass(frozen=True)
class CommandState:
    """Commands and phase that a gait follows, of N robots."""

    command: Array
    """Speeds forward and to the left [m/s] and yaw rate [rad/s], (N, 3): the given command, its change limited, and
    the yaw rate that holds the heading."""
    activity: Array
    """Share of full steps, 0 for a robot that stands to 1 for one that walks, (N,)."""
    phase: Array
    """Phase of the gait in cycles, 0 to 1, (N,)."""
    lift_off: Array | None = None
    """How far feet stood beside the places of their strides when they lifted off (N, L, 2) [m], see `Footholds`."""
    landing: Array | None = None
    """How far beside them they land, likewise; they keep that in stance."""
    lift: Array | None = None
    """How much further feet are lifted in their swings (N, L) [m], see `ContactReflex`."""
    over_holes: Array | None = None
    """Share of the gait over holes (N,), 0 to 1, see `Footholds`."""
