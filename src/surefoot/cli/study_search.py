"""`surefoot study search`: hyperparameter search with Optuna, and a report of its result."""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from surefoot.cli.helpers.options import PluginNames, Ray, Seed, Workers, check_folder, make_figures_folder
from surefoot.cli.helpers.output import make_console
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.training_queue import train_many
from surefoot.configuration import Within
from surefoot.errors import prefix_errors
from surefoot.learn.config import Steps
from surefoot.studies.search import Search, SearchConfig, check_search_folder, make_config
from surefoot.studies.search_space import with_values
from surefoot.studies.workers import check_address


@dataclass(frozen=True)
class SearchCommand:
    """Search hyperparameters and task settings: run many trainings (trials), prune weak ones, and report the result.

    Ctrl-C saves all running trials. The same command with --resume continues, even after a crash. Files in --out: the
    journal (trials.log), one run folder per trial (trials/), tables, figures and README.md.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """Name of a released task, or the path of a YAML file."""
    trials: Annotated[int, Within(1, 100_000)] = 100
    """Total number of trials, including those that already exist."""
    workers: Workers = 0
    space: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="FILE",
            help="YAML file of the search space: fields of the training's configuration with their ranges or choices. "
            "Defaults to the released space.",
        ),
    ] = None
    ray: Ray = None
    plugin: PluginNames = ()
    out: Path | None = None
    """Folder for all results. Defaults to searches/NAME."""
    seed: Seed = 0
    steps: Steps = 600_000
    """Control steps of a complete trial."""
    resume: bool = False
    """Continue the search in the folder --out."""
    report_only: bool = False
    """Write the report of the existing trials, without training."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(SearchCommand, argv, "surefoot study search")
    from surefoot.learn.folder_lock import folder_lock

    config = make_config(command.task, command.space, command.seed, command.steps)
    if not command.report_only:
        check_address(command.ray)
    out = command.out or Path("searches") / config.train.task.name
    check_folder(out)
    continues = command.resume or command.report_only
    if continues:
        check_search_folder(out)
    _check(config)
    console = make_console()
    out.mkdir(parents=True, exist_ok=True)
    with folder_lock(out):
        search = Search(config, out, continues)
        for note in search.notes:
            console.print(note)
        if not command.report_only and _train(search, command, console):
            again = shlex.join(["surefoot", "study", "search", *argv, *([] if command.resume else ["--resume"])])
            console.print(f"Stopped; all running trials are saved. To continue:\n  {again}")
            return 130
        from surefoot.studies.search_report import write_report
        from surefoot.studies.search_result import collect_result

        make_figures_folder(out)
        with console.status("evaluating") as status:
            result = collect_result(search, status.update)
        console.print(f"Report: {write_report(result, out, shlex.join(['surefoot', 'study', 'search', *argv]))}")
    return 0


def _check(config: SearchConfig) -> None:
    """Check, before any training, that the task can be simulated as it is and at both ends of every range."""
    from surefoot.api.training import check_config

    check_config(config.train)
    for end in (0, -1):
        values = {name: one.samples[end] for name, one in config.space.items()}
        with prefix_errors("space"):
            check_config(with_values(config.train, config.space, values))


def _train(search: Search, command: SearchCommand, console: Console) -> bool:
    """Run the missing trials; return whether they were stopped."""
    counts = search.counts
    states = ", ".join(f"{count} {state}" for state, count in counts.items()) or "none yet"
    title = f"{search.config.train.task.name}: {command.trials} trials, {states}"
    if sum(counts.values()) >= command.trials and "running" not in counts:
        console.print(title)
        return False
    start = time.monotonic()
    trainings, where = search.trainings(command.trials), (command.workers, command.ray, console)
    outcome = train_many(title, trainings, *where, search.on_report, search.on_change)
    hours = (time.monotonic() - start) / 3600
    console.print(f"{len(outcome.done)} trials in {60 * hours:.1f} min: {len(outcome.done) / hours:.1f} per hour")
    for name, line in outcome.failed.items():
        console.print(f"failed: {name}: {line}")
    return outcome.stopped
