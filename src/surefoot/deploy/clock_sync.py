"""How old what the robot says is, though its clock and this computer's started at different times."""

from __future__ import annotations

import math
from collections import deque

WINDOW = 10.0
"""Time [s] over which the quickest frame counts: within it clocks that run 50 ppm apart part by half a millisecond."""


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
    def known(self) -> bool:
        """Whether any frame has come."""
        return bool(self._buckets)

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
