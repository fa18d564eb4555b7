"""Signals that stop a program: Ctrl-C, a closed terminal, a request to terminate."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

ALL = ("SIGINT", "SIGTERM", "SIGHUP")
SIT, DAMP = 1, 2
"""Requests to a robot, see `StopSignals.stops`."""


_interrupted = threading.Event()


def enable_interrupt() -> None:
    """Let Ctrl-C raise `KeyboardInterrupt`, also if this process was started with SIGINT ignored.

    Shells do so for jobs in the background, and many runners of tests for everything.
    """
    _interrupted.clear()
    default = (signal.SIG_IGN, signal.default_int_handler)
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) in default:
        signal.signal(signal.SIGINT, _interrupt)


def was_interrupted() -> bool:
    """Return whether Ctrl-C has raised a `KeyboardInterrupt`.

    A library in C may replace that by an error of its own: numpy's comparison of structured arrays does.
    """
    return _interrupted.is_set()


def _interrupt(number: int, frame: FrameType | None) -> None:
    _interrupted.set()
    signal.default_int_handler(number, frame)


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
