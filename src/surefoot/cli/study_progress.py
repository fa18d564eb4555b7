"""How far the runs of a study are: a table that is kept up to date on a terminal, plain lines where there is none."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from surefoot.learn.study_config import StudyConfig, StudyRun
from surefoot.learn.workers import Job

_LINE_EVERY = 60.0


@dataclass
class _Row:
    """What is known of one run."""

    run: StudyRun
    state: str
    steps: int = 0
    speed: float | None = None
    evaluation: dict[str, Any] | None = None
    rate: float = 0.0
    since: float = 0.0
    first: int = 0
    spoke: float = 0.0

    @property
    def total(self) -> int:
        return self.run.config.updates * self.run.config.samples_per_update

    def cells(self) -> tuple[str, ...]:
        """The run's line, cell by cell."""
        speed = "-" if self.speed is None else f"{self.speed:.2f} m/s"
        falls = "-"
        if self.evaluation is not None:
            episodes = self.run.config.evaluation_episodes
            falls = f"{self.evaluation['falls']} of {episodes}"
            if self.run.config.task.pushes.enabled:
                falls += f", pushed {self.evaluation['pushed_falls']}"
        left = f"{(self.total - self.steps) / self.rate / 60:.0f} min left" if self.rate else ""
        steps = f"{self.steps:,} of {self.total:,}"
        return self.run.group, str(self.run.config.seed), self.state, steps, speed, falls, left


class StudyProgress:
    """Shows one line a run: group, seed, state, steps done, speed in training, falls in its last evaluation.

    Args:
        study: the study.
        runs: its runs.
        workers: how many run at a time.
        console: where to show it.
    """

    def __init__(self, study: StudyConfig, runs: list[StudyRun], workers: int, console: Console) -> None:
        self._title, self._console, self._workers = study.name, console, workers
        self._rows = {run.name: _row(run) for run in runs}
        self._live = Live(console=console, refresh_per_second=2, get_renderable=self._table)

    def __enter__(self) -> StudyProgress:
        """Start the display."""
        done = sum(row.state == "finished" for row in self._rows.values())
        self._console.print(
            f"{self._title}: {len(self._rows)} trainings, {done} finished, {self._workers} at a time",
        )
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the display."""
        if self._console.is_terminal:
            self._live.stop()

    def event(self, job: Job, event: dict[str, Any]) -> None:
        """Take in the figures of an update."""
        row = self._rows[job.name]
        row.steps = event["steps"]
        row.speed = event.get("speed", row.speed)
        row.evaluation = event.get("evaluation", row.evaluation)
        now = time.monotonic()
        if not row.since:
            row.since, row.first = now, row.steps
        elif now > row.since:
            row.rate = (row.steps - row.first) / (now - row.since)
        if not self._console.is_terminal and now - row.spoke > _LINE_EVERY:
            row.spoke = now
            self._say(row)

    def change(self, job: Job, what: str) -> None:
        """Take in that a run started or ended."""
        row = self._rows[job.name]
        row.state = {"started": "training", "done": "finished"}.get(what, what)
        row.rate = 0.0 if what != "started" else row.rate
        row.spoke = time.monotonic()
        if not self._console.is_terminal:
            self._say(row)

    def _say(self, row: _Row) -> None:
        group, seed, state, steps, speed, falls, left = row.cells()
        line = f"{group:<20} seed {seed:<3} {state:<9} {steps} steps  {speed}  falls {falls}  {left}"
        self._console.print(line.rstrip())

    def _table(self) -> Table:
        table = Table(title=self._title, title_justify="left", box=None)
        for name in ("group", "seed", "state", "steps", "speed", "falls", ""):
            table.add_column(name, justify="right" if name in ("seed", "steps", "speed") else "left")
        for row in self._rows.values():
            style = {"training": "bold", "failed": "red", "finished": "green"}.get(row.state, "dim")
            table.add_row(*row.cells(), style=style)
        return table


def _row(run: StudyRun) -> _Row:
    """What a run's folder tells."""
    state = run.state
    row = _Row(run, {"new": "waiting", "started": "paused"}.get(state, state))
    for figures in run.rows() if state != "new" else []:
        row.steps = figures["steps"]
        row.speed = row.speed if figures["speed_mean"] is None else figures["speed_mean"]
        row.evaluation = figures.get("evaluation", row.evaluation)
    return row
