"""Evaluation and report of a search's trials."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from surefoot.cli.helpers.options import make_figures_folder
from surefoot.errors import SurefootError
from surefoot.studies.search import Search
from surefoot.studies.search_space import get
from surefoot.world.registry import find_world

if TYPE_CHECKING:
    import pandas as pd

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
    import pandas as pd

    from surefoot.studies.search_report import SearchResult, sort_trials, write_report
    from surefoot.world.process_world import worker_pool

    make_figures_folder(search.folder)
    trials = pd.DataFrame([_trial_row(search, trial, console) for trial in search.study.trials])
    complete = trials[trials.state == "complete"]
    if not len(complete):
        raise SurefootError(f"{search.folder}: no trial is complete; there is nothing to report yet")
    fresh = []
    with worker_pool():
        for trial in sort_trials(complete)[:TOP].itertuples():
            with console.status(f"evaluating trial {trial.trial} in fresh episodes"):
                fresh.append(_fresh_runs(search, trial.policy))
            fresh[-1].insert(0, "trial", trial.trial)
    result = SearchResult(search.config, trials, pd.concat(fresh, ignore_index=True), search.importance())
    console.print(f"Report: {write_report(result, search.folder, command)}")


def _trial_row(search: Search, trial: Any, console: Console) -> dict[str, Any]:
    """Return the row of a trial of Optuna's study, as `SearchResult` has it, from its folder."""
    from surefoot.studies.evaluations import evaluate

    training = search.training(trial.number)
    policy = training.policy if training.policy.exists() else None
    rows, config = training.rows(), training.stored() if policy else None
    curve = [(row["steps"], row["evaluation"]["return_mean"]) for row in rows if "evaluation" in row]
    result = None
    if policy is not None:
        with console.status(f"naming the gait of trial {trial.number}"):
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
        **{name: _cell(get(config, name)) if config else None for name in search.config.space},
        "why": trial.user_attrs.get("why", ""),
        "curve": curve,
        "policy": policy,
        "result": result,
    }


def _cell(value: Any) -> Any:
    """Return a value as a cell of a table."""
    return " ".join(map(str, value)) if isinstance(value, list) else value


def _fresh_runs(search: Search, path: Path) -> pd.DataFrame:
    """Run a policy in fresh episodes at home, and in Bullet on the robot of the data sheet; results are cached."""
    import pandas as pd

    from surefoot.evaluation.conditions import away_task
    from surefoot.evaluation.rollout import run_episodes
    from surefoot.evaluation.runs import measure_runs
    from surefoot.policy.runtime import PolicyRuntime
    from surefoot.studies.evaluations import Result, cached_result
    from surefoot.task.contract_mapping import task_from_contract

    reward = search.config.train.task.reward

    def run(world: str) -> pd.DataFrame:
        def compute() -> Result:
            policy = PolicyRuntime.load(path)
            task = replace(task_from_contract(policy.contract, policy.load_robot()), reward=reward)
            task = replace(task, pushes=replace(task.pushes, enabled=False))
            task = task if world == "mujoco" else away_task(task)
            traces = run_episodes(policy, task, EPISODES, find_world(world), SEED, world_name=world)
            return {"runs": measure_runs(traces).to_dict("list")}

        settings = {"world": world, "episodes": EPISODES, "seed": SEED, "reward": reward}
        return pd.DataFrame(cached_result(path, f"fresh_{world}", settings, compute)["runs"])

    worlds = ("mujoco", "bullet") if find_spec("pybullet") is not None else ("mujoco",)
    return pd.concat(list(map(run, worlds)), ignore_index=True)
