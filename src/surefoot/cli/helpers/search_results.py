"""Evaluation and report of a search's trials."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from rich.console import Console

from surefoot.cli.helpers.options import make_figures_folder
from surefoot.errors import SurefootError
from surefoot.studies.search import Search
from surefoot.studies.search_space import get
from surefoot.world.registry import find_world

if TYPE_CHECKING:
    from surefoot.studies.trials import Retest, TrialResult

TOP = 3
"""Best trials that are evaluated anew."""
EPISODES = 20
SEED = 2_000_003
"""Seed of fresh episodes, which neither training nor search has used."""


def report(search: Search, command: str, console: Console) -> None:
    """Name the gait of every trial, evaluate the best anew, and write tables, figures and README.

    Raises:
        SurefootError: no trial is complete.
    """
    from surefoot.studies.search_report import write_report
    from surefoot.studies.trials import SearchResult, best
    from surefoot.world.process_world import worker_pool

    make_figures_folder(search.folder)
    trials = [_trial_result(search, trial, console) for trial in search.study.trials]
    complete = [trial for trial in trials if trial.complete]
    if not complete:
        raise SurefootError(f"{search.folder}: no trial is complete; there is nothing to report yet")
    retests = []
    with worker_pool():
        for trial in best(complete)[:TOP]:
            with console.status(f"evaluating trial {trial.number} in fresh episodes"):
                retests.append(_retest(search, trial))
    train, seed = search.config.train, search.config.seed
    options = (train.steps, train.evaluation_episodes, tuple(trials), search.importance(), tuple(retests))
    result = SearchResult(train.task.name, seed, *options)
    console.print(f"Report: {write_report(result, search.folder, command)}")


def _trial_result(search: Search, trial: Any, console: Console) -> TrialResult:
    """Return the result of a trial of Optuna's study from its folder."""
    from surefoot.studies.evaluations import evaluate
    from surefoot.studies.trials import TrialResult

    training = search.training(trial.number)
    policy = training.policy if training.policy.exists() else None
    rows, config = training.rows(), training.stored() if policy else None
    curve = tuple((row["steps"], row["evaluation"]["return_mean"]) for row in rows if "evaluation" in row)
    gait = None
    if policy is not None:
        with console.status(f"naming the gait of trial {trial.number}"):
            gait = evaluate(policy, "gait")
    return TrialResult(
        trial.number,
        trial.state.name.lower(),
        config.seed if config else None,
        curve[-1][1] if curve else math.nan,
        rows[-1]["steps"] if rows else 0,
        rows[-1]["seconds"] if rows else 0.0,
        curve,
        {name: _cell(get(config, name)) if config else None for name in search.config.space},
        policy,
        gait,
        trial.user_attrs.get("why", ""),
    )


def _cell(value: Any) -> Any:
    """Return a value as a cell of a table."""
    return " ".join(map(str, value)) if isinstance(value, list) else value


def _retest(search: Search, trial: TrialResult) -> Retest:
    """Run a policy in fresh episodes at home, and in Bullet on the robot of the data sheet; results are cached."""
    import pandas as pd

    from surefoot.evaluate.gap import away_task
    from surefoot.evaluate.rollout import run_episodes
    from surefoot.evaluate.runs import measure_runs
    from surefoot.policy.runtime import PolicyRuntime
    from surefoot.studies.evaluations import Result, cached_result
    from surefoot.studies.trials import Retest
    from surefoot.task.contract_mapping import task_from_contract

    assert trial.policy is not None
    path, reward = trial.policy, search.config.train.task.reward

    def run(world: str) -> pd.DataFrame:
        def compute() -> Result:
            policy = PolicyRuntime.load(path)
            task = replace(task_from_contract(policy.contract), reward=reward)
            task = replace(task, pushes=replace(task.pushes, enabled=False))
            task = task if world == "mujoco" else away_task(task)
            traces = run_episodes(policy, task, EPISODES, find_world(world), SEED, world_name=world)
            return {"runs": measure_runs(traces).to_dict("list")}

        settings = {"world": world, "episodes": EPISODES, "seed": SEED, "reward": reward}
        return pd.DataFrame(cached_result(path, f"fresh_{world}", settings, compute)["runs"])

    worlds = ("mujoco", "bullet") if find_spec("pybullet") is not None else ("mujoco",)
    return Retest(trial, pd.concat(list(map(run, worlds)), ignore_index=True))
