"""Progress display on a terminal and in a log."""

from __future__ import annotations

import io

import pytest
from rich.console import Console
from rich.text import Text

from surefoot import progress
from surefoot.progress import ProgressBar, ProgressDisplay


def console(terminal: bool) -> tuple[Console, io.StringIO]:
    stream = io.StringIO()
    return Console(file=stream, force_terminal=terminal, width=100), stream


def test_terminal_shows_the_display_below_the_lines():
    place, stream = console(terminal=True)
    with ProgressDisplay(place, lambda: Text("display"), line_period=0.0) as display:
        display.refresh("a line for logs", force_line=True)
        display.print("a permanent line")
    shown = stream.getvalue()
    assert "a line for logs" not in shown
    assert shown.rindex("display") > shown.index("a permanent line")


def test_log_has_one_line_per_topic_and_period(monkeypatch: pytest.MonkeyPatch):
    now = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    place, stream = console(terminal=False)
    with ProgressDisplay(place, lambda: Text("display"), line_period=10.0) as display:
        for now in (101.0, 111.0, 112.0, 122.0):
            display.refresh(f"first at {now:g}", "first")
        display.refresh("second", "second")
        display.refresh("forced", "second", force_line=True)
    assert stream.getvalue().splitlines() == ["first at 111", "first at 122", "second", "forced"]


def test_lines_are_printed_as_they_are():
    place, stream = console(terminal=False)
    with ProgressDisplay(place, lambda: Text("display"), line_period=0.0) as display:
        display.refresh("trial [b] of :cat: [/]", force_line=True)
    assert stream.getvalue() == "trial [b] of :cat: [/]\n"


def test_bar_shows_a_percentage_on_a_terminal_and_nothing_in_a_short_log():
    for terminal in (True, False):
        place, stream = console(terminal)
        with ProgressBar("trot", place) as bar:
            bar.advance(0.25)
            bar.advance(1.0)
        assert ("100%" in stream.getvalue()) == terminal
        assert ("trot" in stream.getvalue()) == terminal


def test_percentages_in_a_log_are_printed_at_growing_intervals(monkeypatch: pytest.MonkeyPatch):
    now = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    place, stream = console(terminal=False)
    with ProgressBar("trot", place) as bar:
        for now in range(101, 400):
            bar.advance((now - 100) / 400)
    # After 10, 20, 40 and then every 60 s, plus one second each, since the interval must be exceeded.
    assert stream.getvalue().splitlines() == [f"trot: {s / 400:.0%}" for s in (11, 32, 73, 134, 195, 256)]


def test_bar_with_a_period_prints_its_last_line():
    place, stream = console(terminal=False)
    with ProgressBar("trot", place, count=10) as bar:
        bar.advance(5, "", "5 of 10")
        bar.advance(10, "", "10 of 10")
    assert stream.getvalue() == "10 of 10\n"
