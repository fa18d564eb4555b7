"""Clocks: the control computer's, one that an emulated robot follows, and how they relate to the robot's."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

SPIN = 150e-6
"""A wait's last part [s] is spent looking at the clock: a sleeping process is woken too late by up to so much."""
WINDOW = 10.0
"""Time [s] over which the quickest frame counts: within it clocks that run 50 ppm apart part by half a millisecond."""


class MonotonicClock:
    """The computer's monotonic clock, in seconds from 0."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Return the time since the clock was made [s]."""
        return time.monotonic() - self._start

    def wait_until(self, moment: float) -> None:
        """Wait until `moment` [s]: sleep most of the time, then look at the clock."""
        left = moment - self.now()
        if left > SPIN:
            time.sleep(left - SPIN)
        while self.now() < moment:
            pass


class LockstepClock:
    """Time that passes only while the program waits; an emulated robot follows it, however fast the computer is."""

    def __init__(self) -> None:
        self._now = 0.0
        self.follow: Callable[[], None] | None = None
        """Lets the robot run to the present and receives what it sends until then; set by the link."""

    def now(self) -> float:
        """Return the time [s]."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Let time go to `moment` [s], and receive what the robot sends until then.

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

    The frame that came quickest is taken to have come at once: what is told is how much later than the quickest one
    a frame is, never how long the quickest one took. The robot judges the age of commands by the same, the other way
    round.

    Args:
        second: a second in the unit of all times given: 1, or 1,000,000 for whole microseconds.
    """

    def __init__(self, second: int = 1) -> None:
        self._second = second
        self._buckets: deque[tuple[float, float]] = deque()

    def add(self, sent: float, arrived: float) -> None:
        """Take a frame: sent on the robot's clock [s], arrived on this computer's [s]."""
        second, difference = arrived // self._second, arrived - sent
        if self._buckets and self._buckets[-1][0] == second:
            difference = min(difference, self._buckets.pop()[1])
        self._buckets.append((second, difference))
        while self._buckets[0][0] < second - WINDOW:
            self._buckets.popleft()

    @property
    def offset(self) -> float:
        """This computer's time [s] when the robot's is 0; infinite while nothing has come."""
        return min((difference for _, difference in self._buckets), default=math.inf)

    def age(self, sent: float, now: float) -> float:
        """How long ago [s] the robot's clock showed `sent`, when it is `now` here."""
        return now - (sent + self.offset)

    def forget(self) -> None:
        """Start anew, for a robot that was switched on again."""
        self._buckets.clear()
