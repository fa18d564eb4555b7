"""Signals that stop a program: Ctrl-C, a closed terminal, and a request to terminate."""

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

STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
SIT, DAMP = 1, 2
"""Stop requests to a robot, see `StopSignals.stops`."""


INTERRUPTED = 130
"""Exit code of a command that was ended by Ctrl-C."""
_EXIT_TIMEOUT = 3.0
"""Time within which a process must end after a second Ctrl-C [s]."""

_interrupted, _interrupted_twice, _own_process = threading.Event(), threading.Event(), threading.Event()


class Interrupt(KeyboardInterrupt):
    """Ctrl-C. CPython kills a process in which a plain `KeyboardInterrupt` has left `eval`, even if it was caught."""


def enable_interrupt() -> None:
    """Let Ctrl-C raise a `KeyboardInterrupt`, even if this process was started with SIGINT ignored.

    Shells ignore SIGINT for background jobs, and many test runners for all processes.
    """
    _interrupted.clear()
    default = (signal.SIG_IGN, signal.default_int_handler)
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) in default:
        signal.signal(signal.SIGINT, _interrupt)


def end_when_interrupted() -> None:
    """Let this process end with an exit code however often Ctrl-C is pressed.

    A second Ctrl-C does not interrupt the cleanup, but limits its duration: libraries may have swallowed the first
    `KeyboardInterrupt`, or may block the process.
    """
    _own_process.set()
    enable_interrupt()
    # At its exit the interpreter restores the system's default handlers, which would kill the process.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


def was_interrupted() -> bool:
    """Return whether Ctrl-C has raised a `KeyboardInterrupt`.

    A C library may replace it by an error of its own, as numpy's comparison of structured arrays does.
    """
    return _interrupted.is_set()


def _interrupt(number: int, frame: FrameType | None) -> None:
    if not (_interrupted.is_set() and _own_process.is_set()):
        _interrupted.set()
        raise Interrupt
    elif not _interrupted_twice.is_set():
        _interrupted_twice.set()
        # The interrupted code may be inside `threading`, holding one of its locks.
        _thread.start_new_thread(_end_soon, ())


def _end_soon() -> None:
    time.sleep(_EXIT_TIMEOUT)
    os._exit(INTERRUPTED)


class StopSignals:
    """Context manager that counts stop signals instead of letting them end the process.

    Args:
        names: names of the signals.
        on_signal: called after each signal with the number of signals so far.
        respect_nohup: keep ignoring SIGHUP if it is ignored, so that the process survives the end of its terminal.
    """

    def __init__(
        self,
        names: tuple[str, ...] = STOP_SIGNALS,
        on_signal: Callable[[int], object] | None = None,
        respect_nohup: bool = False,
    ) -> None:
        self.count = 0
        """Number of signals so far."""
        self.sources: list[Callable[[], int]] = []
        """Other sources of stop requests, such as a page. Each returns its present request, as `stops`, without
        waiting."""
        self._names, self._on_signal, self._respect_nohup = names, on_signal, respect_nohup
        self._interrupts = 0
        self._before: dict[int, Any] = {}

    @property
    def stops(self) -> int:
        """Present stop request to a robot. 0: continue; 1: sit down; 2, after a second Ctrl-C: damp immediately.

        The several signals of a closing terminal count as one. The most urgent request of all sources applies: the
        same request from a second source does not escalate it.
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
