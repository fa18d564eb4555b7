"""The evaluations that a study's policies go through, the figures that they compute, and the cache of their results."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.configuration import to_mapping
from surefoot.errors import SurefootError, choices, suggest
from surefoot.evaluation.conditions import data_sheet_task, undisturbed_task
from surefoot.evaluation.footfalls import analyze_footfalls
from surefoot.evaluation.gap import PolicyGap
from surefoot.evaluation.recorded import save_runs
from surefoot.evaluation.rollout import run_episodes
from surefoot.evaluation.runs import measure_runs
from surefoot.evaluation.sensitivity import Sensitivity, run_sensitivity
from surefoot.files import atomic_write
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot.randomization import load_ranges
from surefoot.tables import plain_value, with_unit
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.trace import EpisodeTrace
from surefoot.world.registry import WORLDS, find_world

RESULTS_VALID_SINCE = "0.6.0"
"""Version since which evaluations give the same numbers; kept results of an earlier one are computed again."""
SEED = 1
GAP_SEED = 2
"""Runs of a gap are independent of those that policies are selected by."""
Result = dict[str, Any]
"""Result of an evaluation, as JSON holds it."""
Traces = dict[str, list[EpisodeTrace]]
"""Episodes to store, by the name of their world."""


@dataclass(frozen=True)
class ResultMetric:
    """A number that policies are compared by."""

    name: str
    title: str
    unit: str
    digits: int
    trials: int = 0
    """Episodes of a policy that a share counts; 0: it is no share."""

    @property
    def full_scale(self) -> float:
        """Number that stands for a share of one."""
        return 100.0 if self.unit == "%" else float(self.trials)

    @property
    def heading(self) -> str:
        """Title and unit, as the head of a column."""
        return with_unit(self.title, self.unit)


@dataclass(frozen=True)
class EvaluationRun:
    """One evaluation of a policy."""

    policy: PolicyRuntime
    task: TaskConfig
    settings: dict[str, Any]
    threads: int

    @classmethod
    def load(cls, policy: Path, settings: dict[str, Any], threads: int = 0) -> EvaluationRun:
        """Return an evaluation of a policy file on the policy's own task and robot."""
        runtime = PolicyRuntime.load(policy)
        return cls(runtime, task_from_contract(runtime.contract, runtime.load_robot()), settings, threads)

    def run(self, task: TaskConfig, world: str) -> list[EpisodeTrace]:
        """Run episodes of a task in a world."""
        how = (self.settings["episodes"], find_world(world), self.settings["seed"], self.threads)
        return run_episodes(self.policy, task, *how, world_name=world, policy_name=self.policy.contract.name)


@dataclass(frozen=True)
class EvaluationKind:
    """A kind of evaluation of a policy."""

    what: str
    settings: dict[str, Any]
    """Everything besides the policy that the result depends on."""
    run: Callable[[EvaluationRun], tuple[Result, Traces]]
    read: Callable[[Result], tuple[ArrayLike, ...]]
    """Returns the figures of a result; arrays hold a number for each run, where run k of every policy is on robot k."""
    metrics: tuple[ResultMetric, ...]

    @property
    def world_names(self) -> tuple[str, ...]:
        """Names of the worlds that it runs in."""
        return tuple(self.settings[key] for key in ("world", "home", "away") if key in self.settings)

    def read_runs(self, result: Result) -> dict[str, Array]:
        """Return the figures of a result by name, each as `read` gives it."""
        names = [metric.name for metric in self.metrics]
        return {name: np.asarray(values, np.float64) for name, values in zip(names, self.read(result), strict=True)}

    def read_metrics(self, result: Result) -> dict[str, float]:
        """Return the figures of a result by name."""
        return {name: float(values.mean()) for name, values in self.read_runs(result).items()}


def _run_episodes(run: EvaluationRun) -> tuple[Result, Traces]:
    """Run whole episodes without pushes, each with parameters drawn from a table of ranges.

    Actuator and nominal parameters are those of the policy's task.
    """
    task = replace(undisturbed_task(run.task), randomize=load_ranges(run.settings["ranges"], robot=run.task.robot))
    runs = measure_runs(run.run(task, run.settings["world"]))
    # A diverged simulation counts as a fall: the policy has brought the robot to where the model does not hold.
    return {"runs": runs.assign(fell=~runs.balanced).to_dict("list")}, {}


def _run_test_worlds(run: EvaluationRun) -> tuple[Result, Traces]:
    """Run test worlds in which one parameter is not nominal."""
    options = {name: run.settings[name] for name in ("values", "episodes", "seed")}
    options |= {"ranges": load_ranges(run.settings["ranges"], robot=run.task.robot), "threads": run.threads}
    return run_sensitivity(run.policy, run.task, find_world(run.settings["world"]), **options).to_mapping(), {}


def _run_gap(run: EvaluationRun) -> tuple[Result, Traces]:
    """Run some episodes at home, and as many in another world, one on each of its robots.

    As many again in the engine of home on the robot of the data sheet separate the effect of motors and delays.
    """
    home, away, described = run.settings["home"], run.settings["away"], data_sheet_task(run.task)
    traces = {home: run.run(undisturbed_task(run.task), home), away: run.run(described, away)}
    traces[f"{home}-described"] = run.run(described, home)
    runs = pd.concat([measure_runs(part, name) for name, part in traces.items()])
    return {"runs": runs.to_dict("list")}, traces


def _name_gait(run: EvaluationRun) -> tuple[Result, Traces]:
    """Name the gait of some episodes at home; store the first episode with the most frequent name."""
    world = run.settings["world"]
    traces = run.run(undisturbed_task(run.task), world)
    feet = [analyze_footfalls(trace) for trace in traces]
    gaits = [one.gait for one in feet]
    gait = Counter(gaits).most_common(1)[0][0]
    first = feet[gaits.index(gait)]
    result = {
        "gait": gait,
        "agree": gaits.count(gait),
        "pattern": first.pattern,
        "reason": first.reason,
        "stride": plain_value(first.stride_period),
        "duty": plain_value(float(np.mean(list(first.duty_factor.values())))),
    }
    return result, {world: [traces[gaits.index(gait)]]}


def load_gait_trace(policy: Path) -> EpisodeTrace:
    """Return the episode that the evaluation `gait` of a policy file stored."""
    world = EVALUATIONS["gait"].settings["world"]
    return EpisodeTrace.load(next((_result_path(policy, "gait").with_suffix("") / world).glob("*.npz")))


def gap_from_result(result: Result, name: str) -> PolicyGap:
    """Return the runs of a result at home, away, and at home on the robot of the data sheet."""
    return PolicyGap.from_runs(name, [pd.DataFrame(result["runs"])])


def _read_runs(result: Result) -> tuple[float, float, float]:
    runs = pd.DataFrame(result["runs"])
    return runs.speed.mean(), runs["return"].mean(), 100 * runs.fell.mean()


def _read_sensitivity(result: Result) -> tuple[float, ...]:
    sensitivity = Sensitivity.from_mapping(result, "")
    return sensitivity.mean, sensitivity.std, 100 * sensitivity.fall_rate


def _read_gap(result: Result) -> tuple[ArrayLike, ...]:
    gap = gap_from_result(result, "")
    home, away, described = (gap.in_world(world) for world in gap.worlds)
    returns = [runs["return"] for runs in (home, described, away)]
    return *returns, gap.gaps(gap.worlds[1])[0], 100 * away.balanced, away.distance, away.speed, away.power


def _gap_kind(away: str) -> EvaluationKind:
    """Return the evaluation of the reality gap to a world of different robots."""
    robots = len(WORLDS[away].seeds or ())
    return EvaluationKind(
        f"a run on each of the {robots} robots of world {away}, and as many in the policy's own simulator and "
        "there with the robot of the data sheet; none with pushes, each from a start of its own",
        {"home": "mujoco", "away": away, "described": True, "episodes": robots, "seed": GAP_SEED},
        _run_gap,
        _read_gap,
        (
            ResultMetric("gap_home", "return at home", "m", 2),
            ResultMetric("gap_described", "return at home as described", "m", 2),
            ResultMetric("gap_away", "return away", "m", 2),
            ResultMetric("gap", "gap", "m", 2),
            ResultMetric("gap_balanced", "balanced away", "%", 1, robots),
            ResultMetric("gap_distance", "distance away", "m", 2),
            ResultMetric("gap_speed", "speed away", "m/s", 3),
            ResultMetric("gap_power", "power away", "W", 1),
        ),
    )


EVALUATIONS: dict[str, EvaluationKind] = {
    "nominal": EvaluationKind(
        "20 episodes in the nominal world of the policy's own simulator, without pushes",
        {"world": "mujoco", "episodes": 20, "seed": SEED, "ranges": "none"},
        _run_episodes,
        _read_runs,
        (
            ResultMetric("nominal_speed", "speed, nominal", "m/s", 3),
            ResultMetric("nominal_return", "return, nominal", "m", 2),
            ResultMetric("nominal_falls", "falls, nominal", "%", 1, 20),
        ),
    ),
    "table1": EvaluationKind(
        "100 episodes with every parameter of table I drawn at random, without pushes",
        {"world": "mujoco", "episodes": 100, "seed": SEED, "ranges": "table1"},
        _run_episodes,
        lambda result: _read_runs(result)[::2],
        (
            ResultMetric("table1_speed", "speed, table I drawn", "m/s", 3),
            ResultMetric("table1_falls", "falls, table I drawn", "%", 1, 100),
        ),
    ),
    "sensitivity": EvaluationKind(
        "test worlds: one parameter of table I at a time takes 10 values, all else nominal; 4 episodes in each",
        {"world": "mujoco", "values": 10, "episodes": 4, "seed": SEED, "ranges": "table1"},
        _run_test_worlds,
        _read_sensitivity,
        (
            ResultMetric("sensitivity_mean", "mean return over test worlds", "m", 2),
            ResultMetric("sensitivity_std", "standard deviation of return over test worlds", "m", 2),
            ResultMetric("sensitivity_falls", "falls in test worlds", "%", 1, 400),
        ),
    ),
    "gap": _gap_kind("ensemble"),
    "gap_test": _gap_kind("ensemble-test"),
    "gait": EvaluationKind(
        "names of the gait in 5 episodes in the nominal world of the policy's own simulator, without pushes",
        {"world": "mujoco", "episodes": 5, "seed": SEED},
        _name_gait,
        lambda result: (result["agree"],),
        (ResultMetric("gait_agree", "episodes with the same gait", "of 5", 0, 5),),
    ),
}
"""Evaluations by name; the first one is part of every study."""


def evaluation_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return the evaluations of a study, the one that every study has first; refuse unknown names."""
    for name in names:
        if name not in EVALUATIONS:
            raise SurefootError(f"evaluate: '{name}' is no kind of evaluation; {suggest(name, EVALUATIONS)}")
    return tuple(dict.fromkeys(("nominal", *names)))


def find_gap(kinds: Iterable[str]) -> str:
    """Return which of the evaluations measures the reality gap; empty if none does."""
    gaps = [kind for kind in kinds if EVALUATIONS[kind].run is _run_gap]
    if len(gaps) > 1:
        raise SurefootError(f"evaluate: a study measures one reality gap; it has {choices(gaps)}")
    return gaps[0] if gaps else ""


def stored_result(policy: Path, name: str, kind: EvaluationKind | None = None) -> Result | None:
    """Return the cached result of an evaluation of a policy file as it is now; None if there is none.

    `kind` defaults to the one of `EVALUATIONS`.
    """
    return _load(policy, name, _identity(policy, _settings(kind or EVALUATIONS[name])))


def evaluate(policy: Path, name: str, threads: int = 0, kind: EvaluationKind | None = None) -> Result:
    """Run the evaluation `name` on a policy file, or return its cached result.

    `kind` defaults to the one of `EVALUATIONS`. Results are stored in `evaluations/` beside the file, and traces that
    the evaluation keeps in `evaluations/NAME/WORLD/run_000.npz` and on.
    """
    kind = kind or EVALUATIONS[name]

    def compute() -> Result:
        result, stored = kind.run(EvaluationRun.load(policy, kind.settings, threads))
        # Traces before the result, so that a result never lacks them.
        for world, traces in stored.items():
            save_runs(_result_path(policy, name).with_suffix("") / world, traces)
        return result

    return cached_result(policy, name, _settings(kind), compute)


def cached_result(policy: Path, name: str, settings: dict[str, Any], compute: Callable[[], Result]) -> Result:
    """Return the result that is stored in `evaluations/` beside a policy file, or compute and store it.

    Args:
        policy: the policy file.
        name: of the result.
        settings: everything that the result depends on besides the policy and the version of surefoot.
        compute: called if there is no result of the file as it is now.
    """
    identity = _identity(policy, settings)
    cached = _load(policy, name, identity)
    if cached is not None:
        return cached
    result, path = compute(), _result_path(policy, name)
    path.parent.mkdir(exist_ok=True)
    atomic_write(path, json.dumps({"identity": identity, "result": result}) + "\n")
    return result


def _load(policy: Path, name: str, identity: dict[str, Any]) -> Result | None:
    try:
        record = json.loads(_result_path(policy, name).read_text(encoding="utf-8"))
        return record["result"] if record["identity"] == identity else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _result_path(policy: Path, name: str) -> Path:
    return policy.parent / "evaluations" / f"{name}.json"


def _settings(kind: EvaluationKind) -> dict[str, Any]:
    """Return the settings of an evaluation with the ranges themselves, not the name of their table."""
    settings = dict(kind.settings)
    if isinstance(settings.get("ranges"), str):
        settings["ranges"] = to_mapping(load_ranges(settings["ranges"]))
    return settings


def _identity(policy: Path, settings: dict[str, Any]) -> dict[str, Any]:
    return {"surefoot": RESULTS_VALID_SINCE, "policy": hashlib.sha256(policy.read_bytes()).hexdigest(), **settings}
