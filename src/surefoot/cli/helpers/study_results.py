"""Evaluation and report of a study's finished runs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from surefoot.cli.helpers.options import make_figures_folder
from surefoot.errors import SurefootError, suggest
from surefoot.studies.study_config import StudyConfig, study_runs
from surefoot.studies.training import Training
from surefoot.world.registry import find_world

if TYPE_CHECKING:
    from surefoot.studies.comparison import Comparison


def check_evaluations(study: StudyConfig, worlds: bool) -> None:
    """Refuse evaluations that do not exist or lack a `worlds`, before anything is trained.

    Raises:
        SurefootError: an unknown evaluation, figure or world, or bars without a gap.
    """
    from surefoot.studies.evaluations import EVALUATIONS, evaluation_names, find_gap

    kinds = evaluation_names(study.evaluate)
    figures = [figure.name for kind in kinds for figure in EVALUATIONS[kind].figures]
    if study.primary not in figures:
        raise SurefootError(
            f"primary: '{study.primary}' is no figure of its evaluations; {suggest(study.primary, figures)}"
        )
    if not find_gap(kinds) and study.bars:
        raise SurefootError("bars: they show the reality gap; evaluate must name 'gap' or 'gap_test' for them")
    for world in [name for kind in kinds for name in EVALUATIONS[kind].world_names] if worlds else ():
        find_world(world)


def evaluate_runs(study: StudyConfig, runs: list[Training], threads: int, console: Console) -> None:
    """Run every evaluation of every finished run that is not cached."""
    from surefoot.evaluation.statistics import decimal
    from surefoot.studies.evaluations import EVALUATIONS, evaluate, evaluation_names, stored_result
    from surefoot.world.process_world import worker_pool

    kinds, finished = evaluation_names(study.evaluate), [run for run in runs if run.state == "finished"]
    todo = [(run, kind) for run in finished for kind in kinds if stored_result(run.policy, kind) is None]
    with worker_pool():
        for number, (run, kind) in enumerate(todo, start=1):
            start = time.perf_counter()
            with console.status(f"evaluating {run.name}: {kind} ({number} of {len(todo)})"):
                values = EVALUATIONS[kind].read_figures(evaluate(run.policy, kind, threads))
            figures = ", ".join(
                f"{one.title} {decimal(values[one.name], one.digits)} {one.unit}" for one in EVALUATIONS[kind].figures
            )
            seconds = time.perf_counter() - start
            console.print(
                f"{number:>3} of {len(todo)}  {run.group:<20} seed {run.config.seed:<3} {figures}  ({seconds:.0f} s)"
            )


def report(study: StudyConfig, root: Path, out: Path, command: str, console: Console) -> None:
    """Write tables, figures and README of all runs that are finished and evaluated, of whichever group."""
    comparison = _collect(study, root)
    make_figures_folder(out)
    from surefoot.studies.study_report import write_report

    readme = write_report(comparison, out, command)
    if comparison.missing:
        console.print(f"Not in the report: {', '.join(comparison.missing)}")
    console.print(f"Report: {readme}")


def _collect(study: StudyConfig, root: Path) -> Comparison:
    """Return all runs of a study that are finished and have every evaluation; one or more."""
    import pandas as pd

    from surefoot.studies.comparison import Comparison

    runs = study_runs(study, root)
    rows = {run.name: _policy_row(run, study) for run in runs}
    present = [row for group in study.groups for row in rows.values() if row is not None and row["group"] == group]
    if not present:
        raise SurefootError(f"{root}: no run of the study is finished and evaluated; there is nothing to report yet")
    missing = tuple(name for name, row in rows.items() if row is None)
    return Comparison(study, pd.DataFrame(present), missing)


def _policy_row(run: Training, study: StudyConfig) -> dict[str, Any] | None:
    """Return the row of a run; None if it is not finished, not evaluated, or not the one of the study."""
    from surefoot.policy.runtime import PolicyRuntime
    from surefoot.studies.comparison import policy_row
    from surefoot.studies.evaluations import evaluation_names, stored_result

    if run.state != "finished":
        return None
    try:
        run.check()
    except SurefootError:
        return None
    results = {kind: stored_result(run.policy, kind) for kind in evaluation_names(study.evaluate)}
    stored = {kind: result for kind, result in results.items() if result is not None}
    if len(stored) < len(results):
        return None
    best = PolicyRuntime.load(run.policy).contract.figures.get("training", {}).get("steps")
    row = policy_row(run.group, run.config.seed, run.rows(), stored)
    return row | {"best_steps": best, "policy": run.policy}
