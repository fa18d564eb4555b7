"""Queue of trainings on Ray, with a display: one line per start and end, and a table of running trainings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Self

from rich.console import Console
from rich.table import Table

from surefoot.api.training import error_text
from surefoot.progress import ProgressDisplay
from surefoot.stop_signals import StopSignals
from surefoot.studies.training import Training
from surefoot.studies.workers import ProgressReport, TrainingsOutcome, ray_cluster, run_trainings

_LINE_PERIOD = 60.0
"""Minimum time between two lines on one training without a terminal [s]."""


def train_many(
    title: str,
    trainings: Iterable[Training],
    workers: int,
    address: str | None,
    console: Console,
    on_report: Callable[[Training, ProgressReport], bool] = lambda *_: False,
    on_change: Callable[[Training, str, str], None] = lambda *_: None,
) -> TrainingsOutcome:
    """Run trainings on this machine or on a Ray cluster, show their progress, and stop on Ctrl-C.

    Args:
        title: title of the display.
        trainings: as for `run_trainings`.
        workers: number of trainings in parallel.
        address: HOST:PORT of a Ray cluster; defaults to this machine.
        console: where to show it.
        on_report: called with the progress of a training; returning true prunes it.
        on_change: called when a training starts or ends.

    Raises:
        SurefootError: there is no cluster at the address.
    """

    def announce(count: int) -> None:
        if count == 1:
            console.print("Stopping after the present updates; press Ctrl-C again to stop immediately.")

    display = QueueDisplay(title, console)

    def report(training: Training, progress: ProgressReport) -> bool:
        display.report_progress(training, progress)
        return on_report(training, progress)

    def report_change(training: Training, event: str, reason: str) -> None:
        on_change(training, event, reason)
        display.report_change(training, event)

    # Ray installs signal handlers as well, and only the last handlers are called.
    with ray_cluster(address, workers), StopSignals(on_signal=announce, respect_nohup=True) as stops, display:
        return run_trainings(trainings, workers, report, report_change, lambda: stops.count)


@dataclass
class _Row:
    """State of one training in the display."""

    training: Training
    state: str = ""
    steps: int = 0
    speed: float | None = None
    evaluation: dict[str, Any] | None = None
    rate: float = 0.0
    since: float = 0.0
    first: int = 0

    def cells(self) -> tuple[str, ...]:
        """Return the cells of the training's line."""
        config = self.training.config
        total = config.updates * config.samples_per_update
        speed = "-" if self.speed is None else f"{self.speed:.2f} m/s"
        returned = falls = "-"
        if self.evaluation is not None:
            rmse = self.evaluation.get("rmse")  # only of a task with commands, whose return is not a distance
            returned = f"{self.evaluation['return_mean']:.2f}" + ("" if rmse else " m")
            speed = f"error {error_text(rmse)}" if rmse else speed
            falls = f"{self.evaluation['falls']} of {config.evaluation_episodes}"
            if config.task.pushes.enabled:
                falls += f", pushed {self.evaluation['pushed_falls']}"
        left = f"{(total - self.steps) / self.rate / 60:.0f} min left" if self.rate else ""
        steps = f"{self.steps:,} of {total:,}"
        return self.training.title, str(config.seed), self.state, steps, speed, returned, falls, left

    def line(self) -> str:
        """Return the training's line for a log."""
        group, seed, state, steps, speed, returned, falls, left = self.cells()
        line = f"{group:<20} seed {seed:<3} {state:<9} {steps} steps  {speed}  return {returned}  falls {falls}  {left}"
        return line.rstrip()


class QueueDisplay(ProgressDisplay):
    """Table of running trainings, and one line for each start and end.

    Args:
        title: title of the table.
        console: where to show it.
    """

    def __init__(self, title: str, console: Console) -> None:
        # These must exist before the display draws its table for the first time.
        self._title = title
        self._rows: dict[str, _Row] = {}
        super().__init__(console, self._table, _LINE_PERIOD)

    def __enter__(self) -> Self:
        """Print the title, and start the display."""
        self.print(self._title)
        return super().__enter__()

    def report_progress(self, training: Training, progress: ProgressReport) -> None:
        """Show the progress of a training."""
        row = self._rows[training.name]
        row.steps = progress.steps
        row.speed = row.speed if progress.speed is None else progress.speed
        row.evaluation = progress.evaluations[-1] if progress.evaluations else row.evaluation
        now = time.monotonic()
        if not row.since:
            row.since, row.first = now, row.steps
        elif now > row.since:
            row.rate = (row.steps - row.first) / (now - row.since)
        self.refresh(row.line(), training.name)

    def report_change(self, training: Training, event: str) -> None:
        """Show that a training started or ended."""
        row = self._rows.setdefault(training.name, _Row(training))
        row.state = {"started": "training", "done": "finished"}.get(event, event)
        if event != "started":
            row.rate, row.since = 0.0, 0.0
        self.print(row.line(), training.name)

    def _table(self) -> Table:
        table = Table(title=self._title, title_justify="left", box=None)
        for name in ("group", "seed", "state", "steps", "speed", "return", "falls", ""):
            table.add_column(name, justify="right" if name in ("seed", "steps", "speed", "return") else "left")
        for row in self._rows.values():
            if row.state in ("training", "lost"):
                table.add_row(*row.cells())
        return table
