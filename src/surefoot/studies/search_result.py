"""Result of a search: its trials with their gaits, and the best trials in fresh episodes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pandas as pd

from surefoot.configuration import to_mapping
from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import data_sheet_task, undisturbed_task
from surefoot.evaluation.runs import measure_runs
from surefoot.evaluation.statistics import Interval, t_interval
from surefoot.learn.evaluation import evaluation_task
from surefoot.robot import RobotDescription
from surefoot.studies.evaluations import EvaluationRun, Result, cached_result, evaluate
from surefoot.studies.search import Search, SearchConfig
from surefoot.studies.search_space import get_value
from surefoot.world.process_world import worker_pool

_NUM_BEST_TRIALS = 3
"""Number of best trials that are evaluated in fresh episodes."""
_EPISODES = 20
_SEED = 2_000_003
"""Seed of fresh episodes, which neither trainings nor searches use."""


@dataclass(frozen=True)
class SearchResult:
    """Trials of a search, and the best of them in fresh episodes, which the search did not use."""

    config: SearchConfig
    trials: pd.DataFrame
    """One row per trial: trial, state (complete, pruned, fail or running), return of the last evaluation [m] (NaN
    without one), control steps, seconds, gait, pattern, seed, proposed settings by dotted name, reason of a failure. In
    addition `curve`: control steps and return of each evaluation (E, 2); `policy` and `result`: policy file and its
    evaluation `gait`."""
    fresh: pd.DataFrame
    """One row per fresh episode of the best trials: trial, then the columns of `measure_runs`. The best trial comes
    first; each has runs in the training simulator, and in Bullet if it is installed."""
    importance: dict[str, float] = field(default_factory=dict)
    """Importance of each field, with sum 1; empty if too few trials are complete."""

    @cached_property
    def return_unit(self) -> str:
        """Unit of returns: m, or empty if the task's reward has terms of other units."""
        task = self.config.train.task
        return task.return_unit(RobotDescription.load(task.robot))

    def claimed(self, trial: int) -> float:
        """Return a trial's return as the search measured it [m]."""
        return float(self.trials.set_index("trial")["return"][trial])

    def selection_bias(self) -> dict[int, tuple[Interval, Interval]]:
        """Return by trial the mean return of fresh episodes in the training simulator, and claimed minus fresh [m]."""
        biases = {}
        for number, runs in self.fresh.groupby("trial", sort=False):
            fresh, claimed = t_interval(runs[runs.world == runs.world.iloc[0]]["return"]), self.claimed(number)
            biases[number] = fresh, Interval(claimed - fresh.mean, claimed - fresh.high, claimed - fresh.low)
        return biases


def sort_trials(trials: pd.DataFrame) -> pd.DataFrame:
    """Return trials by decreasing return; trials without a return come last."""
    return trials.sort_values("return", ascending=False, kind="stable")


def collect_result(search: Search, report: Callable[[str], None]) -> SearchResult:
    """Name the gait of every trial, and evaluate the best trials in fresh episodes; results are cached.

    Args:
        search: the search.
        report: called with a line before each evaluation.

    Raises:
        SurefootError: no trial is complete.
    """
    trials = pd.DataFrame([_trial_row(search, trial, report) for trial in search.study.trials])
    complete = trials[trials.state == "complete"]
    if not len(complete):
        raise SurefootError(f"{search.folder}: no trial is complete; there is nothing to report yet")
    fresh = []
    with worker_pool():
        for trial in sort_trials(complete)[:_NUM_BEST_TRIALS].itertuples():
            report(f"evaluating trial {trial.trial} in fresh episodes")
            fresh.append(_fresh_runs(search, trial.policy))
            fresh[-1].insert(0, "trial", trial.trial)
    return SearchResult(search.config, trials, pd.concat(fresh, ignore_index=True), search.importance())


def _trial_row(search: Search, trial: Any, report: Callable[[str], None]) -> dict[str, Any]:
    """Return the row of a trial in `SearchResult.trials`, from Optuna's study and the trial's folder."""
    training = search.training(trial.number)
    policy = training.policy if training.policy.exists() else None
    rows, config = training.rows(), training.stored() if policy else None
    curve = [(row["steps"], row["evaluation"]["return_mean"]) for row in rows if "evaluation" in row]
    result = None
    if policy is not None:
        report(f"naming the gait of trial {trial.number}")
        result = evaluate(policy, "gait")
    return {
        "trial": trial.number,
        "state": trial.state.name.lower(),
        "return": curve[-1][1] if curve else math.nan,
        "steps": rows[-1]["steps"] if rows else 0,
        "seconds": rows[-1]["seconds"] if rows else 0.0,
        "gait": result and result["gait"],
        "pattern": result and result["pattern"],
        "seed": config.seed if config else None,
        **{name: _cell(get_value(config, name)) if config else None for name in search.config.space},
        "why": trial.user_attrs.get("why", ""),
        "curve": curve,
        "policy": policy,
        "result": result,
    }


def _cell(value: Any) -> Any:
    """Return a value as a table cell."""
    return " ".join(map(str, value)) if isinstance(value, list) else value


def _fresh_runs(search: Search, path: Path) -> pd.DataFrame:
    """Run fresh episodes in the training simulator, and in Bullet on the data sheet's robot; results are cached."""
    # Terrain and reward as in the evaluations whose returns the search compared; a contract has neither.
    compared = evaluation_task(search.config.train)
    terrain = json.loads(json.dumps(to_mapping(compared.terrain)))

    def run(world: str) -> pd.DataFrame:
        settings = {"world": world, "episodes": _EPISODES, "seed": _SEED, "reward": compared.reward, "terrain": terrain}

        def compute() -> Result:
            run = EvaluationRun.load(path, settings)
            calm, ranges = undisturbed_task(run.task), run.task.randomize
            task = replace(calm, randomize=ranges, reward=compared.reward, terrain=compared.terrain)
            traces = run.run(task if world == "mujoco" else data_sheet_task(task), world)
            return {"runs": measure_runs(traces).to_dict("list")}

        return pd.DataFrame(cached_result(path, f"fresh_{world}", settings, compute)["runs"])

    worlds = ("mujoco", "bullet") if find_spec("pybullet") is not None else ("mujoco",)
    return pd.concat(list(map(run, worlds)), ignore_index=True)
