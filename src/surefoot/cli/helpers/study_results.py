"""Evaluation and report of a study's finished runs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from surefoot.cli.helpers.options import make_figures_folder
from surefoot.errors import SurefootError
from surefoot.studies.study_config import StudyConfig, study_runs
from surefoot.studies.training import Training
from surefoot.world.registry import find_world

if TYPE_CHECKING:
    from surefoot.studies.comparison import Comparison, SeedResult


def check_evaluations(study: StudyConfig, worlds: bool) -> None:
    """Refuse evaluations that do not exist or lack a `worlds`, before anything is trained.

    Raises:
        SurefootError: an unknown evaluation or world, or bars without a gap.
    """
    from surefoot.studies.evaluations import EVALUATIONS, evaluation_names

    kinds = evaluation_names(study.evaluate)
    if study.bars and "gap" not in kinds:
        raise SurefootError("bars: they show the reality gap; evaluate must name 'gap' for them")
    for world in {name for kind in kinds for name in EVALUATIONS[kind].world_names} if worlds else ():
        find_world(world)


def evaluate_runs(study: StudyConfig, runs: list[Training], threads: int, console: Console) -> None:
    """Run every evaluation of every finished run that is not cached."""
    from surefoot.evaluate.statistics import decimal
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
    from surefoot.studies.comparison import Comparison, GroupResult
    from surefoot.studies.evaluations import evaluation_names

    kinds = evaluation_names(study.evaluate)
    results: dict[str, list[SeedResult]] = {name: [] for name in study.groups}
    missing = []
    for run in study_runs(study, root):
        result = _result(run, kinds)
        if result is None:
            missing.append(run.name)
        else:
            results[run.group].append(result)
    groups = tuple(GroupResult(name, study.label(name), tuple(seeds)) for name, seeds in results.items() if seeds)
    if not groups:
        raise SurefootError(f"{root}: no run of the study is finished and evaluated; there is nothing to report yet")
    return Comparison(study, groups, tuple(missing))


def _result(run: Training, kinds: tuple[str, ...]) -> SeedResult | None:
    """Return the result of a run; None if it is not finished, not evaluated, or not the one of the study."""
    from surefoot.policy.runtime import PolicyRuntime
    from surefoot.studies.comparison import SeedResult, learning_curve
    from surefoot.studies.evaluations import stored_result

    if run.state != "finished":
        return None
    try:
        run.check()
    except SurefootError:
        return None
    results = {kind: result for kind in kinds if (result := stored_result(run.policy, kind)) is not None}
    if len(results) < len(kinds):
        return None
    rows = run.rows()
    best = PolicyRuntime.load(run.policy).contract.figures.get("training", {}).get("steps")
    about = (run.config.seed, rows[-1]["steps"], rows[-1]["seconds"])
    return SeedResult(*about, learning_curve(rows), results, best, run.policy)
