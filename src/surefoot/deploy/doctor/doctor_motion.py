"""Motions of the doctor: a robot is armed, moved, and disarmed or damped afterwards."""

from __future__ import annotations

from types import TracebackType
from typing import Self

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, skip_checks
from surefoot.deploy.doctor.rest_check import TimedState
from surefoot.deploy.messages import Mode, State
from surefoot.deploy.motion_runner import MotionRunner
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.safety import Act, Verdict
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals


class MotionStoppedError(RuntimeError):
    """A motion was stopped by the guard or the operator."""

    def __init__(self, verdict: Verdict) -> None:
        super().__init__(verdict.text)
        self.verdict = verdict

    def results(self, names: tuple[str, ...], failed: CheckResult | None = None) -> list[CheckResult]:
        """Return the results of the checks that the motion was for; `failed` in place of the verdict's text."""
        if self.verdict.reason == "operator":
            return skip_checks(names, "stopped by the operator", "run it again")
        failed = failed or CheckResult(names[0], False, self.verdict.text, "mend that, and run the doctor again")
        return [failed, *skip_checks(names[1:], "the motion was stopped")]


class TrackingError(RuntimeError):
    """A motor is too far from its target."""


def _may_sit(error: BaseException | None) -> bool:
    """Return whether the robot may sit down and disarm: no error ended the motion, or a stop that allows it."""
    return error is None or (isinstance(error, MotionStoppedError) and error.verdict.act is Act.SIT)


class DoctorMotion(MotionRunner):
    """A robot that is armed while this context is entered; afterwards it is disarmed, or damped if an error occurred.

    Args:
        link: to the robot, after its handshake.
        robot: its description.
        control_step: time between two commands [s].
        operator: may stop it.
        max_error: greatest difference of a motor's angle from its target [rad]; more damps all motors.
        sits: whether it stands on the ground, and sits down before it is disarmed.

    Raises:
        SurefootError: on entering, if the robot does not arm; nothing has moved then.
        MotionStoppedError: from any motion that the guard or the operator stopped.
    """

    def __init__(
        self,
        link: RobotLink,
        robot: RobotDescription,
        control_step: float,
        operator: StopSignals,
        max_error: float,
        sits: bool = False,
    ) -> None:
        super().__init__(link, robot, control_step, operator)
        self.max_error, self.sits = max_error, sits
        self.tracking_error: tuple[int, float] | None = None
        """Motor whose error was too great, and its error [rad]."""
        self.states: list[TimedState] = []
        """All states since it was armed."""
        self._first_command: int | None = None

    def __enter__(self) -> Self:
        """Arm: the servos hold their present angles."""
        self.link.on_state = lambda state, sent, _: self.states.append(TimedState(sent, state))
        try:
            self.arm()
        except BaseException:
            self.link.on_state = None
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Sit down, if the robot stands, and disarm; damp after an error."""
        damp = not _may_sit(error)
        try:
            if damp:
                self.loop.damp()
            elif self.sits:
                self._raise_if_stopped(self.sit_down())
        except BaseException as stopped:
            damp = not _may_sit(stopped)
            raise
        finally:
            self.link.on_state = None
            if self.state.mode != Mode.FAULT:
                self.release(damp)

    def hold(self, target: Array, duration: float) -> tuple[int, list[TimedState]]:
        """Send motor angles (M,) [rad] at once and hold them for a duration [s].

        Returns:
            number of the first command, and the states that came.
        """
        self._first_command, first = None, len(self.states)
        self._raise_if_stopped(self.move("doctor", target, duration, start=target))
        return self._first_command or 0, self.states[first:]

    def go(self, target: Array, duration: float) -> None:
        """Go smoothly to motor angles (M,) [rad] within a duration [s]."""
        self._raise_if_stopped(self.move("doctor", target, duration))

    def _raise_if_stopped(self, verdict: Verdict) -> None:
        if verdict.act is not Act.GO:
            raise MotionStoppedError(verdict)

    def check_state(self, state: State) -> None:
        """Raise `TrackingError` when a motor is too far from its target."""
        if self._first_command is None:
            self._first_command = self.link.next_number
        errors = state.motor_angle - self.target
        worst = int(np.argmax(np.abs(errors)))
        if abs(errors[worst]) > self.max_error:
            self.tracking_error = worst, float(errors[worst])
            raise TrackingError(
                f"{self.robot.motor_names[worst]} is {errors[worst]:+.2f} rad from where it was sent; "
                f"at most {self.max_error:g}"
            )
