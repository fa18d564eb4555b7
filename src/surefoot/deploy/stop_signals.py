"""The operator's wish to stop: Ctrl-C, a terminal that closes, a process that is asked to end."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


class StopSignals:
    """Counts signals instead of dying of them, while it is entered.

    The first one asks to sit down. Ctrl-C once more asks for damped motors at once.
    """

    def __init__(self) -> None:
        self._interrupts = 0
        self._ended = False
        self._before: dict[int, Any] = {}

    @property
    def stops(self) -> int:
        """0: go on; 1: sit down; 2: damp at once."""
        return min(max(self._interrupts, int(self._ended)), 2)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT:
            self._interrupts += 1
        else:
            # A closing terminal sends several; none of them means haste.
            self._ended = True

    def __enter__(self) -> StopSignals:
        """Listen."""
        for name in _SIGNALS:
            number = getattr(signal, name, None)
            if number is not None:
                self._before[number] = signal.signal(number, self._heard)
        return self

    def __exit__(self, *_: object) -> None:
        """Leave signals to whom they belonged."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()
