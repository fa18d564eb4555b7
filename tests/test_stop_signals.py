"""Stop signals are requests to a robot while they are counted; their handlers are restored afterwards."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from surefoot.cli import main
from surefoot.stop_signals import DAMP, SIT, StopSignals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_requests_to_sit_down(number):
    with StopSignals() as stop:
        assert stop.stops == 0
        os.kill(os.getpid(), number)
        assert stop.stops == 1


def test_only_a_second_ctrl_c_damps():
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


def test_the_most_urgent_request_of_all_sources_applies():
    page = 0
    with StopSignals() as stop:
        stop.sources.append(lambda: page)
        assert stop.stops == 0
        page = SIT
        assert stop.stops == SIT
        # The page's button and a first Ctrl-C both request to sit down.
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.stops == SIT
        page = DAMP
        assert stop.stops == DAMP
        page = 0
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.stops == DAMP


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
def test_ctrl_c_is_recognized_although_a_library_replaced_it_by_another_error(monkeypatch: pytest.MonkeyPatch):
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


CLEANUP = """
import sys, time
from surefoot.cli import main

class Command:
    def main(words):
        try:
            print("ready", flush=True)
            time.sleep(60)
        finally:
            time.sleep({cleanup})
            print("cleaned", flush=True)

main.importlib.import_module = lambda name: Command
sys.argv = ["surefoot", "drive"]
sys.exit(main.program())
"""


@pytest.mark.parametrize(("cleanup", "cleaned"), [(0.5, "cleaned\n"), (60.0, "")])
def test_repeated_ctrl_c_interrupts_once_and_ends_with_an_exit_code(cleanup: float, cleaned: str):
    command = [sys.executable, "-c", CLEANUP.format(cleanup=cleanup)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    begin = time.monotonic()
    for _ in range(12):
        process.send_signal(signal.SIGINT)
        time.sleep(0.02)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert output == cleaned
    assert errors == ("surefoot: interrupted\n" if cleaned else "")
    assert time.monotonic() - begin < 30.0


def test_ctrl_c_inside_eval_ends_with_an_exit_code():
    # CPython ends the process by the signal if a plain KeyboardInterrupt has left `eval`.
    code = CLEANUP.format(cleanup=0).replace("time.sleep(60)", "eval('time.sleep(60)')")
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "surefoot: interrupted\n")
