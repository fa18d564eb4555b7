"""Evaluation and report of the finished runs of a study."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from surefoot.cli.helpers.options import make_figures_folder
from surefoot.errors import SurefootError, suggest
from surefoot.studies.hidden_robots import other_motors_folder, read_identified, robot_name
from surefoot.studies.study_config import StudyConfig, return_unit, study_runs
from surefoot.studies.training import Training
from surefoot.world.registry import check_takes_params, find_world

if TYPE_CHECKING:
    from surefoot.studies.comparison import Comparison
    from surefoot.studies.evaluations import EvaluationKind


def check_evaluations(study: StudyConfig, worlds: bool) -> None:
    """Check, before any training, that a study's evaluations exist and, if `worlds`, that their worlds do.

    Raises:
        SurefootError: an unknown evaluation, metric or world, or bars without a reality gap.
    """
    from surefoot.studies.evaluations import EVALUATIONS, evaluation_names, find_gap

    if study.robots is not None:
        for world in ("mujoco", study.robots.world):
            check_takes_params(world)
        return
    kinds = evaluation_names(study.evaluate)
    metrics = [figure.name for kind in kinds for figure in EVALUATIONS[kind].metrics]
    if study.primary not in metrics:
        raise SurefootError(
            f"primary: '{study.primary}' is not a metric of its evaluations; {suggest(study.primary, metrics)}"
        )
    if not find_gap(kinds) and study.bars:
        raise SurefootError("bars: they show the reality gap, so evaluate must contain 'gap' or 'gap_test'")
    for world in [name for kind in kinds for name in EVALUATIONS[kind].world_names] if worlds else ():
        find_world(world)


def evaluation_kinds(study: StudyConfig, run: Training, root: Path) -> dict[str, EvaluationKind]:
    """Return the evaluations of a run's policy, by name."""
    from surefoot.studies.evaluations import EVALUATIONS, evaluation_names
    from surefoot.studies.robot_runs import NAME, robot_kind

    if study.robots is None:
        return {name: EVALUATIONS[name] for name in evaluation_names(study.evaluate)}
    seeds = [seed for seed in study.robots.seeds if run.robot in ("", robot_name(seed))]
    return {NAME: robot_kind(study.robots, seeds, other_motors_folder(root / "robots"))}


def evaluate_runs(study: StudyConfig, runs: list[Training], root: Path, threads: int, console: Console) -> None:
    """Run all evaluations of all finished runs whose results are not cached."""
    from surefoot.evaluation.statistics import decimal
    from surefoot.studies.evaluations import evaluate, stored_result
    from surefoot.world.process_world import worker_pool

    todo = [
        (run, name, kind)
        for run in runs
        if run.state == "finished"
        for name, kind in evaluation_kinds(study, run, root).items()
        if stored_result(run.policy, name, kind) is None
    ]
    returns = return_unit(study)
    with worker_pool():
        for number, (run, name, kind) in enumerate(todo, start=1):
            start = time.perf_counter()
            with console.status(f"evaluating {run.name}: {name} ({number} of {len(todo)})"):
                values = kind.read_metrics(evaluate(run.policy, name, threads, kind))
            metrics = ", ".join(
                f"{one.title} {decimal(values[one.name], one.digits)} {returns if one.is_return else one.unit}".rstrip()
                for one in kind.metrics
            )
            seconds = time.perf_counter() - start
            console.print(
                f"{number:>3} of {len(todo)}  {run.title:<20} seed {run.config.seed:<3} {metrics}  ({seconds:.0f} s)"
            )


def robots_folder(out: Path) -> Path:
    """Return the folder of parameter files of identified robots, in the folder of a study's report."""
    return out / "robots"


def report_robots(study: StudyConfig, root: Path, out: Path, command: str, console: Console) -> None:
    """Write tables, figures and README of a study on hidden robots, from all runs that are finished and evaluated."""
    import pandas as pd

    from surefoot.studies.evaluations import stored_result
    from surefoot.studies.robot_comparison import RobotComparison, episode_rows, parameter_rows
    from surefoot.studies.robot_runs import NAME

    robots, rows = study.hidden, dict[str, pd.DataFrame]()
    for run in study_runs(study, root, robots=robots_folder(out)):
        if _is_finished(run):
            result = stored_result(run.policy, NAME, evaluation_kinds(study, run, root)[NAME])
            rows |= {} if result is None else {run.name: episode_rows(run, result)}
    if not rows:
        raise SurefootError(f"{root}: no run of the study is finished and evaluated; there is nothing to report yet")
    make_figures_folder(out)
    from surefoot.studies.robot_report import write_robot_report

    files = {seed: read_identified(robots_folder(out), seed, robots.robot) for seed in robots.seeds}
    identified = {seed: file for seed, file in files.items() if file is not None}
    comparison = RobotComparison(study, pd.concat(rows.values(), ignore_index=True))
    parameters = parameter_rows(study, identified, other_motors_folder(root / "robots"))
    readme = write_robot_report(comparison, parameters, out, command)
    if comparison.missing:
        console.print(f"Not in the report: {comparison.missing_text}")
    console.print(f"Report: {readme}")


def report(study: StudyConfig, root: Path, out: Path, command: str, console: Console) -> None:
    """Write tables, figures and README of a study, from all runs (of any group) that are finished and evaluated."""
    comparison = _collect(study, root)
    make_figures_folder(out)
    from surefoot.studies.study_report import write_report

    readme = write_report(comparison, out, command)
    if comparison.missing:
        console.print(f"Not in the report: {', '.join(comparison.missing)}")
    console.print(f"Report: {readme}")


def _collect(study: StudyConfig, root: Path) -> Comparison:
    """Return the results of all runs of a study (at least one) that are finished and have all evaluations."""
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
    """Return the row of a run; None if it is not finished, not evaluated, or differs from the study's configuration."""
    from surefoot.policy.runtime import PolicyRuntime
    from surefoot.studies.comparison import policy_row
    from surefoot.studies.evaluations import evaluation_names, stored_result

    if not _is_finished(run):
        return None
    results = {kind: stored_result(run.policy, kind) for kind in evaluation_names(study.evaluate)}
    stored = {kind: result for kind, result in results.items() if result is not None}
    if len(stored) < len(results):
        return None
    best = PolicyRuntime.load(run.policy).contract.figures.get("training", {}).get("steps")
    row = policy_row(run.group, run.config.seed, run.rows(), stored)
    return row | {"best_steps": best, "policy": run.policy}


def _is_finished(run: Training) -> bool:
    """Return whether a run is finished, with the configuration of the study."""
    if run.state != "finished":
        return False
    try:
        run.check()
    except SurefootError:
        return False
    return True
