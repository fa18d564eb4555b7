"""Real-time loop of an emulated robot, which follows the computer's clock."""

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

REPORTED_LAG = 10_000
"""Minimum lag of the physics that is reported [us]."""
MAX_LAG = 50_000
"""Maximum lag [us]; beyond it, robot time slips instead of catching up."""
_MAX_STRIDE = 4_000
"""Maximum advance of the robot before the port is read again [us], which limits errors of arrival times."""
_REPORT_PERIOD = 1.0
_PAUSE = 1e-3
"""Pause when robot time slips [s]: a process with real-time priority must not occupy the processor."""


class Transport(Protocol):
    """Interface to the link of an emulated robot. Times are whole microseconds on the robot's clock."""

    def poll(self, now: int) -> None:
        """Read the data that hosts have written, and send them to the robot."""

    def flush(self, now: int) -> None:
        """Write the data that have reached the hosts by now."""

    def wait(self, timeout: float) -> bool:
        """Wait until hosts have written data, at most `timeout` [s]; return whether they have."""


class EmulatedRobot(Protocol):
    """Interface to an emulated robot. Times are whole microseconds since it was switched on."""

    plant: Plant
    now: int
    on_step: list[Callable[[int], None]]
    """Called with the time after servo steps."""

    @property
    def link(self) -> Transport:
        """Link to hosts."""

    @property
    def next_step(self) -> int:
        """End of the servo step in progress."""

    @property
    def next_time(self) -> float:
        """Time of the next event."""

    def run_to(self, time: int) -> None:
        """Process all events until a time."""

    def counts(self) -> list[str]:
        """Return statistics of the link, for the summary."""


@dataclass
class Summary:
    """Summary of a run of the emulator. Times in s."""

    robot_time: float = 0.0
    real_time: float = 0.0
    processor_time: float = 0.0
    behind: int = 0
    """How often the physics fell behind real time by more than `REPORTED_LAG`."""
    max_lag: float = 0.0
    """Maximum lag."""
    slips: int = 0
    slipped: float = 0.0
    """How often robot time slipped, and by how much in total."""
    stop: bool = field(default=False, repr=False)
    """Set from outside to end the loop."""

    def text(self, board: EmulatedRobot) -> str:
        """Return the summary as one line."""
        fraction = self.processor_time / self.real_time if self.real_time > 0 else 0.0
        parts = [
            f"{self.robot_time:.3f} s of robot time in {self.real_time:.1f} s",
            f"{100 * fraction:.0f} % of a processor",
            f"behind {self.behind} times (by {1e3 * self.max_lag:.1f} ms at worst)",
            f"slipped {self.slips} times ({self.slipped:.3f} s)",
            *board.counts(),
        ]
        return "; ".join(parts)


@contextmanager
def measure(board: EmulatedRobot, summary: Summary) -> Iterator[None]:
    """Measure the times of a run for its summary."""
    started, used = time.monotonic(), time.process_time()
    yield
    summary.robot_time = board.now / 1e6
    summary.real_time = time.monotonic() - started
    summary.processor_time = time.process_time() - used


class RealTimeLoop:
    """Advances an emulated robot with the computer's monotonic clock, until `summary.stop` is set.

    Args:
        board: emulated robot.
        summary: receives the times of the run, and ends the loop.
        load: minimum duration of the physics, relative to real time.
    """

    def __init__(self, board: EmulatedRobot, summary: Summary, load: float = 0.0) -> None:
        self.board, self._summary, self._load = board, summary, load
        self._next_report = -math.inf
        self._since = 0.0, 0.0

    def run(self, until: float | None = None) -> None:
        """Run for `until` of robot time [s], or until stopped."""
        board, link, summary = self.board, self.board.link, self._summary
        self._since = time.monotonic(), time.process_time()
        start = self._since[0] - board.now / 1e6
        end = sys.maxsize if until is None else microseconds(until)
        late = readable = False
        with measure(board, summary):
            while not summary.stop and board.now < end:
                now = int((time.monotonic() - start) * 1e6)
                lag = now - board.next_step
                summary.max_lag = max(summary.max_lag, lag / 1e6)
                if lag > REPORTED_LAG:
                    summary.behind += not late
                    self._report(lag)
                late = lag > REPORTED_LAG
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
        fraction = (used - self._since[1]) / max(real - self._since[0], 1e-3)
        print(
            f"surefoot: the emulator is {lag / 1e3:.0f} ms behind real time "
            f"(it used {100 * fraction:.0f} % of a processor since)",
            file=sys.stderr,
            flush=True,
        )
        self._next_report, self._since = real + _REPORT_PERIOD, (real, used)
