"""Progress display of all commands: redrawn in place on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

_REDRAW_PERIOD = 0.05
"""Minimum time between two redraws [s]; a deployment reports its state every 0.1 s."""
_LINE_PERIOD = 10.0
"""Minimum time between two lines of a bar without a terminal [s]."""
_MAX_LINE_PERIOD = 60.0
"""Upper limit of the interval between two lines of a percentage, which doubles with each line [s]."""


class ProgressDisplay:
    """Context manager that shows the progress of some work.

    Args:
        console: console to print to.
        draw: function that returns the display for a terminal.
        line_period: minimum time between two lines on one topic without a terminal [s]; None disables lines.
        transient: remove the display at the end.
    """

    def __init__(
        self,
        console: Console,
        draw: Callable[[], RenderableType],
        line_period: float | None = None,
        transient: bool = False,
    ) -> None:
        self._console, self._line_period = console, line_period
        self._live = Live(get_renderable=draw, console=console, auto_refresh=False, transient=transient)
        self._started, self._drawn = time.monotonic(), 0.0
        self._printed: dict[str, float] = {}

    def __enter__(self) -> Self:
        """Start the display."""
        if self._console.is_terminal:
            self._live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        """Redraw a last time, and stop the display."""
        self._live.stop()

    def print(self, line: str, topic: str = "") -> None:
        """Print a permanent line; on a terminal it appears above the display."""
        self._printed[topic] = time.monotonic()
        self._console.print(line, highlight=False, soft_wrap=True, markup=False, emoji=False)

    def refresh(self, line: str = "", topic: str = "", force_line: bool = False) -> bool:
        """Redraw the display on a terminal; elsewhere print a line if it is due for its topic, or forced.

        Returns:
            Whether a line was printed.
        """
        now = time.monotonic()
        if self._console.is_terminal:
            if now - self._drawn > _REDRAW_PERIOD:
                self._drawn = now
                self._live.refresh()
            return False
        age = now - self._printed.get(topic, self._started)
        if self._line_period is not None and (force_line or age > self._line_period):
            self.print(line, topic)
            return True
        return False


class ProgressBar(ProgressDisplay):
    """Progress bar with a percentage or a count.

    A percentage is removed at the end; a count stays. Without a terminal both print lines.

    Args:
        title: name of the work.
        console: console to print to; defaults to standard error.
        count: total to count up to; by default a percentage is shown.
        done: count at the start.
    """

    def __init__(self, title: str, console: Console | None = None, count: int | None = None, done: int = 0) -> None:
        console, self._total = console or Console(stderr=True), count or 1.0
        number = TaskProgressColumn() if count is None else MofNCompleteColumn()
        self._title, self._count = title, count
        columns = (TextColumn("{task.description}", markup=False), BarColumn(None if count else 40), number)
        text = (TextColumn("{task.fields[text]}"), TimeRemainingColumn())
        self._bar = Progress(*columns, *text, console=console, expand=count is not None)
        self._task = self._bar.add_task(title, total=self._total, completed=done, text="")
        super().__init__(console, lambda: self._bar, _LINE_PERIOD, transient=count is None)

    def advance(self, done: float, text: str = "", line: str = "") -> None:
        """Show the amount of work done so far, with `text` on a terminal and `line` elsewhere."""
        self._bar.update(self._task, completed=done, text=text)
        if self._count is not None:
            self.refresh(line, force_line=done >= self._total)
        elif self.refresh(f"{self._title}: {done:.0%}"):
            self._line_period = min(2 * (self._line_period or 0.0), _MAX_LINE_PERIOD)
