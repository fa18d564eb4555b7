"""Motions of the doctor: arm a robot, move it, and disarm or damp it afterwards."""

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
    """A motion was stopped by the safety guard or the operator."""

    def __init__(self, verdict: Verdict) -> None:
        super().__init__(verdict.text)
        self.verdict = verdict

    def results(self, names: tuple[str, ...], failed: CheckResult | None = None) -> list[CheckResult]:
        """Return the results of the checks that needed the motion: the first failed, the others were skipped.

        Args:
            names: names of the checks.
            failed: result of the first check. Defaults to a failure with the guard's message.
        """
        if self.verdict.reason == "operator":
            return skip_checks(names, "stopped by the operator", "run it again")
        failed = failed or CheckResult(names[0], False, self.verdict.text, "fix this, and run the doctor again")
        return [failed, *skip_checks(names[1:], "the motion was stopped")]


class TrackingError(RuntimeError):
    """A motor deviates too far from its target."""


def _may_sit(error: BaseException | None) -> bool:
    """Return whether the robot may sit down and disarm: the motion ended without error, or with a verdict to sit."""
    return error is None or (isinstance(error, MotionStoppedError) and error.verdict.act is Act.SIT)


class DoctorMotion(MotionRunner):
    """Context in which a robot is armed and moved; on exit it is disarmed, or damped after an error.

    Args:
        link: link to the robot, after the handshake.
        robot: robot description.
        control_step: time between two commands [s].
        operator: signals by which the operator can stop the motion.
        max_error: maximum deviation of a motor angle from its target [rad]; a larger one damps all motors.

    Raises:
        SurefootError: on entry, if the robot does not arm; nothing has moved then.
        MotionStoppedError: from any motion that is stopped by the safety guard or the operator.
    """

    def __init__(
        self,
        link: RobotLink,
        robot: RobotDescription,
        control_step: float,
        operator: StopSignals,
        max_error: float,
    ) -> None:
        super().__init__(link, robot, control_step, operator)
        self.max_error = max_error
        self.tracking_error: tuple[int, float] | None = None
        """Index and deviation [rad] of the motor that deviated too far; None if none did."""
        self.states: list[TimedState] = []
        """All states since the robot was armed."""
        self._first_command: int | None = None

    def __enter__(self) -> Self:
        """Arm the robot; the servos hold their current angles."""
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
        """Sit down if the robot stands, and disarm; damp the motors after an error."""
        damp = not _may_sit(error)
        try:
            if damp:
                self.loop.damp()
            elif self.has_risen:
                self._raise_if_stopped(self.sit_down())
        except BaseException as stopped:
            damp = not _may_sit(stopped)
            raise
        finally:
            self.link.on_state = None
            if self.state.mode != Mode.FAULT:
                self.release(damp)

    def hold(self, target: Array, duration: float) -> tuple[int, list[TimedState]]:
        """Step to motor angles (M,) [rad] and hold them for a duration [s].

        Returns:
            Number of the first command, and the states received since then.
        """
        self._first_command, first = None, len(self.states)
        self._raise_if_stopped(self.move("doctor", target, duration, start=target))
        return self._first_command or 0, self.states[first:]

    def go(self, target: Array, duration: float) -> None:
        """Move smoothly to motor angles (M,) [rad] within a duration [s]."""
        self._raise_if_stopped(self.move("doctor", target, duration))

    def rise(self, standing: Array) -> None:
        """Stand up to motor angles (M,) [rad] from any lying pose; on exit the robot then sits down."""
        self._raise_if_stopped(self.stand_up(standing))

    def _raise_if_stopped(self, verdict: Verdict) -> None:
        if verdict.act is not Act.GO:
            raise MotionStoppedError(verdict)

    def check_state(self, state: State) -> None:
        """Raise `TrackingError` if a motor deviates too far from its target."""
        if self._first_command is None:
            self._first_command = self.link.next_number
        errors = state.motor_angle - self.target
        worst = int(np.argmax(np.abs(errors)))
        if abs(errors[worst]) > self.max_error:
            self.tracking_error = worst, float(errors[worst])
            raise TrackingError(
                f"{self.robot.motor_names[worst]} is {errors[worst]:+.2f} rad from its target; at most "
                f"{self.max_error:g}"
            )
