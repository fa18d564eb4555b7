"""Evaluations of a trained policy, kept beside it: each is made once for a policy file and its settings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surefoot import __version__
from surefoot.configuration import to_mapping
from surefoot.errors import SurefootError, choices
from surefoot.evaluate.metrics import episode_metrics, summarize
from surefoot.evaluate.rollout import run_episodes, task_from_contract
from surefoot.evaluate.sensitivity import Nominal, Sensitivity, TestWorld, run_sensitivity
from surefoot.files import whole_file
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig
from surefoot.task.randomize import RandomizeConfig, load_ranges
from surefoot.world.interface import SimulationFactory

SEED = 1
Result = dict[str, Any]


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
class Kind:
    """A kind of evaluation."""

    what: str
    """What is done, in words."""
    settings: dict[str, Any]
    """All that the result depends on besides the policy."""
    run: Callable[[PolicyRuntime, TaskConfig, SimulationFactory, dict[str, Any], int], Result]
    """Makes the result, a table that JSON can hold, with some number of threads."""
    figures: tuple[Figure, ...]
    """The numbers that policies are compared by."""


def _episodes(
    policy: PolicyRuntime, task: TaskConfig, make_world: SimulationFactory, settings: dict[str, Any], threads: int
) -> Result:
    """Whole episodes without pushes, each with parameters drawn from a table of ranges."""
    ranges = load_ranges(settings["ranges"])
    task = replace(task, randomize=ranges, pushes=replace(task.pushes, enabled=False))
    traces = run_episodes(
        policy, task, settings["episodes"], make_world, settings["seed"], threads, policy_name=policy.contract.name
    )
    metrics = [episode_metrics(trace) for trace in traces]
    return {
        "summary": summarize(traces, RobotDescription.load(task.robot).urdf.total_mass),
        "returns": [one.return_ for one in metrics],
        "speed": [one.speed for one in metrics],
        # A diverged simulation counts as a fall: the policy has brought the robot where nothing holds.
        "fell": [trace.meta["ended"] != "time" for trace in traces],
    }


def _sensitivity(
    policy: PolicyRuntime, task: TaskConfig, make_world: SimulationFactory, settings: dict[str, Any], threads: int
) -> Result:
    """Test worlds that differ from the nominal one in one parameter."""
    found = run_sensitivity(
        policy,
        task,
        make_world,
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
    return {"worlds": worlds, **parts, "nominal": {"values": dict(found.nominal.values), **nominal}}


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


def _share_fallen(result: Result) -> float:
    return 100 * float(np.mean(result["fell"]))


def _mean(key: str) -> Callable[[Result], float]:
    return lambda result: float(np.mean(result[key]))


KINDS: dict[str, Kind] = {
    "nominal": Kind(
        "20 episodes in the nominal world, without pushes",
        {"episodes": 20, "seed": SEED, "ranges": "none"},
        _episodes,
        (
            Figure("nominal_speed", "speed, nominal", "m/s", 3, _mean("speed")),
            Figure("nominal_return", "return, nominal", "m", 2, _mean("returns")),
            Figure("nominal_falls", "falls, nominal", "%", 1, _share_fallen),
        ),
    ),
    "table1": Kind(
        "100 episodes with every parameter of table I drawn at random, without pushes",
        {"episodes": 100, "seed": SEED, "ranges": "table1"},
        _episodes,
        (
            Figure("table1_speed", "speed, table I drawn", "m/s", 3, _mean("speed")),
            Figure("table1_falls", "falls, table I drawn", "%", 1, _share_fallen),
        ),
    ),
    "sensitivity": Kind(
        "test worlds: one parameter of table I at a time takes 10 values, all else nominal; 4 episodes in each",
        {"values": 10, "episodes": 4, "seed": SEED, "ranges": "table1"},
        _sensitivity,
        (
            Figure("sensitivity_mean", "mean return over test worlds", "m", 2, lambda r: sensitivity_of(r, "").mean),
            Figure("sensitivity_std", "spread of return over test worlds", "m", 2, lambda r: sensitivity_of(r, "").std),
            Figure("sensitivity_falls", "falls in test worlds", "%", 1, _share_fallen),
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


def kept(policy: Path, kind: str) -> Result | None:
    """The kept result of an evaluation of a policy file as it is now; None if there is none that holds."""
    try:
        record = json.loads(_place(policy, kind).read_text(encoding="utf-8"))
        return record["result"] if record["of"] == _identity(policy, kind) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def evaluate(policy: Path, kind: str, make_world: SimulationFactory, threads: int = 0) -> Result:
    """Evaluate a policy file, or give the kept result; a new one is kept in `evaluations/` beside the file.

    Raises:
        SurefootError: a file that is no policy.
    """
    found = kept(policy, kind)
    if found is not None:
        return found
    runtime, what = PolicyRuntime.load(policy), KINDS[kind]
    result = what.run(runtime, task_from_contract(runtime.contract), make_world, what.settings, threads)
    place = _place(policy, kind)
    place.parent.mkdir(exist_ok=True)
    with whole_file(place) as file:
        file.write(json.dumps({"of": _identity(policy, kind), "result": result}).encode() + b"\n")
    return result


def _place(policy: Path, kind: str) -> Path:
    return policy.parent / "evaluations" / f"{kind}.json"


def _identity(policy: Path, kind: str) -> dict[str, Any]:
    """What a result belongs to: the policy file and everything that decides what is done with it."""
    settings = dict(KINDS[kind].settings)
    ranges: RandomizeConfig = load_ranges(settings["ranges"])
    return {
        "surefoot": __version__,
        "policy": hashlib.sha256(policy.read_bytes()).hexdigest(),
        **settings,
        "ranges": to_mapping(ranges),
    }
