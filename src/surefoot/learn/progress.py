"""Live progress of a training run on a terminal; plain lines where there is none."""

from __future__ import annotations

import functools
import math
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from surefoot.learn.config import TrainConfig
from surefoot.learn.run import Evaluation
from surefoot.learn.trainer import UpdateFigures

_LINE_EVERY = 10.0


class TrainingProgress:
    """Display of steps, steps per second, speed, return, falls and the time left; one line per evaluation.

    Args:
        config: the run.
        console: where to show it.
        done: control steps done before, by the part of the run that is resumed.
    """

    def __init__(self, config: TrainConfig, console: Console, done: int = 0) -> None:
        self._console, self._total = console, config.updates * config.samples_per_update
        self._print = functools.partial(console.print, highlight=False, soft_wrap=True)
        self._start, self._first = time.perf_counter(), done
        self._return = self._speed = math.nan
        self._spoke = 0.0
        self._bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            expand=True,
        )
        self._task = self._bar.add_task(config.task.name, total=self._total, completed=done, figures="")

    def __enter__(self) -> TrainingProgress:
        """Start the display."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the display."""
        self._bar.stop()

    def update(self, figures: UpdateFigures, evaluation: Evaluation | None) -> None:
        """Show the figures of an update."""
        steps = figures.steps
        if not math.isnan(figures.return_mean):
            self._return, self._speed = figures.return_mean, figures.speed_mean
        seconds = time.perf_counter() - self._start
        rate = (steps - self._first) / seconds
        text = f"{rate:,.0f} steps/s  speed {self._speed:.2f} m/s  return {self._return:.2f}"
        self._bar.update(self._task, completed=steps, figures=text)
        if not self._console.is_terminal and (seconds - self._spoke > _LINE_EVERY or steps >= self._total):
            self._spoke = seconds
            left = (self._total - steps) / rate
            self._print(f"{steps:>9,} of {self._total:,} steps  {text}  {left:.0f} s left")
        if evaluation is not None:
            pushed = f", {evaluation.pushed_falls} with pushes" if evaluation.pushed_falls else ""
            self._print(
                f"{evaluation.steps:>9,} steps, evaluated: {evaluation.speed_mean:.2f} m/s, "
                f"return {evaluation.return_mean:.2f}, {evaluation.power_mean:.0f} W, {evaluation.falls} falls{pushed}"
            )
