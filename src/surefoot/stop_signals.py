"""Signals that stop a program: Ctrl-C, a closed terminal, a request to terminate."""

from __future__ import annotations

import _thread
import atexit
import os
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

ALL = ("SIGINT", "SIGTERM", "SIGHUP")
SIT, DAMP = 1, 2
"""Requests to a robot, see `StopSignals.stops`."""


INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended."""
_PATIENCE = 3.0
"""Time [s] that a process has to end after a second Ctrl-C."""

_interrupted, _interrupted_twice, _own_process = threading.Event(), threading.Event(), threading.Event()


class Interrupt(KeyboardInterrupt):
    """Ctrl-C. CPython kills a process in which a plain `KeyboardInterrupt` has left `eval`, even one that caught it."""


def enable_interrupt() -> None:
    """Let Ctrl-C raise a `KeyboardInterrupt`, also if this process was started with SIGINT ignored.

    Shells do so for jobs in the background, and many runners of tests for everything.
    """
    _interrupted.clear()
    default = (signal.SIG_IGN, signal.default_int_handler)
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) in default:
        signal.signal(signal.SIGINT, _interrupt)


def end_when_interrupted() -> None:
    """Let this process end with an exit code however often Ctrl-C comes: a second one does not interrupt the end.

    Nor does it wait for the end: libraries may have lost the first `KeyboardInterrupt`, or hold the process.
    """
    _own_process.set()
    enable_interrupt()
    # At the interpreter's end, signals with a handler get the system's own again, which kills.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


def was_interrupted() -> bool:
    """Return whether Ctrl-C has raised a `KeyboardInterrupt`.

    A library in C may replace that by an error of its own: numpy's comparison of structured arrays does.
    """
    return _interrupted.is_set()


def _interrupt(number: int, frame: FrameType | None) -> None:
    if not (_interrupted.is_set() and _own_process.is_set()):
        _interrupted.set()
        raise Interrupt
    elif not _interrupted_twice.is_set():
        _interrupted_twice.set()
        # `threading` may be at work in what this interrupts, and hold a lock.
        _thread.start_new_thread(_end_soon, ())


def _end_soon() -> None:
    time.sleep(_PATIENCE)
    os._exit(INTERRUPTED)


class StopSignals:
    """Count signals while entered, so that they do not end the process.

    Args:
        names: of the signals.
        on_signal: called after each signal with the number of signals so far.
        respect_nohup: a SIGHUP that is ignored stays so: the process goes on when its terminal is closed.
    """

    def __init__(
        self,
        names: tuple[str, ...] = ALL,
        on_signal: Callable[[int], object] | None = None,
        respect_nohup: bool = False,
    ) -> None:
        self.count = 0
        """Signals so far."""
        self.sources: list[Callable[[], int]] = []
        """Other places from which the operator may stop a robot. Each returns its request, as `stops`, at once."""
        self._names, self._on_signal, self._respect_nohup = names, on_signal, respect_nohup
        self._interrupts = 0
        self._before: dict[int, Any] = {}

    @property
    def stops(self) -> int:
        """Request to a robot. 0: go on; 1: sit down; 2, after Ctrl-C twice: damp at once.

        A closing terminal sends several signals, which count once. The most urgent request holds: one that comes again
        from another place changes nothing.
        """
        signals = min(self._interrupts, DAMP) or (SIT if self.count else 0)
        return max([signals, *(source() for source in self.sources)])

    def _count(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self._interrupts += number == signal.SIGINT
        if self._on_signal is not None:
            self._on_signal(self.count)

    def __enter__(self) -> Self:
        for name in self._names:
            number = getattr(signal, name, None)
            ignored = number is not None and signal.getsignal(number) == signal.SIG_IGN
            if number is not None and not (self._respect_nohup and name == "SIGHUP" and ignored):
                self._before[number] = signal.signal(number, self._count)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()
