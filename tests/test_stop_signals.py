"""Signals are wishes while a robot is held, and what they were before and after."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from surefoot.cli import main
from surefoot.stop_signals import StopSignals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_requests_to_sit_down(number):
    with StopSignals() as stop:
        assert stop.stops == 0
        os.kill(os.getpid(), number)
        assert stop.stops == 1


def test_only_ctrl_c_again_damps_at_once():
    with StopSignals() as stop:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGHUP)
        assert stop.stops == 1
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.stops == 1
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.stops == 2
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.stops == 2


def test_signal_handlers_are_restored():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    with StopSignals():
        pass
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before


def test_signals_are_counted_and_reported_and_nohup_is_respected():
    counts: list[int] = []
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignals(on_signal=counts.append, respect_nohup=True) as stop:
            for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGINT):
                os.kill(os.getpid(), number)
        assert (stop.count, counts) == (2, [1, 2])
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.fixture
def ignored_interrupt() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ignored_interrupt")
@pytest.mark.parametrize("name", ["show", "drive", "evaluate"])
def test_ctrl_c_ends_a_command_whose_parent_ignores_it(name: str, monkeypatch: pytest.MonkeyPatch):
    command = SimpleNamespace(main=lambda words: os.kill(os.getpid(), signal.SIGINT))
    monkeypatch.setattr(main.importlib, "import_module", lambda name: command)
    assert main.main([name]) == 130


@pytest.mark.usefixtures("ignored_interrupt")
def test_ctrl_c_that_a_library_makes_another_error(monkeypatch: pytest.MonkeyPatch):
    def compare(words: list[str]) -> None:
        if not words:
            raise TypeError("a defect")
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            raise TypeError("Cannot compare structured arrays") from None

    monkeypatch.setattr(main.importlib, "import_module", lambda name: SimpleNamespace(main=compare))
    assert main.main(["show", "it"]) == 130
    with pytest.raises(TypeError, match="a defect"):
        main.main(["show"])
