"""How the doctor moves a robot: the same loop and guard as a deployment, smooth ways, and a leash."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.arming import Arming
from surefoot.deploy.connection import RobotConnection
from surefoot.deploy.doctor.rest import Sample
from surefoot.deploy.loop import ControlLoop, Silent
from surefoot.deploy.pacer import Timing
from surefoot.deploy.poses import between, sitting
from surefoot.deploy.safety import Act, Guard, Verdict
from surefoot.deploy.safety_limits import SafetyLimits
from surefoot.deploy.stop_signals import StopSignals
from surefoot.deploy.wire.messages import Handshake, Mode, State
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription

Array = NDArray[np.float64]

SIT_TIME = 1.5
"""Time to sit down [s]."""


class MotionStoppedError(RuntimeError):
    """A motion ended before its end; motors are damped, or it will sit."""

    def __init__(self, verdict: Verdict) -> None:
        super().__init__(verdict.text)
        self.verdict = verdict


def _may_sit(error: BaseException) -> bool:
    """Whether what ended a motion leaves time to sit down and disarm."""
    return isinstance(error, MotionStoppedError) and error.verdict.act is Act.SIT


class _Strayed(RuntimeError):
    """A motor is not where it was sent."""


@dataclass(frozen=True)
class Moved:
    """What was seen while a robot moved."""

    samples: list[Sample]
    """States that came."""
    command: int
    """Number of the frame that carried the first command."""


class Mover:
    """A robot that is armed while this is entered; afterwards it is disarmed, or damped if anything went wrong.

    Args:
        connection: to a robot that was greeted.
        robot: its data sheet.
        control_step: time between two commands [s].
        operator: may ask to stop.
        leash: how far [rad] a motor may be from where it was sent.
        sits: whether it stands on the ground, and sits down before it is disarmed.
        limits: of a deployment.

    Raises:
        SurefootError: on entering, if the robot does not arm; nothing has moved then.
        MotionStoppedError: from any motion that safety or the operator ended.
    """

    def __init__(
        self,
        connection: RobotConnection,
        robot: RobotDescription,
        control_step: float,
        operator: StopSignals,
        leash: float,
        sits: bool = False,
        limits: SafetyLimits | None = None,
    ) -> None:
        if connection.handshake is None:
            raise SurefootError("the robot was not greeted")
        self.connection, self.robot, self.control_step, self.sits = connection, robot, control_step, sits
        self.handshake: Handshake = connection.handshake
        self.leash = leash
        self._arming = Arming(connection, self.handshake, control_step)
        self.strayed: tuple[int, float] | None = None
        """Motor that left its way, and by how much [rad]."""
        guard = Guard(limits or SafetyLimits(), control_step, connection.session)
        self._loop = ControlLoop(connection, control_step, guard, operator, Silent(), Timing(0))
        self._samples: list[Sample] = []

    # Arming and its end.

    def __enter__(self) -> Mover:
        """Arm: the servos hold the angles that they find."""
        self.connection.on_state = lambda state, sent, _: self._samples.append(Sample(sent, state))
        try:
            self._arming.arm()
        except BaseException:
            self.connection.on_state = None
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Sit down, if the robot stands, and disarm; damp if anything went wrong."""
        damp = error is not None and not _may_sit(error)
        try:
            if damp:
                self._loop.damp()
            elif self.sits:
                self._follow(self._present(), sitting(self.robot), SIT_TIME, sitting_down=True)
        except BaseException as failed:
            damp = not _may_sit(failed)
            raise
        finally:
            self.connection.on_state = None
            self._let_go(damp)

    def _let_go(self, damp: bool) -> None:
        """Disarm or damp, again if there is no answer: frames may be lost."""
        if self._state().mode == Mode.FAULT:
            return
        ask = self._loop.damp if damp else self.connection.disarm
        if not self._arming.ask_until(ask, lambda: self._state().mode in (Mode.DISARMED, Mode.FAULT)):
            self._loop.damp()

    # Motions.

    def _state(self) -> State:
        return self.connection.last_state()

    def _present(self) -> Array:
        return self._loop.target if self._loop.target is not None else self._state().motor_angle

    def hold(self, target: Array, duration: float) -> Moved:
        """Send motor angles (M,) [rad] at once and hold them for a while [s]."""
        return self._follow(target, target, duration)

    def go(self, target: Array, duration: float) -> Moved:
        """Go smoothly to motor angles (M,) [rad] within a time [s]."""
        return self._follow(self._present(), target, duration)

    def _follow(self, start: Array, end: Array, duration: float, sitting_down: bool = False) -> Moved:
        first, steps = len(self._samples), self._loop.steps_of(duration)
        number = 0
        low, high = self.handshake.angle_low, self.handshake.angle_high

        def target(k: int, state: State, missed: int) -> Array:
            nonlocal number
            if not number:
                number = self.connection.link.counts.sent + 1
            self._check_leash(state.motor_angle)
            return np.clip(between(start, end, (k + 1) / steps), low, high)

        verdict = self._loop.follow("doctor", steps, target, sitting=sitting_down)
        if verdict.act is not Act.GO:
            raise MotionStoppedError(verdict)
        return Moved(self._samples[first:], number)

    def _check_leash(self, angles: Array) -> None:
        off = angles - self._present()
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) > self.leash:
            self.strayed = worst, float(off[worst])
            raise _Strayed(
                f"{self.robot.motor_names[worst]} is {off[worst]:+.2f} rad from where it was sent; "
                f"at most {self.leash:g}"
            )

    def samples(self) -> list[Sample]:
        """All states since it was armed."""
        return self._samples
