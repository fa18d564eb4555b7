"""Arming a robot and letting it go, on a link that may lose frames."""

from __future__ import annotations

import math
from collections.abc import Callable

from surefoot.deploy.connection import RobotConnection
from surefoot.deploy.wire.messages import Fault, Handshake, Mode, Reason
from surefoot.errors import SurefootError

_ANSWER, _PING, _ATTEMPTS = 0.3, 0.02, 5
_CLEAN_MARGIN = 0.1


class Arming:
    """What a deployment and the doctor ask of a robot before and after it follows commands.

    Args:
        connection: to a robot that was greeted.
        handshake: what it said of itself.
        control_step: time between two commands [s].
        mode: what the commands are.
        lead: how long before the next command the robot is to send its state [s]; the connection's, if not given.
    """

    def __init__(
        self,
        connection: RobotConnection,
        handshake: Handshake,
        control_step: float,
        mode: Mode = Mode.POSITION,
        lead: float | None = None,
    ) -> None:
        self.connection, self.control_step, self.mode, self.lead = connection, control_step, mode, lead
        self.clean_time = handshake.rearm_after + _CLEAN_MARGIN
        """Time [s] for which a damped robot wants a clean link, and a little more."""

    def arm(self) -> None:
        """Let the servos hold the present pose, or motors be without duty.

        Raises:
            SurefootError: the robot does not arm; says why.
        """
        state = self.connection.last_state()
        if state.mode == Mode.FAULT or state.reason != Reason.NONE:
            self.keep_talking(lambda: False, self.clean_time)
        refusal = self._ask_to_arm()
        if refusal is not None and refusal.reason == Reason.NOT_CLEAN:
            self.keep_talking(lambda: False, self.clean_time)
            refusal = self._ask_to_arm()
        if self.connection.last_state().mode != self.mode:
            self.connection.disarm()
            raise SurefootError(f"the robot does not arm: {refusal.text if refusal is not None else 'no answer'}")

    def _ask_to_arm(self) -> Fault | None:
        """What the robot has against it, if it says so."""
        connection = self.connection
        asked = len(connection.faults)
        self.ask_until(
            lambda: connection.arm(self.mode, self.control_step, self.lead),
            lambda: connection.last_state().mode == self.mode or len(connection.faults) > asked,
        )
        return connection.faults[-1] if len(connection.faults) > asked else None

    def keep_talking(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait until a condition holds, and ping meanwhile, so that the link is seen to be clean."""
        clock, last = self.connection.clock, -math.inf

        def ping() -> None:
            nonlocal last
            if clock.now() - last >= _PING:
                last = clock.now()
                self.connection.link.ping()

        return self.connection.wait_for(condition, timeout, ping)

    def ask_until(self, ask: Callable[[], None], condition: Callable[[], bool]) -> bool:
        """Ask again and again until a condition holds, since frames may be lost; whether it did."""
        for _ in range(_ATTEMPTS):
            ask()
            if self.connection.wait_for(condition, _ANSWER / _ATTEMPTS):
                return True
        return False
