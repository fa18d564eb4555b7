"""Timing of the control loop: due times, lateness, missed steps, and real-time priority of the process."""

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
"""Real-time priority, 1 to 99: above ordinary processes, below the kernel's own threads at 50."""
BOARD_PRIORITY = 30
"""Real-time priority of a process that acts as the robot's board: above the control loop that it supervises."""
_NICE = -10
_SWITCH_INTERVAL = 1e-4
"""Maximum time for which another thread of this process delays the thread of the loop [s]."""


@dataclass(frozen=True)
class Tick:
    """Start of a control step."""

    index: int
    """Number of the step, with missed steps included."""
    due: float
    """Time at which the step was due [s]."""
    late: float
    """Delay relative to the first step that was due since the last tick [s]."""
    missed: int
    """Number of steps missed before it."""


class Pacer:
    """Waits for control steps with a fixed period [s]. Steps that are late by a period or more are missed.

    The due times never shift.
    """

    def __init__(self, clock: Clock, period: float) -> None:
        self.clock, self.period = clock, period
        self.start, self.index = clock.now(), -1

    def restart(self) -> None:
        """Restart counting from 0: step 0 is due when the next step was, or now if that time has passed."""
        self.start, self.index = max(self.due(self.index + 1), self.clock.now()), -1

    def due(self, index: int) -> float:
        """Return the time at which a step is due [s]."""
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
    """Lateness, inference times and state ages of a run, in preallocated arrays.

    Args:
        steps: maximum number of recorded steps; later ones are only counted.
    """

    def __init__(self, steps: int) -> None:
        self._times = np.full((4, steps), np.nan)
        self.steps = self.missed = self.stale = 0
        """Number of executed steps, missed steps, and steps without a new state."""

    def add(self, started: float, sent: float, inference: float, age: float, missed: int, fresh: bool) -> None:
        """Add a control step.

        Args:
            started: delay of its start [s].
            sent: delay at which its command was sent [s].
            inference: inference time of the policy [s].
            age: age of its state [s].
            missed: steps missed before it.
            fresh: whether it had a new state.
        """
        if self.steps < self._times.shape[1]:
            self._times[:, self.steps] = started, sent, inference, age
        self.steps += 1
        self.missed += missed
        self.stale += not fresh

    def last(self, count: int) -> Array:
        """Return the lateness of at most the last `count` steps [s]."""
        end = min(self.steps, self._times.shape[1])
        return self._times[0, max(end - count, 0) : end]

    def metrics(self) -> dict[str, float | int | None]:
        """Return median, 99.9th percentile and maximum of all times [ms], and the counts."""
        metrics: dict[str, float | int | None] = {"steps": self.steps, "missed": self.missed, "stale": self.stale}
        for name, times in zip(("lateness", "sent", "inference", "state_age"), self._times, strict=True):
            times = times[~np.isnan(times)]
            for key, percentile in (("median", 50), ("p99_9", 99.9), ("max", 100)):
                metrics[f"{name}_{key}_ms"] = (
                    round(1e3 * float(np.percentile(times, percentile)), 4) if len(times) else None
                )
        return metrics


@contextlib.contextmanager
def real_time_priority(priority: int = PRIORITY, threads: bool = False) -> Iterator[None]:
    """Run a block with real-time priority and without garbage collection.

    Without permission for real-time priority, the process gets the highest ordinary priority that it may have.

    Args:
        priority: real-time priority, 1 to 99.
        threads: whether threads and processes started in the block inherit the priority.
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
