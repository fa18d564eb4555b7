"""The control computer's clock: the real one, or in lockstep one that the robot follows."""

from __future__ import annotations

import time
from typing import Protocol

from surefoot.errors import SurefootError

SPIN = 150e-6
"""A wait's last part [s] is spent looking at the clock: a sleeping process is woken too late by up to so much."""
_PATIENCE = (0.05, 0.15, 0.5, 1.3, 3.0)
"""Real time [s] for which each of several pings is given to be answered. A robot in lockstep answers within a few
milliseconds, unless the line lost the ping or its pong: then waiting is for nothing."""


class Clock(Protocol):
    """Time in seconds from 0, and a way to let it pass."""

    def now(self) -> float:
        """The time [s]."""
        ...

    def wait_until(self, moment: float) -> None:
        """Return when it is `moment` [s], at once if that has passed."""
        ...


class Follower(Protocol):
    """The other end of a link, whose time follows the times in what it is sent."""

    def ping_through(self, patience: float) -> bool:
        """Send a ping and wait for its answer, at most `patience` seconds of real time; return whether it came."""
        ...


class MonotonicClock:
    """The computer's monotonic clock."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Time since the clock was made [s]."""
        return time.monotonic() - self._start

    def wait_until(self, moment: float) -> None:
        """Sleep most of the time, then look at the clock."""
        left = moment - self.now()
        if left > SPIN:
            time.sleep(left - SPIN)
        while self.now() < moment:
            pass


class LockstepClock:
    """Time that passes only while the program waits; the robot is told, and runs as far.

    For emulated robots in lockstep: nothing depends on how fast the computer is.
    """

    def __init__(self) -> None:
        self._now = 0.0
        self._link: Follower | None = None

    def attach(self, link: Follower) -> None:
        """Take the link whose other end follows this clock."""
        self._link = link

    def now(self) -> float:
        """The time [s]."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Let time go to `moment` [s], and take all that the robot says until then.

        Raises:
            SurefootError: the robot does not follow.
        """
        if moment <= self._now:
            return
        self._now = moment
        if self._link is None:
            return
        if any(self._link.ping_through(patience) for patience in _PATIENCE):
            return
        raise SurefootError("the robot does not answer; a clock in lockstep needs an emulator run with --lockstep")
