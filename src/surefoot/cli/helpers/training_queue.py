"""Many trainings on Ray, with a display: a line for each that begins or ends, a table of those under way."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from surefoot.stop_signals import StopSignals
from surefoot.studies.training import Training
from surefoot.studies.workers import ProgressReport, TrainingsOutcome, ray_cluster, run_trainings

_LINE_EVERY = 60.0


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

    def say(count: int) -> None:
        if count == 1:
            console.print("Stopping after the updates under way; once more stops at once.")

    progress = _Progress(title, console)

    def report(training: Training, progress_report: ProgressReport) -> bool:
        progress.told(training, progress_report)
        return on_report(training, progress_report)

    def changed(training: Training, what: str, why: str) -> None:
        on_change(training, what, why)
        progress.change(training, what)

    # Ray listens to signals as well, and only the last one who began to listen hears them.
    with ray_cluster(address, workers), StopSignals(on_signal=say, respect_nohup=True) as stops, progress:
        return run_trainings(trainings, workers, report, changed, lambda: stops.count)


@dataclass
class _Row:
    """What is known of one training."""

    training: Training
    state: str = ""
    steps: int = 0
    speed: float | None = None
    evaluation: dict[str, Any] | None = None
    rate: float = 0.0
    since: float = 0.0
    first: int = 0
    spoke: float = 0.0

    def cells(self) -> tuple[str, ...]:
        """The training's line, cell by cell."""
        config = self.training.config
        total = config.updates * config.samples_per_update
        speed = "-" if self.speed is None else f"{self.speed:.2f} m/s"
        gained = falls = "-"
        if self.evaluation is not None:
            gained = f"{self.evaluation['return_mean']:.2f} m"
            falls = f"{self.evaluation['falls']} of {config.evaluation_episodes}"
            if config.task.pushes.enabled:
                falls += f", pushed {self.evaluation['pushed_falls']}"
        left = f"{(total - self.steps) / self.rate / 60:.0f} min left" if self.rate else ""
        steps = f"{self.steps:,} of {total:,}"
        return self.training.group, str(config.seed), self.state, steps, speed, gained, falls, left


class _Progress:
    """The display.

    Args:
        title: over the table.
        console: where to show it.
    """

    def __init__(self, title: str, console: Console) -> None:
        self._title, self._console = title, console
        self._rows: dict[str, _Row] = {}
        self._live = Live(console=console, refresh_per_second=2, get_renderable=self._table)

    def __enter__(self) -> _Progress:
        """Start the display."""
        self._console.print(self._title)
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the display."""
        if self._console.is_terminal:
            self._live.stop()

    def told(self, training: Training, told: ProgressReport) -> None:
        """Take in how far a training is."""
        row = self._rows[training.name]
        row.steps = told.steps
        row.speed = row.speed if told.speed is None else told.speed
        row.evaluation = told.evaluations[-1] if told.evaluations else row.evaluation
        now = time.monotonic()
        if not row.since:
            row.since, row.first = now, row.steps
        elif now > row.since:
            row.rate = (row.steps - row.first) / (now - row.since)
        if not self._console.is_terminal and now - row.spoke > _LINE_EVERY:
            self._say(row)

    def change(self, training: Training, what: str) -> None:
        """Take in that a training began or ended."""
        row = self._rows.setdefault(training.name, _Row(training))
        row.state = {"started": "training", "done": "finished"}.get(what, what)
        if what != "started":
            row.rate, row.since = 0.0, 0.0
        self._say(row)

    def _say(self, row: _Row) -> None:
        row.spoke = time.monotonic()
        group, seed, state, steps, speed, gained, falls, left = row.cells()
        line = f"{group:<20} seed {seed:<3} {state:<9} {steps} steps  {speed}  return {gained}  falls {falls}  {left}"
        self._console.print(line.rstrip())

    def _table(self) -> Table:
        table = Table(title=self._title, title_justify="left", box=None)
        for name in ("group", "seed", "state", "steps", "speed", "return", "falls", ""):
            table.add_column(name, justify="right" if name in ("seed", "steps", "speed", "return") else "left")
        for row in self._rows.values():
            if row.state in ("training", "lost"):
                table.add_row(*row.cells())
        return table
