"""Sensitivity of a policy to physical parameters: it is run in worlds that differ from the nominal one in one of them.

After Tan et al. 2018, section VI-B: each parameter of table I takes evenly spaced values within its range, while all
others stay nominal, and the mean and standard deviation of the return over all these test worlds tell how robust a
policy is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, at_least
from surefoot.evaluate.rollout import Policy, Progress, run_to_end
from surefoot.evaluate.runs import Runs
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.robot.randomization import ParamRange, Ranges, check_ranges, interval_of, mean_interval
from surefoot.task.config import MOST_STEPS, TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.world.interface import Simulation, SimulationFactory, WorldConfig

Flags = NDArray[np.bool_]
PUSH_FORCE = "push_force"
"""Row of the force of pushes [N]."""


@dataclass(frozen=True)
class TestWorld:
    """A world that differs from the nominal one in one physical parameter, or in the force of pushes."""

    __test__ = False  # no test of pytest's, whatever its name

    row: str
    """The parameter, or `push_force`."""
    value: float
    """Its value; the mean, where motors or axes differ."""
    values: tuple[float, ...] = field(default=(), compare=False, repr=False)
    """Its value for each motor or axis; empty in results that were read from a file."""


@dataclass(frozen=True)
class Nominal:
    """The nominal world, which the others are compared with; E episodes."""

    values: Mapping[str, float]
    """Value of each row of the table; its mean, where motors or axes differ."""
    returns: Array
    """Return of each episode [m], (E,)."""
    fell: Flags
    """Whether each episode ended in a fall, (E,)."""
    speed: Array
    """Speed in each episode [m/s], (E,)."""

    @property
    def mean_return(self) -> float:
        """Mean of the returns [m]."""
        return float(self.returns.mean())


@dataclass(frozen=True)
class Sensitivity:
    """How one policy did in W test worlds, E episodes in each."""

    policy: str
    """Name of the policy."""
    worlds: tuple[TestWorld, ...]
    """Test worlds: row by row of the table, values rising."""
    returns: Array
    """Return of each episode [m], to its own end, (W, E)."""
    fell: Flags
    """Whether each episode ended in a fall, or the simulation diverged, (W, E)."""
    speed: Array
    """Distance forward over time [m/s], to each episode's own end, (W, E)."""
    nominal: Nominal
    """The nominal world; no test world, so in none of the aggregates."""

    @property
    def mean_return(self) -> Array:
        """Mean return in each world [m], (W,)."""
        return np.asarray(self.returns.mean(axis=1), np.float64)

    @property
    def standard_error(self) -> Array:
        """Standard error of each world's mean return [m], (W,); NaN where there is one episode only."""
        episodes = self.returns.shape[1]
        if episodes < 2:
            return np.full(len(self.worlds), math.nan)
        return np.asarray(self.returns.std(axis=1, ddof=1) / math.sqrt(episodes), np.float64)

    @property
    def mean(self) -> float:
        """Mean over all test worlds of their mean returns [m]: the paper's measure of performance."""
        return float(self.mean_return.mean())

    @property
    def std(self) -> float:
        """Standard deviation over all test worlds of their mean returns [m]: the paper's measure of robustness."""
        return float(self.mean_return.std())

    @property
    def fall_rate(self) -> float:
        """Share of all episodes in test worlds that ended in a fall."""
        return float(self.fell.mean())

    @property
    def rows(self) -> tuple[str, ...]:
        """Rows of the table that were varied, in its order."""
        return tuple(dict.fromkeys(world.row for world in self.worlds))

    def of_row(self, row: str) -> NDArray[np.int64]:
        """Indices of a row's test worlds, values rising."""
        return np.array([i for i, world in enumerate(self.worlds) if world.row == row], np.int64)

    def values_of(self, row: str) -> Array:
        """Return the values of a row's test worlds, rising."""
        return np.array([world.value for world in self.worlds if world.row == row])

    def world_rows(self) -> list[dict[str, Any]]:
        """Return a row for each test world: returns [m] and speed [m/s] over its episodes, and falls."""
        return [
            {
                "policy": self.policy,
                "row": world.row,
                "unit": row_unit(world.row),
                "value": world.value,
                "episodes": self.returns.shape[1],
                "return_mean": float(self.mean_return[i]),
                "return_error": float(self.standard_error[i]),
                "return_std": float(self.returns[i].std()),
                "speed_mean": float(self.speed[i].mean()),
                "falls": int(self.fell[i].sum()),
            }
            for i, world in enumerate(self.worlds)
        ]

    def episode_rows(self) -> list[dict[str, Any]]:
        """Return a row for each episode, those of the nominal world first (row `nominal`, without unit and value)."""
        places = [("nominal", "", math.nan), *((world.row, row_unit(world.row), world.value) for world in self.worlds)]
        columns = ([getattr(self.nominal, name), *getattr(self, name)] for name in ("returns", "speed", "fell"))
        return [
            {"policy": self.policy, "row": row, "unit": unit, "value": value, "run": run}
            | {"return": float(gained), "speed": float(speed), "fell": bool(fell)}
            for (row, unit, value), *episodes in zip(places, *columns, strict=True)
            for run, (gained, speed, fell) in enumerate(zip(*episodes, strict=True))
        ]

    def to_mapping(self) -> dict[str, Any]:
        """Return the results as JSON holds them, without the policy's name."""
        names = ("returns", "fell", "speed")
        nominal = {name: getattr(self.nominal, name).tolist() for name in names}
        return {
            "worlds": [[world.row, world.value] for world in self.worlds],
            **{name: getattr(self, name).tolist() for name in names},
            "nominal": {"values": dict(self.nominal.values), **nominal},
        }

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any], policy: str) -> Sensitivity:
        """Return results from `to_mapping`, under a name of one's choice."""

        def columns(part: Mapping[str, Any]) -> tuple[Array, Flags, Array]:
            return np.array(part["returns"]), np.array(part["fell"], np.bool_), np.array(part["speed"])

        worlds = tuple(TestWorld(row, value) for row, value in data["worlds"])
        nominal = Nominal(data["nominal"]["values"], *columns(data["nominal"]))
        return cls(policy, worlds, *columns(data), nominal)


def make_test_worlds(
    ranges: Mapping[str, ParamRange],
    nominal: PhysicalParams,
    values: int = 10,
    push_force: tuple[float, float] | None = None,
) -> tuple[TestWorld, ...]:
    """Return the test worlds of ranges around nominal values, and of a range of the force of pushes [N].

    Each row takes two or more evenly spaced `values` in its range, both ends included; a range of one value takes one.
    """
    at_least("values", values, 2)
    rows = {name: interval_of(given, getattr(nominal, name)[:1]) for name, given in ranges.items()}
    if push_force is not None:
        rows[PUSH_FORCE] = np.array(push_force[:1]), np.array(push_force[1:])
    if not rows:
        raise SurefootError("the table of ranges is empty; a sensitivity study needs 1 range or more, as table1's")
    return tuple(
        TestWorld(row, float(value.flat[0] if np.ptp(value) == 0 else value.mean()), tuple(value.flat))
        for row, (low, high) in rows.items()
        for value in np.linspace(low, high, values if (high > low).any() else 1)
    )


def row_unit(row: str) -> str:
    """Unit of a row's values; empty for a ratio."""
    if row == PUSH_FORCE:
        return "N"
    unit = PARAMETERS[row].unit if row in PARAMETERS else ""  # results of earlier versions have other rows
    return "" if unit == "1" else unit


def trained_ranges(task: TaskConfig) -> dict[str, tuple[float, float]]:
    """Return the ranges that a policy of a task was trained in, by row."""
    robot = RobotDescription.load(task.robot)
    nominal = task.nominal(robot)
    ranges = {name: mean_interval(given, getattr(nominal, name)) for name, given in task.randomize.items()}
    return ranges | {PUSH_FORCE: task.pushes.force_range(robot.weight) if task.pushes.enabled else (0.0, 0.0)}


def episode_duration(task: TaskConfig) -> float:
    """How long an episode of a task lasts in the nominal world [s]."""
    return task.max_steps * float(task.nominal(RobotDescription.load(task.robot)).control_step[0])


def run_sensitivity(
    policy: Policy,
    task: TaskConfig,
    make_world: SimulationFactory,
    *,
    ranges: Ranges,
    push_force: tuple[float, float] | None = None,
    policy_name: str = "",
    values: int = 10,
    episodes: int = 8,
    duration: float | None = None,
    seed: int = 1,
    threads: int = 0,
    pushes: bool = False,
    robots: int = 0,
    progress: Progress | None = None,
) -> Sensitivity:
    """Run a policy in every test world, and in the nominal one, side by side.

    Episodes last the same time in all worlds, not the same number of control steps: else the returns of the row
    `control_step` would tell how long episodes are. Each ends with the whole number of control steps that is nearest
    to the duration, or with a fall. Episode i starts alike and is pushed alike in every world, so that what differs
    between two worlds is the worlds' doing; in the nominal world it is episode i of `run_episodes`.

    Args:
        policy: gives the feedback.
        task: what is run; its own physical parameters are the nominal ones.
        make_world: makes the simulation.
        ranges: the parameters to vary and their ranges.
        push_force: least and greatest force [N] of a further row, `push_force`: in each of its worlds every push has
            one force. All directions are horizontal then.
        policy_name: for the results.
        values: evenly spaced values in each range.
        episodes: episodes in each world.
        duration: length of an episode [s]; `task.max_steps` nominal control steps, if not given.
        seed: the one seed.
        threads: threads of the simulation; 0 means one a core.
        pushes: whether the base is pushed, as the task says how, every push in full.
        robots: most robots side by side, for engines that take much memory for each; 0 means all. The result does not
            depend on it.
        progress: is told the share of the control steps that is done; an episode that ends early is done.

    Raises:
        SurefootError: a number that does not fit, or ranges outside what the robot allows.
    """
    at_least("episodes", episodes, 1)
    at_least("seed", seed, 0)
    duration = episode_duration(task) if duration is None else duration
    if not 0 < duration < math.inf:
        raise SurefootError(f"duration is {duration:g} s; it must be over 0")
    robot = RobotDescription.load(task.robot)
    check_ranges(ranges, robot)
    worlds = make_test_worlds(ranges, task.nominal(robot), values, push_force)
    others = task.pushes.force_range(robot.weight) if pushes else (0.0, 0.0)
    task = replace(
        task,
        randomize={},
        pushes=task.pushes.in_full(pushes, push_force),
        # Every robot ends by its own number of control steps, which the environment knows nothing about.
        max_steps=MOST_STEPS,
    )
    batch = max(robots // episodes - 1, 1) if robots else len(worlds)
    parts: list[Runs] = []
    for first in range(0, len(worlds), batch):
        chosen = worlds[first : first + batch]
        count, make = (1 + len(chosen)) * episodes, _in_worlds(make_world, chosen, episodes)
        env = LocomotionEnv(task, count, make, seed, autoreset=False, threads=threads)
        _share_streams(env, episodes)
        if push_force is not None:
            env.pusher.range[:] = others
            for number, world in enumerate(chosen, start=1):
                if world.row == PUSH_FORCE:
                    env.pusher.range[number * episodes : (number + 1) * episodes] = world.value
        steps = np.maximum(np.round(duration / env.world.params.control_step), 1).astype(np.int64)
        if first:
            steps[:episodes] = 0  # the nominal world has been run

        def act(observation: NDArray[np.float32], env: LocomotionEnv = env) -> Array:
            # Only robots that go on are asked about: control steps differ, and so do their numbers.
            going, feedback = ~env.over, env.feedback.copy()
            feedback[going] = policy.feedback(observation[going])
            return env.gait.action(feedback)

        def show(share: float, first: int = first, tried: int = len(chosen)) -> None:
            if progress is not None:
                progress((first + share * tried) / len(worlds))

        parts.append(run_to_end(act, env, env.reset()[0], steps, show))
    # A diverged simulation counts as a fall: the policy has brought the robot where nothing holds.
    returns, fell, speed = (
        np.concatenate([part[episodes if n else 0 :] for n, part in enumerate(column)]).reshape(-1, episodes)
        for column in zip(*((part.returns, ~part.balanced, part.speed) for part in parts), strict=True)
    )
    rows = {name: float(np.mean(getattr(env.nominal, name)[0])) for name in ranges}
    if push_force is not None:
        rows[PUSH_FORCE] = float(np.mean(others))
    nominal = Nominal(rows, returns[0], fell[0], speed[0])
    return Sensitivity(policy_name, worlds, returns[1:], fell[1:], speed[1:], nominal)


def _in_worlds(make_world: SimulationFactory, worlds: Sequence[TestWorld], episodes: int) -> SimulationFactory:
    """What makes a simulation of which the first `episodes` robots are nominal, the next in the first world, ..."""

    def make(
        robot: RobotDescription, num_envs: int, nominal: PhysicalParams, seed: int, config: WorldConfig
    ) -> Simulation:
        params = nominal.rows(np.arange(num_envs))
        for number, world in enumerate(worlds, start=1):
            rows = slice(number * episodes, (number + 1) * episodes)
            if world.row != PUSH_FORCE:
                getattr(params, world.row)[rows] = np.clip(world.values, *robot.allowed[world.row])
        return make_world(robot, num_envs, params, seed, config)

    return make


def _share_streams(env: LocomotionEnv, episodes: int) -> None:
    """Let episode i draw the same random numbers in every world: those of the i-th robot."""
    state, robots = env.get_state(), env.num_envs

    def shared(streams: list[object]) -> list[object]:
        return [streams[first + i % episodes] for first in range(0, len(streams), robots) for i in range(robots)]

    state["world"]["streams"] = shared(state["world"]["streams"])
    state["push_streams"] = shared(state["push_streams"])
    env.set_state(state)


@dataclass(frozen=True)
class Break:
    """Where a gait stops to hold, going from a row's nominal value to one end of its range.

    A gait breaks in a world in which it falls in half of the episodes or more, or in which its mean return is below
    half of the nominal one (if that is over 0).
    """

    row: str
    """Row of the table."""
    value: float
    """Value nearest to the nominal one in whose world the gait breaks."""
    above: bool
    """Whether the value is over the nominal one."""
    fraction: float
    """How far from the nominal value, over 0, to the end of the range on this side, 1."""
    falls: int
    """Episodes in which the robot falls there."""
    mean_return: float
    """Mean return there [m]."""
    beyond: int
    """Values that were tried beyond."""
    broken_beyond: int
    """At how many of these the gait breaks too."""


def find_breaks(sensitivity: Sensitivity) -> list[Break]:
    """Where the gait breaks, up to two a row (below and above its nominal value), the nearest to nominal first."""
    means, nominal = sensitivity.mean_return, sensitivity.nominal.mean_return
    broken = sensitivity.fell.mean(axis=1) >= 0.5
    if nominal > 0:
        broken |= means < 0.5 * nominal
    found = []
    for row in sensitivity.rows:
        rows, values = sensitivity.of_row(row), sensitivity.values_of(row)
        centre = sensitivity.nominal.values.get(row, float(values.mean()))
        for above in (True, False):
            distance = values - centre if above else centre - values
            # A value that is the nominal one but for rounding belongs to neither side.
            side = np.flatnonzero(distance > 1e-9 * max(np.ptp(values), abs(centre)))
            side = side[np.argsort(distance[side])]
            bad = broken[rows[side]]
            if not bad.any():
                continue
            first = int(np.argmax(bad))
            world = rows[side[first]]
            found.append(
                Break(
                    row=row,
                    value=float(values[side[first]]),
                    above=above,
                    fraction=float(distance[side[first]] / distance[side[-1]]),
                    falls=int(sensitivity.fell[world].sum()),
                    mean_return=float(means[world]),
                    beyond=len(side) - first - 1,
                    broken_beyond=int(bad[first + 1 :].sum()),
                )
            )
    # Equal fractions differ in their last digits; rounded, they keep the order of the table.
    return sorted(found, key=lambda item: round(item.fraction, 9))
