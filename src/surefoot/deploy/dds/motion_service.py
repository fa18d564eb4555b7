"""Requests about a Go2's own motion controllers: the active one, its release, and its selection at the end."""

from __future__ import annotations

import time
from collections.abc import Callable

from surefoot.deploy.dds import services
from surefoot.deploy.dds.bus import Bus
from surefoot.errors import SurefootError

LIE_DOWN_TIMEOUT, RELEASE_TIMEOUT = 10.0, 5.0
"""Maximum times for the robot to lie down, and for the release of its controller [s]."""
_ANSWER_TIMEOUT = 1.0
_POLL_PERIOD = 0.1


class MotionService:
    """Client of a Go2's motion switcher and sport service."""

    def __init__(self, bus: Bus) -> None:
        self._switcher = services.Client(bus, services.MOTION_SWITCHER)
        self._sport = services.Client(bus, services.SPORT)

    def active_controller(self) -> str | None:
        """Return the name of the active controller, "" for no controller, or None if the robot does not answer."""
        try:
            return services.mode_name(self._switcher.call(services.CHECK_MODE, timeout=_ANSWER_TIMEOUT))
        except SurefootError:
            return None

    def release(self, is_lying: Callable[[], bool]) -> None:
        """Make the robot lie down, then release its controller; a standing robot would sink.

        Args:
            is_lying: observes the robot for a moment, and returns whether it lies still.

        Raises:
            SurefootError: the robot does not lie down, its controller is not released, or a service does not answer.
        """
        self._sport.call(services.STAND_DOWN)
        end = time.monotonic() + LIE_DOWN_TIMEOUT
        while not is_lying():
            if time.monotonic() > end:
                raise SurefootError(
                    f"the robot does not lie down within {LIE_DOWN_TIMEOUT:g} s; its controller was not released, and "
                    "nothing else was sent"
                )
        end = time.monotonic() + RELEASE_TIMEOUT
        while self.active_controller() != "":
            if time.monotonic() > end:
                name = self.active_controller()
                raise SurefootError(f"the robot's controller '{name}' is not released within {RELEASE_TIMEOUT:g} s")
            self._switcher.call(services.RELEASE_MODE)
            time.sleep(_POLL_PERIOD)

    def hand_back(self) -> None:
        """Select the robot's own controller, while the robot is lying.

        Raises:
            SurefootError: the robot does not answer, or rejects the request.
        """
        self._switcher.call(services.SELECT_MODE, {"name": services.OWN_CONTROLLER})
