"""The evaluations that a study's policies go through, the figures that they come to, and their results on disk."""

from __future__ import annotations

import functools
import hashlib
import json
import operator
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surefoot import __version__
from surefoot.configuration import to_mapping
from surefoot.errors import SurefootError, choices
from surefoot.evaluate.footfalls import analyze_footfalls
from surefoot.evaluate.gap import PolicyGap, away_task, home_task
from surefoot.evaluate.recorded import save_runs
from surefoot.evaluate.rollout import run_episodes
from surefoot.evaluate.runs import Runs, summarize
from surefoot.evaluate.sensitivity import Sensitivity, run_sensitivity
from surefoot.files import whole_file
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.randomization import load_ranges
from surefoot.tables import plain_value
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.trace import EpisodeTrace
from surefoot.world.ensemble import ROBOTS
from surefoot.world.interface import SimulationFactory

SEED = 1
GAP_SEED = 2
"""Another one: the runs that tell a gap are not those that policies are chosen by, and owe nothing to the choice."""
Result = dict[str, Any]
"""What an evaluation came to, as JSON holds it."""
Traces = dict[str, list[EpisodeTrace]]
"""Episodes that are worth keeping, by the name of their world."""
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

    @property
    def heading(self) -> str:
        """Title and unit, as the head of a column."""
        return f"{self.title} ({self.unit})"


@dataclass(frozen=True)
class EvaluationKind:
    """A kind of evaluation of a policy."""

    what: str
    """What is done, in words."""
    settings: dict[str, Any]
    """All that the result depends on besides the policy."""
    run: Callable[[PolicyRuntime, TaskConfig, FindWorld, dict[str, Any], int], tuple[Result, Traces]]
    """Does it, with some number of threads."""
    figures: tuple[Figure, ...]
    """The numbers that policies are compared by."""

    @property
    def world_names(self) -> tuple[str, ...]:
        """Names of the worlds that it takes."""
        return tuple(self.settings[key] for key in ("world", "home", "away") if key in self.settings)


def _episodes(
    policy: PolicyRuntime, task: TaskConfig, find_world: FindWorld, settings: dict[str, Any], threads: int
) -> tuple[Result, Traces]:
    """Run whole episodes without pushes, each with parameters drawn from a table of ranges.

    Actuator and nominal parameters are those of the policy's task: a policy is at home in the simulator that it was
    trained in.
    """
    task = replace(home_task(task), randomize=load_ranges(settings["ranges"], robot=task.robot))
    traces = _run(policy, task, find_world, settings["world"], settings, threads)
    runs = Runs.of_traces(traces)
    summary = summarize(traces, RobotDescription.load(task.robot).urdf.total_mass)
    # A diverged simulation counts as a fall: the policy has brought the robot where nothing holds.
    columns = {"returns": runs.returns, "speed": runs.speed, "fell": ~runs.balanced}
    return {"summary": summary, **{name: column.tolist() for name, column in columns.items()}}, {}


def _sensitivity(
    policy: PolicyRuntime, task: TaskConfig, find_world: FindWorld, settings: dict[str, Any], threads: int
) -> tuple[Result, Traces]:
    """Run test worlds that differ from the nominal one in one parameter."""
    options = {name: settings[name] for name in ("values", "episodes", "seed")}
    ranges = load_ranges(settings["ranges"], robot=task.robot)
    found = run_sensitivity(policy, task, find_world(settings["world"]), ranges=ranges, threads=threads, **options)
    return found.to_mapping(), {}


def _gap(
    policy: PolicyRuntime, task: TaskConfig, find_world: FindWorld, settings: dict[str, Any], threads: int
) -> tuple[Result, Traces]:
    """Run some episodes at home, and as many in another world, one on each of its robots.

    As many again in the engine of home, with the robot as its data sheet describes it, tell what motors and delays
    take before anything else does.
    """
    home, away = settings["home"], settings["away"]
    parts = {"home": (home_task(task), home, home), "described": (away_task(task), home, f"{home}-described")}
    parts["away"] = (away_task(task), away, away)
    traces = {name: _run(policy, given, find_world, world, settings, threads) for given, world, name in parts.values()}
    return {part: Runs.of_traces(traces[name], name).to_mapping() for part, (_, _, name) in parts.items()}, traces


def _run(
    policy: PolicyRuntime, task: TaskConfig, find_world: FindWorld, world: str, settings: dict[str, Any], threads: int
) -> list[EpisodeTrace]:
    episodes, seed, name = settings["episodes"], settings["seed"], policy.contract.name
    return run_episodes(policy, task, episodes, find_world(world), seed, threads, world_name=world, policy_name=name)


def _gaits(
    policy: PolicyRuntime, task: TaskConfig, find_world: FindWorld, settings: dict[str, Any], threads: int
) -> tuple[Result, Traces]:
    """Name the gait of some episodes at home; the first one with the name that most of them have is kept."""
    traces = _run(policy, home_task(task), find_world, settings["world"], settings, threads)
    feet = [analyze_footfalls(trace) for trace in traces]
    gait = Counter(found.gait for found in feet).most_common(1)[0][0]
    index = next(i for i, found in enumerate(feet) if found.gait == gait)
    said = {name: getattr(feet[index], name) for name in ("pattern", "reason")}
    numbers = {"stride": feet[index].stride_period, "duty": float(np.mean(list(feet[index].duty_factor.values())))}
    plain = {name: plain_value(value) for name, value in numbers.items()}
    result = {"gait": gait, "agree": sum(found.gait == gait for found in feet), **said, **plain}
    return result, {settings["world"]: [traces[index]]}


def gait_trace(policy: Path) -> EpisodeTrace:
    """Return the episode that the evaluation `gait` of a policy file kept."""
    world = EVALUATIONS["gait"].settings["world"]
    return EpisodeTrace.load(next((_result_path(policy, "gait").with_suffix("") / world).glob("*.npz")))


def gap_of(result: Result, name: str) -> PolicyGap:
    """Return the runs of a result at home, away and, last, in home's engine with the robot as described."""
    home, away, described = (Runs.from_mapping(result[part]) for part in ("home", "away", "described"))
    return PolicyGap(name, home, (away, described))


def _mean(*keys: str, factor: float = 1.0) -> Callable[[Result], float]:
    """Return what reads the mean of a column, which lies at the end of some keys."""

    def read(result: Any) -> float:
        return factor * float(np.mean(functools.reduce(operator.getitem, keys, result)))

    return read


def _over_worlds(name: str) -> Callable[[Result], float]:
    """Return what reads an aggregate of a sensitivity."""
    return lambda result: float(getattr(Sensitivity.from_mapping(result, ""), name))


def _gap_mean(result: Result) -> float:
    return float(np.mean(result["home"]["returns"]) - np.mean(result["away"]["returns"]))


_FALLS = _mean("fell", factor=100.0)
EVALUATIONS: dict[str, EvaluationKind] = {
    "nominal": EvaluationKind(
        "20 episodes in the nominal world of the policy's own simulator, without pushes",
        {"world": "mujoco", "episodes": 20, "seed": SEED, "ranges": "none"},
        _episodes,
        (
            Figure("nominal_speed", "speed, nominal", "m/s", 3, _mean("speed")),
            Figure("nominal_return", "return, nominal", "m", 2, _mean("returns")),
            Figure("nominal_falls", "falls, nominal", "%", 1, _FALLS),
        ),
    ),
    "table1": EvaluationKind(
        "100 episodes with every parameter of table I drawn at random, without pushes",
        {"world": "mujoco", "episodes": 100, "seed": SEED, "ranges": "table1"},
        _episodes,
        (
            Figure("table1_speed", "speed, table I drawn", "m/s", 3, _mean("speed")),
            Figure("table1_falls", "falls, table I drawn", "%", 1, _FALLS),
        ),
    ),
    "sensitivity": EvaluationKind(
        "test worlds: one parameter of table I at a time takes 10 values, all else nominal; 4 episodes in each",
        {"world": "mujoco", "values": 10, "episodes": 4, "seed": SEED, "ranges": "table1"},
        _sensitivity,
        (
            Figure("sensitivity_mean", "mean return over test worlds", "m", 2, _over_worlds("mean")),
            Figure("sensitivity_std", "standard deviation of return over test worlds", "m", 2, _over_worlds("std")),
            Figure("sensitivity_falls", "falls in test worlds", "%", 1, _FALLS),
        ),
    ),
    "gap": EvaluationKind(
        f"a run on each of the ensemble's {ROBOTS} robots in Bullet, and as many in the policy's own simulator and "
        "there with the robot of the data sheet; none with pushes, each from a start of its own",
        {"home": "mujoco", "away": "ensemble", "described": True, "episodes": ROBOTS, "seed": GAP_SEED},
        _gap,
        (
            Figure("gap_home", "return at home", "m", 2, _mean("home", "returns")),
            Figure("gap_described", "return at home as described", "m", 2, _mean("described", "returns")),
            Figure("gap_away", "return away", "m", 2, _mean("away", "returns")),
            Figure("gap", "gap", "m", 2, _gap_mean),
            Figure("gap_balanced", "balanced away", "%", 1, _mean("away", "balanced", factor=100.0)),
            Figure("gap_distance", "distance away", "m", 2, _mean("away", "distance")),
            Figure("gap_speed", "speed away", "m/s", 3, _mean("away", "speed")),
            Figure("gap_power", "power away", "W", 1, _mean("away", "power")),
        ),
    ),
    "gait": EvaluationKind(
        "names of the gait in 5 episodes in the nominal world of the policy's own simulator, without pushes",
        {"world": "mujoco", "episodes": 5, "seed": SEED},
        _gaits,
        (Figure("gait_agree", "episodes with the same gait", "of 5", 0, lambda result: float(result["agree"])),),
    ),
}
"""Evaluations by name; the first one is part of every study."""


def evaluation_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return the evaluations that a study has, the one that every study has first; refuse unknown names."""
    for name in names:
        if name not in EVALUATIONS:
            raise SurefootError(f"evaluate: '{name}' is no kind of evaluation; choices: {choices(EVALUATIONS)}")
    return tuple(dict.fromkeys(("nominal", *names)))


def stored_result(policy: Path, name: str) -> Result | None:
    """Return the stored result of an evaluation of a policy file as it is now; None if there is none that holds."""
    return _stored(policy, name, _identity(policy, _settings(name)))


def evaluate(policy: Path, name: str, find_world: FindWorld, threads: int = 0) -> Result:
    """Make the evaluation of a name of a policy file, or return the stored result.

    A new one is stored in `evaluations/` beside the file. Traces that the evaluation finds worth keeping go to
    `evaluations/NAME/WORLD/run_000.npz` and on. The evaluation's settings say which worlds it takes.
    """

    def make() -> Result:
        runtime, what = PolicyRuntime.load(policy), EVALUATIONS[name]
        result, kept = what.run(runtime, task_from_contract(runtime.contract), find_world, what.settings, threads)
        # Before the result: where that is, traces are.
        for world, traces in kept.items():
            save_runs(_result_path(policy, name).with_suffix("") / world, traces)
        return result

    return made_once(policy, name, _settings(name), make)


def made_once(policy: Path, name: str, settings: dict[str, Any], make: Callable[[], Result]) -> Result:
    """Make a result of a policy file, or return the one that is stored in `evaluations/` beside it.

    Args:
        policy: the policy file.
        name: of the result.
        settings: all that the result depends on besides the policy and the version of surefoot.
        make: makes the result, if that of the file as it is now is not there.
    """
    of = _identity(policy, settings)
    found = _stored(policy, name, of)
    if found is not None:
        return found
    result, path = make(), _result_path(policy, name)
    path.parent.mkdir(exist_ok=True)
    with whole_file(path) as file:
        file.write(json.dumps({"of": of, "result": result}).encode() + b"\n")
    return result


def _stored(policy: Path, name: str, of: dict[str, Any]) -> Result | None:
    try:
        record = json.loads(_result_path(policy, name).read_text(encoding="utf-8"))
        return record["result"] if record["of"] == of else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _result_path(policy: Path, name: str) -> Path:
    return policy.parent / "evaluations" / f"{name}.json"


def _settings(name: str) -> dict[str, Any]:
    """Return everything that decides what an evaluation does with a policy."""
    settings = dict(EVALUATIONS[name].settings)
    if "ranges" in settings:
        settings["ranges"] = to_mapping(load_ranges(settings["ranges"]))
    return settings


def _identity(policy: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Return what a result belongs to: the policy file and everything that decides what is done with it."""
    return {"surefoot": __version__, "policy": hashlib.sha256(policy.read_bytes()).hexdigest(), **settings}
