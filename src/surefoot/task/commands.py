"""Velocity commands of a task: ranges, random sampling in training, schedules, and the state that the gait follows."""

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
from surefoot.robot.commands import COMMANDS, STAND_COMMAND, CommandLimits
from surefoot.seeding import generators

Range = tuple[float, float]

_LAST_COMMAND_DURATION = 2.0
"""Time for which a robot follows the last command of a schedule [s]."""
_MAX_FILE_SIZE = 1_000_000
"""Maximum size of a command file [bytes]."""
MAX_HEADING_ERROR = 0.5
"""Maximum heading error [rad] that is corrected. If the robot turns further away, the desired heading moves with it."""
MAX_STANDING_HEADING_ERROR = 0.15
"""Maximum heading error [rad] that a standing robot remembers, to correct it when it walks again."""


@dataclass(frozen=True)
class CommandConfig:
    """Velocity commands of an episode, drawn uniformly. A task whose ranges are all (0, 0) has no commands."""

    forward: Range = (0.0, 0.0)
    """Minimum and maximum forward speed."""
    sideways: Range = (0.0, 0.0)
    """Minimum and maximum speed to the left. Ignored for robots without abduction if `relative`."""
    yaw_rate: Range = (0.0, 0.0)
    """Minimum and maximum yaw rate."""
    relative: bool = False
    """Ranges are in units of sqrt(g l) for speeds and sqrt(g / l) for yaw rates, with the leg length l, instead of m/s
    and rad/s. The square of a relative speed is the Froude number."""
    acceleration: Annotated[float, Within(0, 100, exclusive=True)] = 0.3
    """Maximum acceleration of the filtered command: of speeds in g, of yaw rates in g / l."""
    heading_gain: Annotated[float, Within(0, 100)] = 0.0
    """Proportional gain of the heading control [rad/s per rad]; 0: no heading control."""
    hold: Annotated[Range, Within(0.01, 3600)] = (2.0, 6.0)
    """Minimum and maximum time [s] between two commands."""
    stand: Annotated[float, Within(0, 1)] = 0.1
    """Probability of a zero command (stand still)."""
    straight: Annotated[float, Within(0, 1)] = 0.15
    """Probability of a command with forward speed only."""
    slowest: Annotated[float, Within(0, 1)] = 0.0
    """Minimum linear speed of nonzero commands, as a fraction of the maximum forward speed. Slower commands get more
    forward or backward speed, within its range."""
    ramp: Annotated[int, Within(0, 1_000_000)] = 0
    """Curriculum: a robot's first `ramp` commands are scaled up linearly to the full ranges; 0: no curriculum."""
    schedule: tuple[tuple[float, float, float, float], ...] = ()
    """Fixed commands over time instead of random ones: time in the episode [s], speeds forward and to the left [m/s]
    and yaw rate [rad/s]. Each holds until the next one. Before the first, the robot stands."""
    each: tuple[tuple[float, float, float], ...] = ()
    """One fixed command per episode instead of random ones: robot i follows row i modulo the number of rows
    [m/s, m/s, rad/s]."""

    def __post_init__(self) -> None:
        """Reject values out of bounds and reversed ranges."""
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
        """Whether the task has commands."""
        return any(getattr(self, name) != (0.0, 0.0) for name in COMMANDS)

    def make_generator(self, limits: CommandLimits, num_envs: int, seed: int) -> CommandGenerator:
        """Return the command generator of a batch: schedules if the configuration has them, otherwise random."""
        if self.schedule:
            return CommandSchedule([self.schedule], limits, num_envs)
        if self.each:
            return CommandSchedule([[(0.0, *row)] for row in self.each], limits, num_envs)
        return CommandSampler(self, limits, num_envs, seed)

    def limits(self, robot: RobotDescription) -> CommandLimits | None:
        """Return the robot's command limits in SI units, or None for a task without commands.

        Raises:
            SurefootError: a sideways speed for legs without abduction, unless ranges are relative; a range without 0.
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
    """Read a command schedule from a CSV file with the columns time, forward, sideways and yaw_rate.

    Raises:
        SurefootError: no such file, another kind of file, or rows that `CommandConfig.schedule` does not allow.
    """
    names = ("time", *COMMANDS)
    rule = f"a command file is CSV with the columns {', '.join(names)}"
    with describe_os_errors(f"commands {path}"):
        check_readable(path, _MAX_FILE_SIZE)
        text = path.read_text(encoding="utf-8-sig", errors="replace")  # Excel begins its files with a mark
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
    """Return the duration [s] of a run that follows a schedule to its end, or 0 for an empty schedule."""
    return rows[-1][0] + _LAST_COMMAND_DURATION if rows else 0.0


class CommandGenerator:
    """Command generator of a batch of robots. This base class keeps the commands that are written to it.

    Args:
        num_envs: number of robots.
    """

    arrays: tuple[str, ...] = ("command",)
    """Names of the arrays that change over time."""

    def __init__(self, num_envs: int) -> None:
        self.streams: list[np.random.Generator] = []
        self.command = np.zeros((num_envs, 3))
        """Current commands (N, 3) [m/s, m/s, rad/s]; callers may write them."""

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Command robots whose episodes start to stand."""
        self.command[rows] = STAND_COMMAND

    def update(self, time: Array) -> None:
        """Update the commands for the time since each robot's episode started, `time` (N,) [s]."""


class CommandSchedule(CommandGenerator):
    """Commands from schedules: robot i follows schedule i modulo the number of schedules.

    Args:
        schedules: rows of time [s] and commands, see `CommandConfig.schedule`.
        limits: limits to which commands are clipped, or None for no limits.
        num_envs: number of robots.
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
            self._schedules.append((times, np.concatenate([[STAND_COMMAND], commands])))

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Restart the schedules of robots whose episodes start."""
        for i in rows:
            self.command[i] = self.at(0.0, i)

    def update(self, time: Array) -> None:
        """Update the commands for the time since each robot's episode started, `time` (N,) [s]."""
        for k in range(min(len(self._schedules), len(time))):
            self.command[k :: len(self._schedules)] = self.at(time[k :: len(self._schedules)], k)

    def at(self, time: ArrayLike, robot: int = 0) -> Array:
        """Return a robot's commands (..., 3) at times (...) [s]."""
        times, commands = self._schedules[robot % len(self._schedules)]
        return np.asarray(commands[np.searchsorted(times, np.asarray(time) + 5e-7, side="right")])


class CommandSampler(CommandGenerator):
    """Random commands, with one random stream per robot.

    Args:
        config: distribution of the commands.
        limits: ranges of the commands.
        num_envs: number of robots.
        seed: seed of the random streams.
    """

    arrays = ("command", "until", "drawn")

    def __init__(self, config: CommandConfig, limits: CommandLimits, num_envs: int, seed: int) -> None:
        super().__init__(num_envs)
        self.config, self.limits = config, limits
        self.streams = generators(seed, "commands", num_envs)
        self.until = np.zeros(num_envs)
        """Time in the episode [s] at which the next command is drawn (N,)."""
        self.drawn = np.zeros(num_envs, np.int64)
        """Number of commands drawn so far (N,)."""

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Draw commands for episodes that start."""
        self.until[rows] = 0.0
        self._draw(rows)

    def update(self, time: Array) -> None:
        """Draw new commands for robots whose hold time is over at `time` (N,) [s] in their episodes."""
        self._draw(np.flatnonzero(time + 5e-7 >= self.until))

    def _draw(self, rows: NDArray[np.int64]) -> None:
        config, low, high = self.config, self.limits.low, self.limits.high
        slowest = config.slowest * high[0]
        for i in rows:
            # Always draw five numbers, so that robots get the same random numbers in every experiment.
            chance, hold, *fractions = self.streams[i].uniform(size=5)
            command = low + np.array(fractions) * (high - low)
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
    """Inputs of a gait that follows commands, for N robots: filtered command, phase, footholds and lift."""

    command: Array
    """Speeds forward and to the left [m/s] and yaw rate [rad/s] (N, 3): the rate-limited command plus the yaw rate of
    the heading control."""
    activity: Array
    """Stepping amplitude (N,): 0 while a robot stands, 1 for full steps."""
    phase: Array
    """Phase of the gait (N,) [cycles], 0 to 1."""
    lift_off: Array | None = None
    """Offset of each foot from its nominal stride position at its last lift-off (N, L, 2) [m], see `Footholds`."""
    landing: Array | None = None
    """Offset of each foot from its nominal stride position at landing, kept during stance (N, L, 2) [m]."""
    lift: Array | None = None
    """Additional lift of feet in swing (N, L) [m], see `ContactReflex`."""
    over_holes: Array | None = None
    """Blend weight of the gait over holes (N,), 0 to 1, see `Footholds`."""
