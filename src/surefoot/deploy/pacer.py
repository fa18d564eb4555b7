"""The control loop's beat: when each step is due, how late it comes, which ones are missed; what keeps it punctual."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.clock import Clock

_ROUNDING = 1e-9
PRIORITY = 20
"""Of 1 to 99 among real-time processes: above everything ordinary, below the kernel's own helpers at 50."""
_NICE = -10
_SWITCH = 1e-4
"""Longest time [s] for which another thread of this process keeps the loop's thread from running."""


@dataclass(frozen=True)
class Tick:
    """A control step that starts."""

    index: int
    """Its number since the beat began; missed steps have numbers too."""
    due: float
    """When it should have started [s]."""
    late: float
    """How much later than the first step that was due since the last one it did [s]: missed steps count."""
    missed: int
    """Steps that passed without a tick since the last one."""


class Pacer:
    """Wakes once a period. A tick that would start a period late or more is missed: the beat itself never shifts.

    Args:
        clock: whose time.
        period: time between two steps [s].
    """

    def __init__(self, clock: Clock, period: float) -> None:
        self.clock, self.period = clock, period
        self.start, self.index = clock.now(), -1

    def restart(self) -> None:
        """Count from 0 again: step 0 takes the place of the next step, or is due now if that has passed."""
        self.start, self.index = max(self.due(self.index + 1), self.clock.now()), -1

    def due(self, index: int) -> float:
        """When a step is due [s]."""
        return self.start + index * self.period

    def next(self) -> Tick:
        """Wait for the next step."""
        index = self.index + 1
        self.clock.wait_until(self.due(index))
        late = self.clock.now() - self.due(index)
        missed = max(int(late / self.period + _ROUNDING), 0)
        self.index = index + missed
        return Tick(self.index, self.due(self.index), max(late, 0.0), missed)


class LoopTiming:
    """Lateness and computing times of a run, kept without making anything while it goes.

    Args:
        steps: how many at most; further ones are not kept.
    """

    def __init__(self, steps: int) -> None:
        self._started, self._sent, self._inference = (np.full(steps, np.nan) for _ in range(3))
        self.steps = 0
        """Steps that were done."""
        self.missed = 0
        """Steps that were missed."""
        self.stale = 0
        """Steps that had no new state."""

    def add(self, started: float, sent: float, inference: float, missed: int, fresh: bool) -> None:
        """Take a step.

        Args:
            started: how late it started [s].
            sent: how late its command was handed to the port [s].
            inference: how long the policy took [s]; NaN, if it was not asked.
            missed: steps missed before it.
            fresh: whether it had a new state.
        """
        if self.steps < len(self._started):
            self._started[self.steps] = started + 0.0
            self._sent[self.steps] = sent
            self._inference[self.steps] = inference
        self.steps += 1
        self.missed += missed
        self.stale += not fresh

    def last(self, count: int) -> Array:
        """Lateness [s] of the last steps, at most so many."""
        end = min(self.steps, len(self._started))
        return self._started[max(end - count, 0) : end]

    def figures(self) -> dict[str, float | int | None]:
        """Median, 99.9th percentile and maximum in ms, and counts."""
        kept = slice(0, min(self.steps, len(self._started)))
        told: dict[str, float | int | None] = {"steps": self.steps, "missed": self.missed, "stale": self.stale}
        for name, values in (("lateness", self._started), ("sent", self._sent), ("inference", self._inference)):
            known = values[kept][~np.isnan(values[kept])]
            for key, share in (("median", 50), ("p99_9", 99.9), ("max", 100)):
                told[f"{name}_{key}_ms"] = round(1e3 * float(np.percentile(known, share)), 4) if len(known) else None
        return told


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """No garbage collection, and the highest priority that this process may have, while it lasts.

    Quietly does with less where it has no right to more. Children start with ordinary priority.
    """
    before = sys.getswitchinterval(), gc.isenabled()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_SWITCH)
    raised = _raise_priority()
    try:
        yield
    finally:
        if raised:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        sys.setswitchinterval(before[0])
        if before[1]:
            gc.enable()


def _raise_priority() -> bool:
    """Ask for real time, or else for more of the ordinary; whether it is real time."""
    if not hasattr(os, "sched_setscheduler"):
        return False
    policy = os.SCHED_FIFO | getattr(os, "SCHED_RESET_ON_FORK", 0)
    try:
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except OSError:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, _NICE)
        return False
    return True
