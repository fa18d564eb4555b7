"""`surefoot study`: compare groups of trainings with several seeds, and run other kinds of studies."""

from __future__ import annotations

import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from surefoot.cli.helpers.options import PluginNames, Ray, Workers
from surefoot.cli.helpers.output import Actions, make_console, run_action
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.training_queue import train_many
from surefoot.configuration import Seed, Threads
from surefoot.errors import SurefootError, prefix_errors, suggest
from surefoot.learn.config import Steps
from surefoot.stop_signals import StopSignals
from surefoot.studies.hidden_robots import HiddenRobots, robot_name
from surefoot.studies.study_config import StudyConfig, load_study, study_runs
from surefoot.studies.training import Training
from surefoot.studies.workers import TrainingsOutcome, check_address
from surefoot.world.registry import check_takes_params


@dataclass(frozen=True)
class StudyCommand:
    """Train several groups with several seeds each, evaluate all policies, and write a report.

    Ctrl-C saves all running trainings. The same command continues later: finished runs are skipped, and others continue
    from their last checkpoint.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """YAML file of the study."""
    out: Path | None = None
    """Folder for the report, with run folders in its subfolder runs. Defaults to results/NAME and runs/NAME."""
    workers: Workers = 0
    ray: Ray = None
    plugin: PluginNames = ()
    seeds: tuple[Seed, ...] = ()
    """Seeds. Defaults to the seeds in the file."""
    steps: Steps | None = None
    """Control steps of every training. Defaults to the value in the file."""
    only: tuple[str, ...] = ()
    """Groups to train and evaluate. Defaults to all. The report always covers all finished runs."""
    train_only: bool = False
    """Stop after training, without evaluation and report."""
    extend: bool = False
    """Continue runs that were trained for fewer steps than the file now specifies, instead of rejecting them."""
    report_only: bool = False
    """Evaluate finished runs and write the report, without training."""


@dataclass(frozen=True)
class IdentifyCommand:
    """Identify the hidden robots of a study by four experiments each, as `surefoot study run` does at its beginning.

    The same command continues after an interruption: robots that have been identified are skipped.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """YAML file of the study."""
    out: Annotated[
        Path | None,
        tyro.conf.arg(
            help="Folder for the report, with subfolders robots for identified robots and runs for recordings. "
            "Defaults to results/NAME and runs/NAME.",
        ),
    ] = None
    workers: Annotated[Threads, tyro.conf.arg(help="Robots in parallel; 0 means one per core.")] = 0


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    word = argv[0] if argv else ""
    if word in ("", "-h", "--help") or word in ACTIONS:
        return run_action(argv, "study", ACTIONS)
    if not word.startswith("-") and not word.endswith((".yaml", ".yml")) and not Path(word).is_file():
        raise SurefootError(f"'{word}' is neither a study file (.yaml) nor an action; {suggest(word, ACTIONS)}")
    return _run(argv)


def _run(argv: list[str]) -> int:
    command = parse(StudyCommand, argv, "surefoot study run")
    if command.train_only and command.report_only:
        raise SurefootError("--train-only and --report-only can't be combined; give one of them, or neither")
    if command.extend and command.report_only:
        raise SurefootError("--extend continues trainings, and --report-only trains nothing; give one of them")
    check_address(command.ray)
    from surefoot.cli.helpers.study_results import (
        check_evaluations,
        evaluate_runs,
        report,
        report_robots,
        robots_folder,
    )

    whole = load_study(command.file)
    check_evaluations(whole, worlds=not command.train_only)
    if command.steps is not None:
        whole = whole.with_steps(command.steps)
    study = whole.with_seeds(command.seeds) if command.seeds else whole
    root, out = _folders(study, command.out)
    console, failed = make_console(), dict[str, str]()
    needs_robots = any(study.groups[name].identified for name in command.only or study.groups if name in study.groups)
    if study.robots is not None and needs_robots:
        if command.report_only:
            study.robots.check_settings(robots_folder(out))
        else:
            failed = identify(study.robots, study.name, root, out, command.workers, console)
    runs = study_runs(study, root, command.only, robots_folder(out))
    for run in runs:
        run.check(extend=command.extend)
    for run in runs if command.extend else []:
        run.extend()
    if not command.report_only:
        outcome = train(study, runs, command, console)
        failed |= outcome.failed
        if outcome.stopped:
            console.print("Stopped; all running trainings are saved. The same command continues them.")
            return 130
    if not command.train_only:
        evaluate_runs(study, runs, root, command.workers, console)
        write = report if study.robots is None else report_robots
        # The report names the command that makes it from nothing.
        words = [word for word in argv if word.replace("_", "-") != "--report-only"]
        again = shlex.join(["surefoot", "study", "run", *words])
        write(whole.with_more_seeds(command.seeds), root, out, again, console)
    return _end(failed)


def _folders(study: StudyConfig, out: Path | None) -> tuple[Path, Path]:
    """Return the folders of a study's runs and of its report."""
    return (Path("runs") / study.name, Path("results") / study.name) if out is None else (out / "runs", out)


def _end(failed: dict[str, str]) -> int:
    """Print the failures; return the exit code."""
    for name, line in failed.items():
        print(f"surefoot: error: {name}: {line}", file=sys.stderr)
    return 1 if failed else 0


def _identify(argv: list[str]) -> int:
    """Identify the hidden robots of a study."""
    command = parse(IdentifyCommand, argv, "surefoot study identify")
    study = load_study(command.file)
    if study.robots is None:
        raise SurefootError(f"{command.file}: the study has no hidden robots to identify")
    check_takes_params(study.robots.world)
    return _end(identify(study.robots, study.name, *_folders(study, command.out), command.workers, make_console()))


def identify(robots: HiddenRobots, name: str, root: Path, out: Path, workers: int, console: Console) -> dict[str, str]:
    """Identify the remaining robots of a study; return the errors of failed identifications, by robot name.

    Raises:
        KeyboardInterrupt: stopped by the operator.
    """
    from surefoot.cli.helpers.study_results import robots_folder
    from surefoot.studies.robot_identification import identify_robots, unidentified_robots

    folder = robots_folder(out)
    robots.check_settings(folder)
    waiting, start, count = unidentified_robots(robots, folder), time.perf_counter(), 0
    if not waiting:
        console.print(f"{name}: all {len(robots.seeds)} robots are identified")
        return {}
    console.print(f"{name}: {len(waiting)} of {len(robots.seeds)} robots to identify")

    def ended(seed: int, error: str) -> None:
        nonlocal count
        count += 1
        state = "failed" if error else "identified"
        seconds = time.perf_counter() - start
        console.print(f"{count:>3} of {len(waiting)}  {robot_name(seed)} {state}  (after {seconds:.0f} s)")

    with StopSignals(respect_nohup=True) as stops:
        failed = identify_robots(robots, folder, root / "robots", workers, ended, lambda: stops.count > 0)
    if stops.count:
        console.print("Stopped; identified robots are saved. The same command continues.")
        raise KeyboardInterrupt
    return {robot_name(seed): error for seed, error in failed.items()}


def train(study: StudyConfig, runs: list[Training], command: StudyCommand, console: Console) -> TrainingsOutcome:
    """Train all runs that are not finished, several in parallel."""
    from surefoot.api.training import check_config

    waiting = [run for run in runs if run.state != "finished"]
    if not waiting:
        console.print(f"{study.name}: all {len(runs)} trainings are finished")
        return TrainingsOutcome()
    for group, run in {run.group: run for run in waiting}.items():
        with prefix_errors(f"group {group}"):
            check_config(run.config)
    title = f"{study.name}: {len(runs)} trainings, {len(runs) - len(waiting)} finished"
    return train_many(title, waiting, command.workers, command.ray, console)


ACTIONS: Actions = {
    "run": ("compare groups of trainings as a study file says; also: surefoot study FILE.yaml", _run),
    "identify": ("only identify the hidden robots of a study, which run does first", _identify),
    "search": ("search hyperparameters and task settings with many trainings", "surefoot.cli.study_search"),
    "tune": ("optimize a handcrafted gait for a robot and a speed", "surefoot.cli.study_tune"),
    "paper": ("write a page that compares the paper with surefoot's results", "surefoot.cli.study_paper"),
}
