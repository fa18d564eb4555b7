"""The progress display of all commands: a picture that a terminal redraws in place, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

_REDRAW_PERIOD = 0.05
"""Least time between two drawings [s], under the .1 s in which a deployment reports its state."""
_LINE_PERIOD = 10.0
"""Least time between two lines of a bar where there is no terminal [s]."""
_MAX_LINE_PERIOD = 60.0
"""The same for a percentage, whose lines come at growing intervals [s]."""


class ProgressDisplay:
    """Show the progress of some work while entered.

    Args:
        console: where to show it.
        draw: returns the picture for a terminal.
        line_period: least time between two lines on one topic where there is no terminal [s]; no lines, if None.
        transient: remove the picture at the end.
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
        """Draw once more, and stop the display."""
        self._live.stop()

    def print(self, line: str, topic: str = "") -> None:
        """Print a line that stays; on a terminal it stands above the picture."""
        self._printed[topic] = time.monotonic()
        self._console.print(line, highlight=False, soft_wrap=True, markup=False, emoji=False)

    def refresh(self, line: str = "", topic: str = "", force_line: bool = False) -> bool:
        """Redraw the picture on a terminal; elsewhere print a line, if it is forced or the topic's last one is old.

        Returns:
            whether a line was printed.
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
    """A bar that shows how much of some work is done.

    A percentage is removed at the end, a count stays. Elsewhere than on a terminal both have lines.

    Args:
        title: name of the work.
        console: where to show it; standard error, if not given.
        count: amount of work to count; a percentage is shown, if None.
        done: amount of a count that was done before.
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
        """Show the amount of work that is done, with a text on a terminal and a line elsewhere."""
        self._bar.update(self._task, completed=done, text=text)
        if self._count is not None:
            self.refresh(line, force_line=done >= self._total)
        elif self.refresh(f"{self._title}: {done:.0%}"):
            self._line_period = min(2 * (self._line_period or 0.0), _MAX_LINE_PERIOD)
