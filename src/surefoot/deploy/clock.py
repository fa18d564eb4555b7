"""Clocks of the control computer, in real time and in lockstep, and their offset to the robot's clock."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

SPIN_TIME = 150e-6
"""Final part of a wait in which the clock is polled [s]; a sleeping process may wake up late by as much."""
SYNC_WINDOW = 10.0
"""Time over which the fastest frame is searched [s]. Clocks that differ by 50 ppm drift apart by 0.5 ms in it."""


class MonotonicClock:
    """Monotonic clock of the computer; starts at 0 s."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Return the time since the clock was created [s]."""
        return time.monotonic() - self._start

    def wait_until(self, moment: float) -> None:
        """Wait until `moment` [s]: sleep for most of the time, then poll the clock."""
        left = moment - self.now()
        if left > SPIN_TIME:
            time.sleep(left - SPIN_TIME)
        while self.now() < moment:
            pass


class LockstepClock:
    """Simulated clock that advances only while the program waits; an emulated robot follows it at any speed."""

    def __init__(self) -> None:
        self._now = 0.0
        self.follow: Callable[[], None] | None = None
        """Set by the link: runs the robot to the present time, and receives what it sends until then."""

    def now(self) -> float:
        """Return the time [s]."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Advance the time to `moment` [s], and receive what the robot sends until then.

        Raises:
            SurefootError: the robot does not answer.
        """
        if moment > self._now:
            self._now = moment
            if self.follow is not None:
                self.follow()


Clock = MonotonicClock | LockstepClock


class ClockSync:
    """Offset between two clocks: the minimum of arrival time minus sending time over the last `SYNC_WINDOW` seconds.

    The fastest frame is assumed to arrive without delay, so the age of a frame is its delay relative to the fastest
    one. The robot measures the age of commands in the same way, in the other direction.

    Args:
        second: one second in the unit of all times: 1, or 1,000,000 for whole microseconds.
    """

    def __init__(self, second: int = 1) -> None:
        self._second = second
        self._buckets: deque[tuple[float, float]] = deque()

    def add(self, sent: float, arrived: float) -> None:
        """Add a frame, with the time it was sent on the other clock and its arrival on this one."""
        second, difference = arrived // self._second, arrived - sent
        if self._buckets and self._buckets[-1][0] == second:
            difference = min(difference, self._buckets.pop()[1])
        self._buckets.append((second, difference))
        while self._buckets[0][0] < second - SYNC_WINDOW:
            self._buckets.popleft()

    @property
    def offset(self) -> float:
        """Time of this clock when the other clock shows 0; infinite before the first frame."""
        return min((difference for _, difference in self._buckets), default=math.inf)

    def age(self, sent: float, now: float) -> float:
        """Return how long ago the other clock showed the time `sent`."""
        return now - (sent + self.offset)

    def reset(self) -> None:
        """Discard all frames, for a robot that has restarted."""
        self._buckets.clear()
