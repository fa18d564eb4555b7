"""Shared by benchmarks: wall time, processor time of this process, and processor time of everything else.

Only the standard library, so that a rival's interpreter can also import it. The time of other processes comes from
`/proc/stat` (Linux): all time in which a processor was not idle, including time that a hypervisor took, minus this
process's own. It has a resolution of 10 ms.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

MAX_OTHER_CORES = 0.05
"""Processor use of other processes [cores] from which a machine is too busy to time anything."""
_STAT = Path("/proc/stat")
_IDLE = (3, 4)
"""Columns of a line of `/proc/stat` in which a processor waits: idle and iowait."""
_COLUMNS = 8
"""Columns that add up to all time. The time of guests, in further columns, is part of user time."""


class TooBusy(Exception):
    """Other processes use the machine, or nobody can say whether they do; the message names the way out."""


def busy_seconds(stat: str) -> float:
    """Return the time [s] in which processors were not idle, summed over processors, from the text of `/proc/stat`."""
    name, *columns = stat.splitlines()[0].split()
    if name != "cpu" or len(columns) < _COLUMNS:
        raise ValueError(f"'{name}' is not the first word of /proc/stat, or columns are missing")
    ticks = [int(column) for column in columns[:_COLUMNS]]
    return (sum(ticks) - sum(ticks[k] for k in _IDLE)) / os.sysconf("SC_CLK_TCK")


def _now() -> tuple[float, float, float]:
    """Return the wall time, the processor time of this process and the busy time of all processors (NaN: unknown)."""
    busy = busy_seconds(_STAT.read_text(encoding="ascii")) if _STAT.is_file() else float("nan")
    return time.perf_counter(), time.process_time(), busy


class Stopwatch:
    """Wall and processor time [s] between calls of `start` and `stop`, summed."""

    def __init__(self) -> None:
        self._sums = (0.0, 0.0, 0.0)
        self._started: tuple[float, float, float] | None = None

    def start(self) -> None:
        """Continue measuring."""
        self._started = _now()

    def stop(self) -> None:
        """Pause."""
        self._sums, self._started = self._totals(), None

    def _totals(self) -> tuple[float, float, float]:
        if self._started is None:
            return self._sums
        return tuple(one + end - begin for one, end, begin in zip(self._sums, _now(), self._started, strict=True))  # type: ignore[return-value]

    @property
    def wall(self) -> float:
        """Wall time so far [s]."""
        return self._sums[0] + (0.0 if self._started is None else time.perf_counter() - self._started[0])

    @property
    def cpu(self) -> float:
        """Processor time of this process so far, all threads together [s]."""
        return self._sums[1] + (0.0 if self._started is None else time.process_time() - self._started[1])

    @property
    def other_cores(self) -> float | None:
        """Mean number of processors that other processes used; None where the system does not say."""
        wall, own, busy = self._totals()
        if wall <= 0.0 or busy != busy:
            return None
        return max(busy - own, 0.0) / wall

    def times(self) -> dict[str, float | None]:
        """Return wall time, processor time [s] and the processors that others used, rounded, for a table."""
        other = self.other_cores
        return {
            "seconds": round(self.wall, 3),
            "cpu_seconds": round(self.cpu, 3),
            "other_cores": None if other is None else round(other, 3),
        }


def time_turn(step: Callable[[int], object], physics_steps: int, seconds: float) -> dict[str, float | None]:
    """Time calls of a function for some wall time; return the steps of physics that it did, and `Stopwatch.times`.

    Args:
        step: runs the k-th control step of all robots.
        physics_steps: steps of physics in a call, of all robots together.
        seconds: wall time after which no further call begins [s].
    """
    watch, calls = Stopwatch(), 0
    watch.start()
    while watch.wall < seconds:
        step(calls)
        calls += 1
    watch.stop()
    return {"steps": calls * physics_steps, **watch.times()}


def check_idle(anyway: bool, seconds: float = 1.0) -> tuple[bool, float | None]:
    """Measure for a second what other processes use; return whether the machine is idle, and their use [cores].

    Args:
        anyway: return also if the machine is not idle.
        seconds: how long to measure.

    Raises:
        TooBusy: the machine is not idle, or its use is unknown, unless `anyway`.
    """
    watch = Stopwatch()
    watch.start()
    time.sleep(seconds)
    watch.stop()
    other = watch.other_cores
    idle = other is not None and other <= MAX_OTHER_CORES
    if not idle and not anyway:
        found = "the system does not say how busy it is" if other is None else f"other processes use {other:.2f} cores"
        raise TooBusy(
            f"{found}; times are measured only if they use at most {MAX_OTHER_CORES:g}: stop them, or add --anyway, "
            "which the results then say"
        )
    return idle, other
