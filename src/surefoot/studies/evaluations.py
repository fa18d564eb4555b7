"""Evaluations of a study's policies, their metrics, and the cache of their results."""

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
"""Version since which evaluations give the same numbers; cached results of earlier versions are computed again."""
SEED = 1
GAP_SEED = 2
"""Seed of the reality gap's runs, which are independent of the runs by which policies are selected."""
Result = dict[str, Any]
"""Result of an evaluation, for JSON."""
Traces = dict[str, list[EpisodeTrace]]
"""Episodes to store, by the name of their world."""


@dataclass(frozen=True)
class ResultMetric:
    """Metric by which policies are compared."""

    name: str
    title: str
    unit: str
    digits: int
    trials: int | Callable[[Result], int] = 0
    """Number of a policy's episodes if the metric is a proportion of them, or its computation from a result; otherwise
    0."""
    is_return: bool = False
    """Whether it is a return, in m only for the paper's reward."""

    def count_trials(self, result: Result) -> int:
        """Return the number of a policy's episodes in a result if the metric is a proportion of them; otherwise 0."""
        return self.trials(result) if callable(self.trials) else self.trials

    def full_scale(self, trials: int) -> float:
        """Return the value of the metric for a proportion of 1 of `trials` episodes."""
        return 100.0 if self.unit == "%" else float(trials)

    @property
    def heading(self) -> str:
        """Title and unit, for the heading of a column."""
        return with_unit(self.title, self.unit)


@dataclass(frozen=True)
class EvaluationRun:
    """Evaluation of one policy."""

    policy: PolicyRuntime
    task: TaskConfig
    settings: dict[str, Any]
    threads: int

    @classmethod
    def load(cls, policy: Path, settings: dict[str, Any], threads: int = 0) -> EvaluationRun:
        """Return the evaluation of a policy file on the policy's own task and robot."""
        runtime = PolicyRuntime.load(policy)
        return cls(runtime, task_from_contract(runtime.contract, runtime.load_robot()), settings, threads)

    def run(self, task: TaskConfig, world: str) -> list[EpisodeTrace]:
        """Run episodes of a task in a world."""
        how = (self.settings["episodes"], find_world(world), self.settings["seed"], self.threads)
        return run_episodes(self.policy, task, *how, world_name=world, policy_name=self.policy.contract.name)


@dataclass(frozen=True)
class EvaluationKind:
    """A kind of evaluation of a policy."""

    description: str
    settings: dict[str, Any]
    """Everything that the result depends on, except the policy."""
    run: Callable[[EvaluationRun], tuple[Result, Traces]]
    read: Callable[[Result], tuple[ArrayLike, ...]]
    """Computes the metrics of a result. Arrays have one value per run, where run k of every policy is on robot k."""
    metrics: tuple[ResultMetric, ...]

    @property
    def world_names(self) -> tuple[str, ...]:
        """Names of the worlds of its runs."""
        return tuple(self.settings[key] for key in ("world", "home", "away") if key in self.settings)

    def read_runs(self, result: Result) -> dict[str, Array]:
        """Return the metrics of a result by name, with one value per run if `read` returns an array."""
        names = [metric.name for metric in self.metrics]
        return {name: np.asarray(values, np.float64) for name, values in zip(names, self.read(result), strict=True)}

    def read_metrics(self, result: Result) -> dict[str, float]:
        """Return the metrics of a result by name, averaged over runs."""
        return {name: float(values.mean()) for name, values in self.read_runs(result).items()}


def _run_episodes(run: EvaluationRun) -> tuple[Result, Traces]:
    """Run episodes without pushes, each with random physical parameters from a table of ranges.

    Actuator and nominal parameters are taken from the policy's task.
    """
    task = replace(undisturbed_task(run.task), randomize=load_ranges(run.settings["ranges"], robot=run.task.robot))
    runs = measure_runs(run.run(task, run.settings["world"]))
    # A diverged simulation counts as a fall: the policy drove the robot to a state in which the model is not valid.
    return {"runs": runs.assign(fell=~runs.balanced).to_dict("list")}, {}


def _run_test_worlds(run: EvaluationRun) -> tuple[Result, Traces]:
    """Run test worlds in which one parameter is not nominal."""
    options = {name: run.settings[name] for name in ("values", "episodes", "seed")}
    options |= {"ranges": load_ranges(run.settings["ranges"], robot=run.task.robot), "threads": run.threads}
    return run_sensitivity(run.policy, run.task, find_world(run.settings["world"]), **options).to_mapping(), {}


def _run_gap(run: EvaluationRun) -> tuple[Result, Traces]:
    """Run episodes in the training simulator, and as many in the target world, one on each of its robots.

    The same number in the training simulator with the robot of the data sheet separates the effect of motors and
    delays from the engine's.
    """
    home, away, described = run.settings["home"], run.settings["away"], data_sheet_task(run.task)
    traces = {home: run.run(undisturbed_task(run.task), home), away: run.run(described, away)}
    traces[f"{home}-described"] = run.run(described, home)
    runs = pd.concat([measure_runs(part, name) for name, part in traces.items()])
    return {"runs": runs.to_dict("list")}, traces


def _name_gait(run: EvaluationRun) -> tuple[Result, Traces]:
    """Name the gait of episodes in the training simulator; store the first episode with the most frequent name."""
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
    """Return the episode that the evaluation `gait` stored for a policy file.

    Raises:
        SurefootError: its trace is missing.
    """
    result = _result_path(policy, "gait")
    folder = result.with_suffix("") / EVALUATIONS["gait"].settings["world"]
    if not (traces := sorted(folder.glob("*.npz"))):
        raise SurefootError(f"{folder} has no trace (.npz); delete {result}, and the evaluation runs again")
    return EpisodeTrace.load(traces[0])


def gap_from_result(result: Result, name: str) -> PolicyGap:
    """Return the runs of a result of `_run_gap`."""
    return PolicyGap.from_runs(name, [pd.DataFrame(result["runs"])])


def _read_runs(result: Result) -> tuple[float, float, float]:
    runs = pd.DataFrame(result["runs"])
    return runs.speed.mean(), runs["return"].mean(), 100 * runs.fell.mean()


def _read_sensitivity(result: Result) -> tuple[float, ...]:
    sensitivity = Sensitivity.from_mapping(result, "")
    return sensitivity.mean, sensitivity.std, 100 * sensitivity.fall_rate


def _count_test_runs(result: Result) -> int:
    return len(Sensitivity.from_mapping(result, "").tests)


def _read_gap(result: Result) -> tuple[ArrayLike, ...]:
    gap = gap_from_result(result, "")
    home, away, described = (gap.in_world(world) for world in gap.worlds)
    returns = [runs["return"] for runs in (home, described, away)]
    return *returns, gap.gaps(gap.worlds[1])[0], 100 * away.balanced, away.distance, away.speed, away.power


def _gap_kind(away: str) -> EvaluationKind:
    """Return the evaluation of the reality gap to a world with an ensemble of robots."""
    robots = len(WORLDS[away].seeds or ())
    return EvaluationKind(
        f"one run on each of the {robots} robots of world {away}, as many in the training simulator, and as many there "
        "with the robot of the data sheet; all without pushes and from different starts",
        {"home": "mujoco", "away": away, "described": True, "episodes": robots, "seed": GAP_SEED},
        _run_gap,
        _read_gap,
        (
            ResultMetric("gap_home", "return in training simulator", "m", 2, is_return=True),
            ResultMetric("gap_described", "return as described", "m", 2, is_return=True),
            ResultMetric("gap_away", "return in target world", "m", 2, is_return=True),
            ResultMetric("gap", "gap", "m", 2, is_return=True),
            ResultMetric("gap_balanced", "balanced in target world", "%", 1, robots),
            ResultMetric("gap_distance", "distance in target world", "m", 2),
            ResultMetric("gap_speed", "speed in target world", "m/s", 3),
            ResultMetric("gap_power", "power in target world", "W", 1),
        ),
    )


EVALUATIONS: dict[str, EvaluationKind] = {
    "nominal": EvaluationKind(
        "20 episodes in the training simulator with nominal parameters, without pushes",
        {"world": "mujoco", "episodes": 20, "seed": SEED, "ranges": "none"},
        _run_episodes,
        _read_runs,
        (
            ResultMetric("nominal_speed", "speed, nominal", "m/s", 3),
            ResultMetric("nominal_return", "return, nominal", "m", 2, is_return=True),
            ResultMetric("nominal_falls", "falls, nominal", "%", 1, 20),
        ),
    ),
    "table1": EvaluationKind(
        "100 episodes with all physical parameters random, in the paper's ranges (table I), without pushes",
        {"world": "mujoco", "episodes": 100, "seed": SEED, "ranges": "table1"},
        _run_episodes,
        lambda result: _read_runs(result)[::2],
        (
            ResultMetric("table1_speed", "speed, randomized", "m/s", 3),
            ResultMetric("table1_falls", "falls, randomized", "%", 1, 100),
        ),
    ),
    "sensitivity": EvaluationKind(
        "test worlds: one parameter of table I at a time takes 10 values, all others nominal; 4 episodes in each",
        {"world": "mujoco", "values": 10, "episodes": 4, "seed": SEED, "ranges": "table1"},
        _run_test_worlds,
        _read_sensitivity,
        (
            ResultMetric("sensitivity_mean", "mean return over test worlds", "m", 2, is_return=True),
            ResultMetric("sensitivity_std", "standard deviation of return over test worlds", "m", 2, is_return=True),
            ResultMetric("sensitivity_falls", "falls in test worlds", "%", 1, _count_test_runs),
        ),
    ),
    "gap": _gap_kind("ensemble"),
    "gap_test": _gap_kind("ensemble-test"),
    "gait": EvaluationKind(
        "gait in 5 episodes in the training simulator with nominal parameters, without pushes",
        {"world": "mujoco", "episodes": 5, "seed": SEED},
        _name_gait,
        lambda result: (result["agree"],),
        (ResultMetric("gait_agree", "episodes with the same gait", "of 5", 0, 5),),
    ),
}
"""Evaluations by name; `nominal` is part of every study."""


def evaluation_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a study's evaluations, `nominal` first.

    Raises:
        SurefootError: a name is unknown.
    """
    for name in names:
        if name not in EVALUATIONS:
            raise SurefootError(f"evaluate: '{name}' is no kind of evaluation; {suggest(name, EVALUATIONS)}")
    return tuple(dict.fromkeys(("nominal", *names)))


def find_gap(kinds: Iterable[str]) -> str:
    """Return the evaluation that measures the reality gap; empty if none does.

    Raises:
        SurefootError: several do.
    """
    gaps = [kind for kind in kinds if EVALUATIONS[kind].run is _run_gap]
    if len(gaps) > 1:
        raise SurefootError(f"evaluate: a study measures one reality gap; it has {choices(gaps)}")
    return gaps[0] if gaps else ""


def stored_result(policy: Path, name: str, kind: EvaluationKind | None = None) -> Result | None:
    """Return the cached result of the evaluation `name` for the current content of a policy file, or None.

    `kind` defaults to `EVALUATIONS[name]`.
    """
    return _load(policy, name, _identity(policy, _settings(kind or EVALUATIONS[name])))


def evaluate(policy: Path, name: str, threads: int = 0, kind: EvaluationKind | None = None) -> Result:
    """Run the evaluation `name` on a policy file, or return its cached result.

    `kind` defaults to `EVALUATIONS[name]`. Results are stored in `evaluations/` next to the file, and the evaluation's
    traces in `evaluations/NAME/WORLD/run_000.npz`, `run_001.npz`, ...
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
    """Return the result that is stored in `evaluations/` next to a policy file, or compute and store it.

    Args:
        policy: the policy file.
        name: name of the result.
        settings: everything that the result depends on, except the policy and the version of surefoot.
        compute: called if there is no result for the current content of the policy file.
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
    """Return the settings of an evaluation, with ranges instead of the name of their table."""
    settings = dict(kind.settings)
    if isinstance(settings.get("ranges"), str):
        settings["ranges"] = to_mapping(load_ranges(settings["ranges"]))
    return settings


def _identity(policy: Path, settings: dict[str, Any]) -> dict[str, Any]:
    return {"surefoot": RESULTS_VALID_SINCE, "policy": hashlib.sha256(policy.read_bytes()).hexdigest(), **settings}
