"""The emulator in real time: a robot that follows the computer's clock."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

from surefoot.deploy.board.signals import microseconds
from surefoot.emulator.plant import Plant

BEHIND = 10_000
"""Lag of the physics [us] from which on it is reported."""
MAX_LAG = 50_000
"""Lag [us] beyond which robot time slips instead of catching up."""
_MAX_STRIDE = 4_000
"""Time [us] that the robot may advance before the port is read again, so that arrivals are stamped in time."""
_REPORT_PERIOD = 1.0
_PAUSE = 1e-3
"""Pause [s] when robot time slips: a process that has priority over all others must not keep the processor."""


class Transport(Protocol):
    """What a loop that advances a robot needs of its link. Times are whole microseconds on the robot's clock."""

    def poll(self, now: int) -> None:
        """Put what hosts have written on its way to the robot."""

    def flush(self, now: int) -> None:
        """Hand over to hosts what has reached them by now."""

    def wait(self, timeout: float) -> bool:
        """Wait until hosts have written something, at most `timeout` [s]; return whether they have."""


class EmulatedRobot(Protocol):
    """What the loop needs of a robot. Times are whole microseconds since it was switched on."""

    plant: Plant
    now: int
    on_step: list[Callable[[int], None]]
    """Called with the time after servo steps."""

    @property
    def link(self) -> Transport:
        """Its link to hosts."""

    @property
    def next_step(self) -> int:
        """When the servo step in progress ends."""

    @property
    def next_time(self) -> float:
        """When there is something to do next."""

    def run_to(self, time: int) -> None:
        """Run everything that happens until a time."""

    def counts(self) -> list[str]:
        """Return what happened on its link, for the line at the end."""


@dataclass
class Summary:
    """What happened while the emulator ran. Times in s."""

    robot_time: float = 0.0
    real_time: float = 0.0
    processor_time: float = 0.0
    behind: int = 0
    """How often the physics fell behind by more than `BEHIND`."""
    worst: float = 0.0
    """Largest lag."""
    slips: int = 0
    slipped: float = 0.0
    """How often robot time slipped, and by how much in total."""
    stop: bool = field(default=False, repr=False)
    """Set from outside to end the loop."""

    def text(self, board: EmulatedRobot) -> str:
        """Return one line for the end."""
        share = self.processor_time / self.real_time if self.real_time > 0 else 0.0
        parts = [
            f"{self.robot_time:.3f} s of robot time in {self.real_time:.1f} s",
            f"{100 * share:.0f} % of a processor",
            f"behind {self.behind} times (by {1e3 * self.worst:.1f} ms at worst)",
            f"slipped {self.slips} times ({self.slipped:.3f} s)",
            *board.counts(),
        ]
        return "; ".join(parts)


@contextmanager
def measure(board: EmulatedRobot, summary: Summary) -> Iterator[None]:
    """Measure the time of a run for its summary."""
    started, used = time.monotonic(), time.process_time()
    yield
    summary.robot_time = board.now / 1e6
    summary.real_time = time.monotonic() - started
    summary.processor_time = time.process_time() - used


class RealTimeLoop:
    """Advances a robot by the computer's monotonic clock, and sleeps in between, until `summary.stop` is set.

    The physics takes at least `load` times real time.
    """

    def __init__(self, board: EmulatedRobot, summary: Summary, load: float = 0.0) -> None:
        self.board, self._summary, self._load = board, summary, load
        self._next_report = -math.inf
        self._since = 0.0, 0.0

    def run(self, until: float | None = None) -> None:
        """Run until so much robot time [s] has passed, or until stopped."""
        board, link, summary = self.board, self.board.link, self._summary
        self._since = time.monotonic(), time.process_time()
        start = self._since[0] - board.now / 1e6
        end = sys.maxsize if until is None else microseconds(until)
        late = readable = False
        with measure(board, summary):
            while not summary.stop and board.now < end:
                now = int((time.monotonic() - start) * 1e6)
                lag = now - board.next_step
                summary.worst = max(summary.worst, lag / 1e6)
                if lag > BEHIND:
                    summary.behind += not late
                    self._report(lag)
                late = lag > BEHIND
                if lag > MAX_LAG:
                    summary.slips += 1
                    summary.slipped += lag / 1e6
                    start += lag / 1e6
                    now -= lag
                    time.sleep(_PAUSE)
                if readable:
                    link.poll(max(now, board.now))
                before = board.plant.ticks
                board.run_to(max(min(now, end, board.next_step + _MAX_STRIDE), board.now))
                if self._load:
                    time.sleep(self._load * 1e-3 * (board.plant.ticks - before))
                link.flush(board.now)
                readable = link.wait(board.next_time / 1e6 - (time.monotonic() - start))

    def _report(self, lag: int) -> None:
        real, used = time.monotonic(), time.process_time()
        if real < self._next_report:
            return
        share = (used - self._since[1]) / max(real - self._since[0], 1e-3)
        print(
            f"surefoot: the emulator is {lag / 1e3:.0f} ms behind real time "
            f"(it used {100 * share:.0f} % of a processor since)",
            file=sys.stderr,
            flush=True,
        )
        self._next_report, self._since = real + _REPORT_PERIOD, (real, used)
