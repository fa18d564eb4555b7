"""A robot that the doctor moves: armed for a while, on a leash, and disarmed or damped afterwards."""

from __future__ import annotations

from types import TracebackType
from typing import Self

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.doctor.rest import Sample
from surefoot.deploy.messages import Mode, State
from surefoot.deploy.motion_runner import MotionRunner
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.safety import Act, Verdict
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals


class MotionStoppedError(RuntimeError):
    """A motion ended before its end; motors are damped, or it will sit."""

    def __init__(self, verdict: Verdict) -> None:
        super().__init__(verdict.text)
        self.verdict = verdict


class LeashError(RuntimeError):
    """A motor is not where it was sent."""


def _may_sit(error: BaseException | None) -> bool:
    """Return whether what ended a motion, if anything, leaves time to sit down and disarm."""
    return error is None or (isinstance(error, MotionStoppedError) and error.verdict.act is Act.SIT)


class LeashedRobot(MotionRunner):
    """A robot that is armed while this is entered; afterwards it is disarmed, or damped if anything went wrong.

    Args:
        link: to the robot, greeted.
        robot: its description.
        control_step: of the commands [s].
        operator: whoever may stop it.
        leash: how far [rad] a motor may be from where it was sent.
        sits: whether it stands on the ground, and sits down before it is disarmed.

    Raises:
        SurefootError: on entering, if the robot does not arm; nothing has moved then.
        MotionStoppedError: from any motion that safety or the operator ended.
    """

    def __init__(
        self,
        link: RobotLink,
        robot: RobotDescription,
        control_step: float,
        operator: StopSignals,
        leash: float,
        sits: bool = False,
    ) -> None:
        super().__init__(link, robot, control_step, operator)
        self.leash, self.sits = leash, sits
        self.strayed: tuple[int, float] | None = None
        """Motor that left its way, and by how much [rad]."""
        self.samples: list[Sample] = []
        """All states since it was armed."""
        self._first_command: int | None = None

    def __enter__(self) -> Self:
        """Arm: the servos hold the angles that they find."""
        self.link.on_state = lambda state, sent, _: self.samples.append(Sample(sent, state))
        try:
            self.arm()
        except BaseException:
            self.link.on_state = None
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Sit down, if the robot stands, and disarm; damp if anything went wrong."""
        damp = not _may_sit(error)
        try:
            if damp:
                self.loop.damp()
            elif self.sits:
                self._check(self.sit_down())
        except BaseException as failed:
            damp = not _may_sit(failed)
            raise
        finally:
            self.link.on_state = None
            if self.state.mode != Mode.FAULT:
                self.release(damp)

    def hold(self, target: Array, duration: float) -> tuple[int, list[Sample]]:
        """Send motor angles (M,) [rad] at once and hold them for a while [s].

        Returns:
            number of the frame that carried the first command, and the states that came.
        """
        self._first_command, first = None, len(self.samples)
        self._check(self.move("doctor", target, duration, start=target))
        return self._first_command or 0, self.samples[first:]

    def go(self, target: Array, duration: float) -> None:
        """Go smoothly to motor angles (M,) [rad] within a time [s]."""
        self._check(self.move("doctor", target, duration))

    def _check(self, verdict: Verdict) -> None:
        if verdict.act is not Act.GO:
            raise MotionStoppedError(verdict)

    def check_state(self, state: State) -> None:
        """Raise `LeashError` when a motor is not where it was sent."""
        if self._first_command is None:
            self._first_command = self.link.next_number
        off = state.motor_angle - self.target
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) > self.leash:
            self.strayed = worst, float(off[worst])
            raise LeashError(
                f"{self.robot.motor_names[worst]} is {off[worst]:+.2f} rad from where it was sent; "
                f"at most {self.leash:g}"
            )
