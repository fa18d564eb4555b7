"""Sensitivity of a policy to physical parameters: runs in test worlds in which one parameter is not nominal.

After Tan et al. 2018, section VI-B: each parameter of table I takes evenly spaced values within its range while all
others stay nominal. Mean and standard deviation of the return over all these test worlds measure a policy's
robustness.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import episode_duration
from surefoot.evaluation.rollout import Controller, Progress, run_to_end
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.robot.randomization import ParamRange, Ranges, mean_interval, resolve_range
from surefoot.tables import plain_value
from surefoot.task.config import MAX_STEPS, TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.pushes import Pusher
from surefoot.world.interface import Simulation, SimulationFactory, WorldConfig

TestWorlds = Sequence[tuple[str, float, tuple[float, ...]]]
"""Test worlds: name of the parameter or `push_force`, its (mean) value, and its values for each motor or axis."""
PUSH_FORCE = "push_force"
"""Name of the row that varies the force of pushes [N]."""
NOMINAL = "nominal"
"""Row name of episodes in the nominal world, which is not a test world."""


@dataclass(frozen=True)
class Sensitivity:
    """Results of one policy in its test worlds and in the nominal one."""

    policy: str
    nominal_values: Mapping[str, float]
    """Nominal value of each row of the table of ranges; the mean if motors or axes differ."""
    episodes: pd.DataFrame
    """One row per episode: row of the table of ranges, unit, value, run, return [m], speed [m/s], whether the robot
    fell or the simulation diverged. Episodes in the nominal world come first, then the test worlds, by increasing
    value within each row of the table."""

    @property
    def nominal(self) -> pd.DataFrame:
        """Episodes in the nominal world."""
        return self.episodes[self.episodes.row == NOMINAL]

    @property
    def tests(self) -> pd.DataFrame:
        """Episodes in the test worlds."""
        return self.episodes[self.episodes.row != NOMINAL]

    @cached_property
    def worlds(self) -> pd.DataFrame:
        """One row per test world: row, unit, value, episodes, return [m] with its error, mean speed [m/s], falls."""
        groups = self.tests.groupby(["row", "unit", "value"], sort=False)
        columns = {
            "episodes": ("run", "size"),
            "return_mean": ("return", pd.Series.mean),
            "return_error": ("return", pd.Series.sem),
            "return_std": ("return", pd.Series.std),
            "speed_mean": ("speed", pd.Series.mean),
            "falls": ("fell", "sum"),
        }
        return groups.agg(**columns).reset_index()

    def unit(self, row: str) -> str:
        """Return the unit of a row's values; empty for ratios."""
        return str(self.tests.unit[self.tests.row == row].iloc[0])

    def of_row(self, row: str) -> pd.DataFrame:
        """Return the test worlds of a row, by increasing value."""
        return self.worlds[self.worlds.row == row]

    @property
    def rows(self) -> tuple[str, ...]:
        """Rows of the table of ranges that were varied, in its order."""
        return tuple(self.tests.row.unique())

    @property
    def mean(self) -> float:
        """Mean of the test worlds' mean returns [m], the paper's measure of performance."""
        return float(self.worlds.return_mean.mean())

    @property
    def std(self) -> float:
        """Standard deviation of the test worlds' mean returns [m], the paper's measure of robustness."""
        return float(self.worlds.return_mean.std())

    @property
    def fall_rate(self) -> float:
        """Fraction of the episodes in test worlds that ended in a fall."""
        return float(self.tests.fell.mean())

    def to_mapping(self) -> dict[str, Any]:
        """Return the results for JSON, without the policy's name."""
        columns = self.episodes.to_dict("list")
        columns["value"] = list(map(plain_value, columns["value"]))
        return {"nominal_values": dict(self.nominal_values), "episodes": columns}

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any], policy: str) -> Sensitivity:
        """Return the results from the output of `to_mapping` and the policy's name."""
        return cls(policy, data["nominal_values"], pd.DataFrame(data["episodes"]))


def make_test_worlds(
    ranges: Mapping[str, ParamRange],
    nominal: PhysicalParams,
    values: int = 10,
    push_force: tuple[float, float] | None = None,
) -> TestWorlds:
    """Return the test worlds for ranges of parameters and, optionally, of the push force [N].

    Each row has `values` (two or more) evenly spaced values in its range, including both ends; one if the range is a
    single value.
    """
    rows = {name: resolve_range(bounds, getattr(nominal, name)[:1]) for name, bounds in ranges.items()}
    if push_force is not None:
        rows[PUSH_FORCE] = np.array(push_force[:1]), np.array(push_force[1:])
    if not rows:
        raise SurefootError("the table of ranges is empty; a sensitivity study needs 1 range or more, as table1's")
    return [
        (row, float(value.flat[0] if np.ptp(value) == 0 else value.mean()), tuple(value.flat))
        for row, (low, high) in rows.items()
        for value in np.linspace(low, high, values if (high > low).any() else 1)
    ]


def row_unit(row: str, robot: RobotDescription) -> str:
    """Return the unit of a row's values for a robot; empty for ratios."""
    if row == PUSH_FORCE:
        return "N"
    unit = PARAMETERS[row].unit_for(robot)
    return "" if unit == "1" else unit


def trained_ranges(task: TaskConfig) -> dict[str, tuple[float, float]]:
    """Return the ranges of a task's training, by row."""
    robot = RobotDescription.load(task.robot)
    nominal = task.nominal(robot)
    ranges = {name: mean_interval(interval, getattr(nominal, name)) for name, interval in task.randomize.items()}
    return ranges | {PUSH_FORCE: task.pushes.force_range(robot.weight) if task.pushes.enabled else (0.0, 0.0)}


def run_sensitivity(
    policy: Controller,
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
    """Run a policy in every test world and in the nominal world, in parallel.

    Episodes have the same duration in all worlds, not the same number of control steps: otherwise the returns of the
    row `control_step` would measure the episodes' length. Each ends after the number of control steps nearest to the
    duration, or with a fall. Episode i has the same start and pushes in every world, so that differences between
    worlds are caused by their parameters; in the nominal world it equals episode i of `run_episodes`.

    Args:
        policy: computes the feedback.
        task: the task; its physical parameters are the nominal ones.
        make_world: creates the simulation.
        ranges: parameters to vary, and their ranges within the robot's bounds.
        push_force: minimum and maximum force [N] of an additional row, `push_force`: each of its worlds has one force
            for all pushes. All pushes are then horizontal.
        policy_name: name of the policy in the results.
        values: number of evenly spaced values in each range.
        episodes: episodes in each world.
        duration: length of an episode [s]; defaults to `task.max_steps` nominal control steps.
        seed: seed of all random numbers.
        threads: threads of the simulation; 0 means one per core.
        pushes: whether to push the base, with the task's settings at full force.
        robots: maximum number of parallel robots, for engines that need much memory for each; 0 means no limit. The
            result does not depend on it.
        progress: called with the completed fraction of the control steps; an episode that ends early is complete.

    Raises:
        SurefootError: `ranges` is empty and `push_force` is not set.
    """
    duration = episode_duration(task) if duration is None else duration
    robot = RobotDescription.load(task.robot)
    worlds = make_test_worlds(ranges, task.nominal(robot), values, push_force)
    other_force = task.pushes.force_range(robot.weight) if pushes else (0.0, 0.0)
    # The environment's limit of control steps is never reached: `run_to_end` has one for each robot.
    pushes_config = task.pushes.for_evaluation(pushes, push_force)
    task = replace(task, randomize={}, pushes=pushes_config, max_steps=MAX_STEPS)
    batch = max(robots // episodes - 1, 1) if robots else len(worlds)
    parts: list[pd.DataFrame] = []
    for first in range(0, len(worlds), batch):
        chosen = worlds[first : first + batch]
        count, make = (1 + len(chosen)) * episodes, _in_worlds(make_world, chosen, episodes)
        env = LocomotionEnv(task, count, make, seed, autoreset=False, threads=threads)
        _share_streams(env, episodes)
        if push_force is not None:
            pusher = env.component(Pusher)
            pusher.range[:] = other_force
            for number, (row, value, _) in enumerate(chosen, start=1):
                if row == PUSH_FORCE:
                    pusher.range[number * episodes : (number + 1) * episodes] = value
        steps = np.maximum(np.round(duration / env.world.params.control_step), 1).astype(np.int64)
        if first:
            steps[:episodes] = 0  # the nominal world has been run

        def act(observation: NDArray[np.float32], env: LocomotionEnv = env) -> Array:
            # Only unfinished robots have observations: their numbers of control steps differ.
            active, feedback = ~env.state.over, env.state.feedback.copy()
            feedback[active] = policy.feedback(observation[active])
            return env.gait.action(feedback)

        def report(fraction: float, first: int = first, count: int = len(chosen)) -> None:
            if progress is not None:
                progress((first + fraction * count) / len(worlds))

        parts.append(run_to_end(act, env, env.reset()[0], steps, report)[episodes if first else 0 :])
    runs = pd.concat(parts, ignore_index=True)
    places = [(NOMINAL, "", np.nan), *((row, row_unit(row, robot), value) for row, value, _ in worlds)]
    table = pd.DataFrame([place for place in places for _ in range(episodes)], columns=["row", "unit", "value"])
    # A diverged simulation counts as a fall: the policy drove the robot to a state in which the model is not valid.
    results = {"return": runs["return"], "speed": runs.speed, "fell": ~runs.balanced}
    table = table.assign(run=np.tile(np.arange(episodes), len(places)), **results)
    nominal = {name: float(np.mean(getattr(env.nominal, name)[0])) for name in ranges}
    if push_force is not None:
        nominal[PUSH_FORCE] = float(np.mean(other_force))
    return Sensitivity(policy_name, nominal, table)


def _in_worlds(make_world: SimulationFactory, worlds: TestWorlds, episodes: int) -> SimulationFactory:
    """Return a factory of simulations with a block of `episodes` robots for each world, the nominal one first."""

    def make(
        robot: RobotDescription, num_envs: int, nominal: PhysicalParams, seed: int, config: WorldConfig
    ) -> Simulation:
        params = nominal.rows(np.arange(num_envs))
        for number, (row, _, columns) in enumerate(worlds, start=1):
            if row != PUSH_FORCE:
                robots = slice(number * episodes, (number + 1) * episodes)
                getattr(params, row)[robots] = np.clip(columns, *robot.allowed[row])
        return make_world(robot, num_envs, params, seed, config)

    return make


def _share_streams(env: LocomotionEnv, episodes: int) -> None:
    """Give episode i of every world the random streams of robot i."""
    state, robots = env.get_state(), env.num_envs

    def shared(streams: list[object]) -> list[object]:
        return [streams[first + i % episodes] for first in range(0, len(streams), robots) for i in range(robots)]

    state["world"]["streams"] = shared(state["world"]["streams"])
    for name in [name for name in state if name.endswith("_streams")]:
        state[name] = shared(state[name])
    env.set_state(state)


def find_gait_limits(sensitivity: Sensitivity) -> pd.DataFrame:
    """Find the values at which a gait fails first, from each row's nominal value towards both ends of its range.

    A gait fails in a world in which at least half of the episodes end in a fall, or in which the mean return is below
    half of the nominal return (if that is positive).

    Returns:
        One row per failure, the nearest to nominal first: row of the table of ranges, value of the first failure,
        whether it is above nominal, its distance from nominal relative to the end of the range (`fraction`), falls and
        mean return [m] there, the number of test worlds beyond it, and the number of these in which the gait fails.
    """
    worlds, nominal = sensitivity.worlds, sensitivity.nominal["return"].mean()
    broken = worlds.falls >= worlds.episodes / 2
    if nominal > 0:
        broken |= worlds.return_mean < 0.5 * nominal
    breaks = []
    for row, tests in worlds.assign(broken=broken).groupby("row", sort=False):
        centre = sensitivity.nominal_values[row]
        for above in (True, False):
            distance = tests.value - centre if above else centre - tests.value
            # A value that equals the nominal one up to rounding is on neither side.
            differs = distance > 1e-9 * max(np.ptp(tests.value), abs(centre))
            side = tests.assign(distance=distance)[differs].sort_values("distance")
            first = int(side.broken.to_numpy().argmax()) if side.broken.any() else len(side)
            for world in side[first : first + 1].itertuples():
                fraction = world.distance / side.distance.iloc[-1]
                beyond = len(side) - first - 1, int(side.broken[first + 1 :].sum())
                breaks.append((row, world.value, above, fraction, world.falls, world.return_mean, *beyond))
    # Equal fractions may differ in their last digits; rounding keeps the order of the table.
    columns = ["row", "value", "above", "fraction", "falls", "mean_return", "beyond", "broken_beyond"]
    return pd.DataFrame(sorted(breaks, key=lambda one: round(one[3], 9)), columns=columns)
