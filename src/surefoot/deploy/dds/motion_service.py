"""A Go2's own motion controller: which one is active, its release, and how it gets the robot back."""

from __future__ import annotations

import time
from collections.abc import Callable

from surefoot.deploy.dds import services
from surefoot.deploy.dds.bus import Bus
from surefoot.errors import SurefootError

LIE_DOWN_TIMEOUT, RELEASE_TIMEOUT = 10.0, 5.0
"""Longest time [s] for the robot to lie down, and for its controller to be released."""
_ANSWER_TIMEOUT = 1.0
_POLL = 0.1


class MotionService:
    """Requests to a Go2's motion switcher and sport service."""

    def __init__(self, bus: Bus) -> None:
        self._switcher = services.Client(bus, services.MOTION_SWITCHER)
        self._sport = services.Client(bus, services.SPORT)

    def active(self) -> str | None:
        """Return the name of the active controller, empty if there is none; None if the robot does not answer."""
        try:
            return services.mode_name(self._switcher.call(services.CHECK_MODE, timeout=_ANSWER_TIMEOUT))
        except SurefootError:
            return None

    def release(self, lies: Callable[[], bool]) -> None:
        """Let the robot lie down, then release its controller: a robot that stands would sink.

        Args:
            lies: waits a moment, and returns whether the robot lies still.

        Raises:
            SurefootError: it does not lie down, its controller stays, or a service does not answer.
        """
        self._sport.call(services.STAND_DOWN)
        end = time.monotonic() + LIE_DOWN_TIMEOUT
        while not lies():
            if time.monotonic() > end:
                raise SurefootError(
                    f"the robot does not lie down within {LIE_DOWN_TIMEOUT:g} s; its controller was not released, and nothing "
                    "else was sent"
                )
        end = time.monotonic() + RELEASE_TIMEOUT
        while self.active() != "":
            if time.monotonic() > end:
                raise SurefootError(f"the robot's controller '{self.active()}' is not released within {RELEASE_TIMEOUT:g} s")
            self._switcher.call(services.RELEASE_MODE)
            time.sleep(_POLL)

    def hand_back(self) -> None:
        """Select the robot's own controller; it takes over a robot that lies.

        Raises:
            SurefootError: the robot does not answer, or refuses.
        """
        self._switcher.call(services.SELECT_MODE, {"name": services.OWN_CONTROLLER})
