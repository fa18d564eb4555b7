"""Clocks: the control computer's, one that an emulated robot follows, and how they relate to the robot's."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

SPIN_TIME = 150e-6
"""Last part of a wait [s], in which the clock is polled: a sleeping process wakes too late by up to as much."""
WINDOW = 10.0
"""Time [s] in which the quickest frame is looked for. Clocks that differ by 50 ppm drift by 0.5 ms in it."""


class MonotonicClock:
    """The computer's monotonic clock, in seconds from 0."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Return the time since the clock was made [s]."""
        return time.monotonic() - self._start

    def wait_until(self, moment: float) -> None:
        """Wait until `moment` [s]: sleep most of the time, then poll the clock."""
        left = moment - self.now()
        if left > SPIN_TIME:
            time.sleep(left - SPIN_TIME)
        while self.now() < moment:
            pass


class LockstepClock:
    """Time that passes only while the program waits; an emulated robot follows it, however fast the computer is."""

    def __init__(self) -> None:
        self._now = 0.0
        self.follow: Callable[[], None] | None = None
        """Runs the robot to the present and receives what it sends until then; set by the link."""

    def now(self) -> float:
        """Return the time [s]."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Advance time to `moment` [s], and receive what the robot sends until then.

        Raises:
            SurefootError: the robot does not follow.
        """
        if moment > self._now:
            self._now = moment
            if self.follow is not None:
                self.follow()


Clock = MonotonicClock | LockstepClock


class ClockSync:
    """The least difference between arrival here and sending there, over the last `WINDOW` seconds.

    The quickest frame is taken to arrive at once, so an age is the delay beyond the quickest frame's. The robot
    measures the age of commands in the same way, in the other direction.

    Args:
        second: a second in the unit of all times: 1, or 1,000,000 for whole microseconds.
    """

    def __init__(self, second: int = 1) -> None:
        self._second = second
        self._buckets: deque[tuple[float, float]] = deque()

    def add(self, sent: float, arrived: float) -> None:
        """Take a frame: sent on the other clock, arrived on this one."""
        second, difference = arrived // self._second, arrived - sent
        if self._buckets and self._buckets[-1][0] == second:
            difference = min(difference, self._buckets.pop()[1])
        self._buckets.append((second, difference))
        while self._buckets[0][0] < second - WINDOW:
            self._buckets.popleft()

    @property
    def offset(self) -> float:
        """This clock's time when the other's is 0; infinite while nothing has arrived."""
        return min((difference for _, difference in self._buckets), default=math.inf)

    def age(self, sent: float, now: float) -> float:
        """Return how long ago the other clock showed `sent`."""
        return now - (sent + self.offset)

    def reset(self) -> None:
        """Start anew, for a robot that was switched on again."""
        self._buckets.clear()
