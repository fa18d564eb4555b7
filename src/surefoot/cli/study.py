"""`surefoot study`: groups of trainings with several seeds and one evaluation of all of them; other studies by name."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from surefoot.cli.helpers.options import PluginNames, Ray, Workers
from surefoot.cli.helpers.output import Actions, make_console, run_action
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.training_queue import train_many
from surefoot.configuration import Seed
from surefoot.errors import SurefootError, prefix_errors, suggest
from surefoot.learn.config import Steps
from surefoot.studies.study_config import StudyConfig, load_study, study_runs
from surefoot.studies.training import Training
from surefoot.studies.workers import TrainingsOutcome, check_address


@dataclass(frozen=True)
class StudyCommand:
    """Train several groups with several seeds each, evaluate all policies, and write a report.

    The same command, run again, goes on where it was stopped: finished runs are skipped, others go on from their
    last checkpoint. Ctrl-C saves every run under way.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """YAML file of the study."""
    out: Path | None = None
    """Folder for the report with tables and figures, and for the runs, in runs/; results/NAME and runs/NAME, if not
    given."""
    workers: Workers = 0
    ray: Ray = None
    plugin: PluginNames = ()
    seeds: tuple[Seed, ...] = ()
    """Seeds in place of the file's."""
    steps: Steps | None = None
    """Control steps of every training in place of the file's."""
    only: tuple[str, ...] = ()
    """Groups to train and evaluate; all if not given. The report covers whatever is there."""
    train_only: bool = False
    """Stop after training: no evaluation, no report."""
    extend: bool = False
    """Go on with runs that were trained for fewer steps than the file now asks for, in place of refusing them."""
    report_only: bool = False
    """Train nothing: evaluate the runs that are finished, and report what is there."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    word = argv[0] if argv else ""
    if word in ("", "-h", "--help") or word in ACTIONS:
        return run_action(argv, "study", ACTIONS)
    if not word.startswith("-") and not word.endswith((".yaml", ".yml")) and not Path(word).is_file():
        raise SurefootError(f"'{word}' is neither the file of a study (.yaml) nor an action; {suggest(word, ACTIONS)}")
    return _run(argv)


def _run(argv: list[str]) -> int:
    command = parse(StudyCommand, argv, "surefoot study run")
    if command.train_only and command.report_only:
        raise SurefootError("--train-only and --report-only leave nothing to do; give one of them, or neither")
    from surefoot.cli.helpers.study_results import check_evaluations, evaluate_runs, report

    study = load_study(command.file)
    check_evaluations(study, worlds=not command.train_only)
    if command.seeds:
        study = replace(study, seeds=command.seeds)
    if command.steps is not None:
        study = study.with_steps(command.steps)
    root = Path("runs") / study.name if command.out is None else command.out / "runs"
    runs = study_runs(study, root, command.only)
    for run in runs:
        run.check(extend=command.extend)
    for run in runs if command.extend else []:
        run.extend()
    console = make_console()
    failed: dict[str, str] = {}
    if not command.report_only:
        outcome = train(study, runs, command, console)
        failed = outcome.failed
        if outcome.stopped:
            console.print("Stopped; every run under way is saved. The same command goes on.")
            return 130
    if not command.train_only:
        evaluate_runs(study, runs, command.workers, console)
        words = shlex.join(["surefoot", "study", *argv])
        report(study, root, command.out or Path("results") / study.name, words, console)
    for name, line in failed.items():
        print(f"surefoot: error: {name}: {line}", file=sys.stderr)
    return 1 if failed else 0


def train(study: StudyConfig, runs: list[Training], command: StudyCommand, console: Console) -> TrainingsOutcome:
    """Train every run that is not finished, some at a time."""
    from surefoot.api.training import check_config

    waiting = [run for run in runs if run.state != "finished"]
    if not waiting:
        console.print(f"{study.name}: all {len(runs)} trainings are finished")
        return TrainingsOutcome()
    check_address(command.ray)
    for group, run in {run.group: run for run in waiting}.items():
        with prefix_errors(f"group {group}"):
            check_config(run.config)
    title = f"{study.name}: {len(runs)} trainings, {len(runs) - len(waiting)} finished"
    return train_many(title, waiting, command.workers, command.ray, console)


ACTIONS: Actions = {
    "run": ("run the study of a file (`surefoot study FILE.yaml` does, too): groups of trainings, compared", _run),
    "search": ("train many times with searched settings, and see what emerges", "surefoot.cli.study_search"),
    "tune": ("find a handcrafted gait for a robot and a speed", "surefoot.cli.study_tune"),
    "paper": ("write one page: the paper and surefoot's results side by side", "surefoot.cli.study_paper"),
}
