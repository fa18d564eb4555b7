"""Kinds of evaluation that a study's policies go through, and the numbers that they come to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from surefoot.errors import SurefootError, choices
from surefoot.evaluate.ensemble import ROBOTS
from surefoot.evaluate.gap import PolicyGap, Runs, away_task, home_task
from surefoot.evaluate.metrics import episode_metrics, summarize
from surefoot.evaluate.rollout import run_episodes
from surefoot.evaluate.sensitivity import Nominal, Sensitivity, TestWorld, run_sensitivity
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig
from surefoot.task.randomize import load_ranges
from surefoot.task.trace import EpisodeTrace
from surefoot.world.interface import SimulationFactory

SEED = 1
GAP_SEED = 2
"""Another one: the runs that tell a gap are not those that policies are chosen by, and owe nothing to the choice."""
Result = dict[str, Any]
FindWorld = Callable[[str], SimulationFactory]
"""What makes worlds of a name."""


@dataclass(frozen=True)
class Figure:
    """A number that an evaluation comes to."""

    name: str
    """Its column in tables of results."""
    title: str
    """What it is, in words."""
    unit: str
    """Its unit; empty for a bare number."""
    digits: int
    """Behind the point."""
    read: Callable[[Result], float]
    """Reads it from the evaluation's result."""


@dataclass(frozen=True)
class Evaluated:
    """What an evaluation came to."""

    result: Result
    """A table that JSON can hold."""
    traces: dict[str, list[EpisodeTrace]] = field(default_factory=dict)
    """Episodes that are worth keeping, by the name of their world."""


@dataclass(frozen=True)
class Kind:
    """A kind of evaluation."""

    what: str
    """What is done, in words."""
    settings: dict[str, Any]
    """All that the result depends on besides the policy."""
    worlds: tuple[str, ...]
    """Keys of the settings that name a world."""
    run: Callable[[PolicyRuntime, TaskConfig, FindWorld, dict[str, Any], int], Evaluated]
    """Does it, with some number of threads."""
    figures: tuple[Figure, ...]
    """The numbers that policies are compared by."""

    @property
    def world_names(self) -> tuple[str, ...]:
        """Names of the worlds that it takes."""
        return tuple(self.settings[key] for key in self.worlds)


def _episodes(
    policy: PolicyRuntime, task: TaskConfig, find_world: FindWorld, settings: dict[str, Any], threads: int
) -> Evaluated:
    """Whole episodes without pushes, each with parameters drawn from a table of ranges.

    Actuator and nominal parameters are those of the policy's task: a policy is at home in the simulator that it was
    trained in.
    """
    ranges, world = load_ranges(settings["ranges"]), settings["world"]
    task = replace(home_task(task), randomize=ranges)
    traces = _run(policy, task, find_world, world, settings, threads)
    metrics = [episode_metrics(trace) for trace in traces]
    return Evaluated(
        {
            "summary": summarize(traces, RobotDescription.load(task.robot).urdf.total_mass),
            "returns": [one.return_ for one in metrics],
            "speed": [one.speed for one in metrics],
            # A diverged simulation counts as a fall: the policy has brought the robot where nothing holds.
            "fell": [trace.meta["ended"] != "time" for trace in traces],
        }
    )


def _sensitivity(
    policy: PolicyRuntime, task: TaskConfig, find_world: FindWorld, settings: dict[str, Any], threads: int
) -> Evaluated:
    """Test worlds that differ from the nominal one in one parameter."""
    found = run_sensitivity(
        policy,
        task,
        find_world(settings["world"]),
        policy_name=policy.contract.name,
        ranges=load_ranges(settings["ranges"]),
        values=settings["values"],
        episodes=settings["episodes"],
        seed=settings["seed"],
        threads=threads,
    )
    parts = {name: getattr(found, name).tolist() for name in ("returns", "fell", "speed")}
    nominal = {name: getattr(found.nominal, name).tolist() for name in ("returns", "fell", "speed")}
    worlds = [[world.row, world.value] for world in found.worlds]
    return Evaluated({"worlds": worlds, **parts, "nominal": {"values": dict(found.nominal.values), **nominal}})


def _gap(
    policy: PolicyRuntime, task: TaskConfig, find_world: FindWorld, settings: dict[str, Any], threads: int
) -> Evaluated:
    """Some runs at home, and as many in another world, one on each of its robots.

    As many again in the engine of home, with the robot as its data sheet describes it, tell what motors and delays
    take before anything else does.
    """
    home, away = settings["home"], settings["away"]
    parts = {
        "home": _run(policy, home_task(task), find_world, home, settings, threads),
        "described": _run(policy, away_task(task), find_world, home, settings, threads),
        "away": _run(policy, away_task(task), find_world, away, settings, threads),
    }
    folders = {"home": home, "described": f"{home}-described", "away": away}
    result = {part: Runs.of_traces(traces, folders[part]).to_mapping() for part, traces in parts.items()}
    return Evaluated(result, {folders[part]: traces for part, traces in parts.items()})


def _run(
    policy: PolicyRuntime,
    task: TaskConfig,
    find_world: FindWorld,
    world: str,
    settings: dict[str, Any],
    threads: int,
) -> list[EpisodeTrace]:
    episodes, seed, name = settings["episodes"], settings["seed"], policy.contract.name
    return run_episodes(policy, task, episodes, find_world(world), seed, threads, world_name=world, policy_name=name)


def sensitivity_of(result: Result, name: str) -> Sensitivity:
    """The test worlds of a kept result, under a name of one's choice."""
    nominal = result["nominal"]
    return Sensitivity(
        name,
        tuple(TestWorld(row, value) for row, value in result["worlds"]),
        np.array(result["returns"], np.float64),
        np.array(result["fell"], np.bool_),
        np.array(result["speed"], np.float64),
        Nominal(
            nominal["values"],
            np.array(nominal["returns"], np.float64),
            np.array(nominal["fell"], np.bool_),
            np.array(nominal["speed"], np.float64),
        ),
    )


def gap_of(result: Result, name: str) -> PolicyGap:
    """The runs of a kept result at home, away and, last, in home's engine with the robot as described."""
    away = tuple(Runs.from_mapping(result[part]) for part in ("away", "described"))
    return PolicyGap(name, Runs.from_mapping(result["home"]), away)


def _share_fallen(result: Result) -> float:
    return 100 * float(np.mean(result["fell"]))


def _mean(key: str) -> Callable[[Result], float]:
    return lambda result: float(np.mean(result[key]))


def _over_runs(part: str, key: str, factor: float = 1.0) -> Callable[[Result], float]:
    return lambda result: factor * float(np.mean(result[part][key]))


def _gap_mean(result: Result) -> float:
    return float(np.mean(result["home"]["returns"]) - np.mean(result["away"]["returns"]))


KINDS: dict[str, Kind] = {
    "nominal": Kind(
        "20 episodes in the nominal world of the policy's own simulator, without pushes",
        {"world": "mujoco", "episodes": 20, "seed": SEED, "ranges": "none"},
        ("world",),
        _episodes,
        (
            Figure("nominal_speed", "speed, nominal", "m/s", 3, _mean("speed")),
            Figure("nominal_return", "return, nominal", "m", 2, _mean("returns")),
            Figure("nominal_falls", "falls, nominal", "%", 1, _share_fallen),
        ),
    ),
    "table1": Kind(
        "100 episodes with every parameter of table I drawn at random, without pushes",
        {"world": "mujoco", "episodes": 100, "seed": SEED, "ranges": "table1"},
        ("world",),
        _episodes,
        (
            Figure("table1_speed", "speed, table I drawn", "m/s", 3, _mean("speed")),
            Figure("table1_falls", "falls, table I drawn", "%", 1, _share_fallen),
        ),
    ),
    "sensitivity": Kind(
        "test worlds: one parameter of table I at a time takes 10 values, all else nominal; 4 episodes in each",
        {"world": "mujoco", "values": 10, "episodes": 4, "seed": SEED, "ranges": "table1"},
        ("world",),
        _sensitivity,
        (
            Figure("sensitivity_mean", "mean return over test worlds", "m", 2, lambda r: sensitivity_of(r, "").mean),
            Figure("sensitivity_std", "spread of return over test worlds", "m", 2, lambda r: sensitivity_of(r, "").std),
            Figure("sensitivity_falls", "falls in test worlds", "%", 1, _share_fallen),
        ),
    ),
    "gap": Kind(
        f"a run on each of the ensemble's {ROBOTS} robots in Bullet, and as many in the policy's own simulator and "
        "there with the robot of the data sheet; none with pushes, each from a start of its own",
        {"home": "mujoco", "away": "ensemble", "described": True, "episodes": ROBOTS, "seed": GAP_SEED},
        ("home", "away"),
        _gap,
        (
            Figure("gap_home", "return at home", "m", 2, _over_runs("home", "returns")),
            Figure("gap_described", "return at home as described", "m", 2, _over_runs("described", "returns")),
            Figure("gap_away", "return away", "m", 2, _over_runs("away", "returns")),
            Figure("gap", "gap", "m", 2, _gap_mean),
            Figure("gap_balanced", "balanced away", "%", 1, _over_runs("away", "balanced", 100.0)),
            Figure("gap_distance", "distance away", "m", 2, _over_runs("away", "distance")),
            Figure("gap_speed", "speed away", "m/s", 3, _over_runs("away", "speed")),
            Figure("gap_power", "power away", "W", 1, _over_runs("away", "power")),
        ),
    ),
}
"""Kinds of evaluation, by name."""
ALWAYS = ("nominal",)
"""Kinds that every study has."""


def kinds_of(names: tuple[str, ...]) -> tuple[str, ...]:
    """The kinds of evaluation that a study has, those that every study has first.

    Raises:
        SurefootError: no such kind.
    """
    for name in names:
        if name not in KINDS:
            raise SurefootError(f"evaluate: '{name}' is no kind of evaluation; choices: {choices(KINDS)}")
    return tuple(dict.fromkeys((*ALWAYS, *names)))
