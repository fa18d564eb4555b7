"""Many trainings on Ray, with a display: a line for each that begins or ends, a table of those under way."""

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
"""Least time between two lines on one training, where there is no terminal [s]."""


def train_many(
    title: str,
    trainings: Iterable[Training],
    workers: int,
    address: str | None,
    console: Console,
    on_report: Callable[[Training, ProgressReport], bool] = lambda *_: False,
    on_change: Callable[[Training, str, str], None] = lambda *_: None,
) -> TrainingsOutcome:
    """Train on this machine or on the Ray cluster at an address, show the progress, and stop by Ctrl-C.

    Args:
        title: what is trained.
        trainings: as for `run_trainings`.
        workers: how many run at a time.
        address: HOST:PORT of a cluster; this machine, if None.
        console: where to show it.
        on_report: called with the progress of a training; true prunes it.
        on_change: called when a training starts or ends.

    Raises:
        SurefootError: no cluster at the address.
    """

    def announce(count: int) -> None:
        if count == 1:
            console.print("Stopping after the updates under way; once more stops at once.")

    display = QueueDisplay(title, console)

    def report(training: Training, progress: ProgressReport) -> bool:
        display.report_progress(training, progress)
        return on_report(training, progress)

    def changed(training: Training, what: str, why: str) -> None:
        on_change(training, what, why)
        display.report_change(training, what)

    # Ray listens to signals as well, and only the last one who began to listen hears them.
    with ray_cluster(address, workers), StopSignals(on_signal=announce, respect_nohup=True) as stops, display:
        return run_trainings(trainings, workers, report, changed, lambda: stops.count)


@dataclass
class _Row:
    """State of one training, as the display shows it."""

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
        gained = falls = "-"
        if self.evaluation is not None:
            rmse = self.evaluation.get("rmse")  # whose task has commands, and a return that is no distance
            gained = f"{self.evaluation['return_mean']:.2f}" + ("" if rmse else " m")
            speed = f"error {error_text(rmse)}" if rmse else speed
            falls = f"{self.evaluation['falls']} of {config.evaluation_episodes}"
            if config.task.pushes.enabled:
                falls += f", pushed {self.evaluation['pushed_falls']}"
        left = f"{(total - self.steps) / self.rate / 60:.0f} min left" if self.rate else ""
        steps = f"{self.steps:,} of {total:,}"
        return self.training.title, str(config.seed), self.state, steps, speed, gained, falls, left

    def line(self) -> str:
        """Return the training's line for a log."""
        group, seed, state, steps, speed, gained, falls, left = self.cells()
        line = f"{group:<20} seed {seed:<3} {state:<9} {steps} steps  {speed}  return {gained}  falls {falls}  {left}"
        return line.rstrip()


class QueueDisplay(ProgressDisplay):
    """Table of the trainings under way, and a line for each that starts or ends.

    Args:
        title: title of the table.
        console: where to show it.
    """

    def __init__(self, title: str, console: Console) -> None:
        # The display draws its table at once.
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
