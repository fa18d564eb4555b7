"""Timing of the control loop: due times, lateness and missed steps, and what keeps the process in time."""

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
"""Priority, 1 to 99, among real-time processes: above ordinary processes, below the kernel's own threads at 50."""
BOARD_PRIORITY = 30
"""Priority of a process that is the robot's board, with all its threads: above the control loop that it watches."""
_NICE = -10
_SWITCH_INTERVAL = 1e-4
"""Longest time [s] for which another thread of this process keeps the loop's thread from running."""


@dataclass(frozen=True)
class Tick:
    """A control step that starts: its number, missed steps included, when it was due [s], and steps missed before it.

    `late` is the delay [s] after the first step that was due since the last tick.
    """

    index: int
    due: float
    late: float
    missed: int


class Pacer:
    """Wakes once a period [s]. A step that would start a period late or more is missed; due times never shift."""

    def __init__(self, clock: Clock, period: float) -> None:
        self.clock, self.period = clock, period
        self.start, self.index = clock.now(), -1

    def restart(self) -> None:
        """Count from 0 again: step 0 is due when the next step is, or now if that has passed."""
        self.start, self.index = max(self.due(self.index + 1), self.clock.now()), -1

    def due(self, index: int) -> float:
        """Return when a step is due [s]."""
        return self.start + index * self.period

    def next(self) -> Tick:
        """Wait for the next step and return it."""
        index = self.index + 1
        self.clock.wait_until(self.due(index))
        late = self.clock.now() - self.due(index)
        missed = max(int(late / self.period + _ROUNDING), 0)
        self.index = index + missed
        return Tick(self.index, self.due(self.index), max(late, 0.0), missed)


class LoopTiming:
    """Lateness, computing times and ages of states of a run, in arrays that are allocated before it.

    Args:
        steps: greatest number of steps that are kept; later ones are only counted.
    """

    def __init__(self, steps: int) -> None:
        self._times = np.full((4, steps), np.nan)
        self.steps = self.missed = self.stale = 0
        """Steps that were done, that were missed, and that had no new state."""

    def add(self, started: float, sent: float, inference: float, age: float, missed: int, fresh: bool) -> None:
        """Take a step: delays of its start and of its command at the port, the policy's time, its state's age [s].

        `missed` steps were missed before it; `fresh` is whether it had a new state.
        """
        if self.steps < self._times.shape[1]:
            self._times[:, self.steps] = started, sent, inference, age
        self.steps += 1
        self.missed += missed
        self.stale += not fresh

    def last(self, count: int) -> Array:
        """Return the lateness of the last steps, at most so many [s]."""
        end = min(self.steps, self._times.shape[1])
        return self._times[0, max(end - count, 0) : end]

    def figures(self) -> dict[str, float | int | None]:
        """Return median, 99.9th percentile and maximum in ms, and counts."""
        figures: dict[str, float | int | None] = {"steps": self.steps, "missed": self.missed, "stale": self.stale}
        for name, times in zip(("lateness", "sent", "inference", "state_age"), self._times, strict=True):
            times = times[~np.isnan(times)]
            for key, share in (("median", 50), ("p99_9", 99.9), ("max", 100)):
                figures[f"{name}_{key}_ms"] = round(1e3 * float(np.percentile(times, share)), 4) if len(times) else None
        return figures


@contextlib.contextmanager
def real_time_priority(priority: int = PRIORITY, threads: bool = False) -> Iterator[None]:
    """Run without garbage collection and with a high priority; without the right to it, with the highest possible.

    Args:
        priority: among real-time processes.
        threads: threads and processes that are started meanwhile have it too; otherwise ordinary priority.
    """
    interval, collecting = sys.getswitchinterval(), gc.isenabled()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    raised = _raise_priority(priority, threads)
    try:
        yield
    finally:
        if raised:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        sys.setswitchinterval(interval)
        if collecting:
            gc.enable()


def _raise_priority(priority: int, threads: bool) -> bool:
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        policy = os.SCHED_FIFO | (0 if threads else getattr(os, "SCHED_RESET_ON_FORK", 0))
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, _NICE)
        return False
    return True
