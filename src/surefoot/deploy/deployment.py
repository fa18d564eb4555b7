"""A policy on a robot from beginning to end: greet, check, arm, stand up, run, sit down, disarm."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.connection import RobotConnection
from surefoot.deploy.controller import Controller
from surefoot.deploy.link import LinkLostError
from surefoot.deploy.loop import ControlLoop, Watch
from surefoot.deploy.pacer import Timing
from surefoot.deploy.poses import between, lying, pose, sitting
from surefoot.deploy.recorder import Recorder
from surefoot.deploy.safety import GO, Act, Guard, SafetyLimits, Verdict
from surefoot.deploy.stop_signals import StopSignals
from surefoot.deploy.wire import Handshake, Mode, Reason, State
from surefoot.errors import SurefootError

Array = NDArray[np.float64]

FLAT, FOLD, RISE, HOLD, SLOW, STOP, SIT = 1.0, 1.0, 1.5, 0.5, 1.0, 0.3, 1.5
"""Time [s] to lay the legs flat, to draw them in, to stand up, to stand before the policy starts (as long as a robot
settles in simulation), to fade from the gait to standing, to come to rest, and to sit down."""
AROUND = FLAT + FOLD + STOP + RISE + HOLD + SLOW + STOP + SIT
"""Time [s] that a run takes besides its policy's."""
STILL_SPEED = 0.5
"""Speed [rad/s] of motors and base below which a fallen robot lies still."""
_STILL_PATIENCE, _ANSWER, _PING = 5.0, 0.3, 0.02
_CLEAN_MARGIN = 0.1


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    ended: str
    """time, fall, fault or stopped, as traces have it."""
    reason: str
    """In a word or two."""
    text: str
    """In plain words."""
    safe: bool
    """Whether the robot's or the computer's safety ended it."""


class Deployment:
    """One operator's time with a robot.

    Args:
        connection: to the robot.
        controller: the policy on it.
        operator: may ask to stop.
        watch: is told how it goes.
        limits: when a run ends early.
        dry_run: compute everything, and neither arm nor send.
    """

    def __init__(
        self,
        connection: RobotConnection,
        controller: Controller,
        operator: StopSignals,
        watch: Watch,
        limits: SafetyLimits | None = None,
        dry_run: bool = False,
    ) -> None:
        self.connection, self.controller, self.operator, self.watch = connection, controller, operator, watch
        self.contract, self.robot = controller.contract, controller.robot
        self.limits, self.dry_run = limits or SafetyLimits(), dry_run
        self.handshake: Handshake | None = None

    def greet(self, check: Callable[[Handshake], None]) -> Handshake:
        """Ask for the robot, check it, and wait until it tells its state.

        Args:
            check: raises an error for a robot that the policy is not for.

        Raises:
            SurefootError: no robot, another one, or one that tells nothing.
        """
        self.watch.phase("greet", 0.0)
        period = self.contract.control_step
        self.handshake = self.connection.connect(state_period=period)
        check(self.handshake)
        if not self.connection.wait_for(lambda: self.connection.state is not None, 1.0):
            raise SurefootError("the robot tells nothing of itself within 1 s; switch it off and on again")
        for _ in range(20):
            # A network's first runs are slow.
            self.controller.command(0.0, self.controller.observe(0.0, self._state()))
        self.controller.reset()
        return self.handshake

    def _state(self) -> State:
        state = self.connection.state
        if state is None:
            raise SurefootError("the robot has told nothing of itself yet")
        return state

    def run(
        self, recorder: Recorder, timing: Timing, keep: Callable[[Array], None], begun: Callable[[float], None]
    ) -> Outcome:
        """Arm, stand up, run the policy, sit down, disarm.

        Args:
            recorder: takes the policy's control steps; as many are done as it has place for.
            timing: keeps lateness.
            keep: called with rows that have been closed.
            begun: called with the robot's time [s] when the policy starts.

        Raises:
            SurefootError: the robot does not arm; nothing has moved.
        """
        contract = self.contract
        fall_angle = contract.task.get("fall_angle")
        tilt = float(fall_angle) if isinstance(fall_angle, int | float) and fall_angle > 0 else None
        guard = Guard(self.limits, contract.control_step, self.connection.session, tilt)
        loop = ControlLoop(
            self.connection, contract.control_step, guard, self.operator, self.watch, timing, self.dry_run
        )
        if self.operator.stops:
            return Outcome("stopped", "operator", "stopped before anything moved", False)
        if not self.dry_run:
            self.watch.phase("arm", 0.0)
            self._arm()
        verdict = self._stand(loop)
        if verdict.act is Act.GO:
            verdict = self._run_policy(loop, recorder, keep, begun)
        return self._finish(loop, verdict)

    def _arm(self) -> None:
        connection = self.connection
        if self._state().mode == Mode.FAULT or self._state().reason != Reason.NONE:
            self._wait_clean(lambda: False, self._clean_time())
        asked = len(connection.faults)
        connection.arm(Mode.POSITION, self.contract.control_step)
        answered = connection.wait_for(
            lambda: self._state().mode == Mode.POSITION or len(connection.faults) > asked, _ANSWER
        )
        if self._state().mode != Mode.POSITION:
            why = connection.faults[-1].text if len(connection.faults) > asked else "no answer"
            connection.disarm()
            raise SurefootError(f"the robot does not arm: {why if answered else 'no answer'}")

    def _clean_time(self) -> float:
        """Time [s] for which a damped robot wants a clean link, and a little more."""
        return (self.handshake.rearm_after if self.handshake else 0.0) + _CLEAN_MARGIN

    def _wait_clean(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Keep talking until a condition holds, so that the link is seen to be clean."""
        clock, last = self.connection.clock, -math.inf

        def ping() -> None:
            nonlocal last
            if clock.now() - last >= _PING:
                last = clock.now()
                self.connection.link.ping()

        return self.connection.wait_for(condition, timeout, ping)

    def _clipped(self, target: Array) -> Array:
        """Within what the robot takes: it may be switched on in a pose beyond."""
        if self.handshake is None:
            return target
        return np.clip(target, self.handshake.angle_low, self.handshake.angle_high)

    def _move(
        self,
        loop: ControlLoop,
        phase: str,
        start: Array,
        end: Array,
        duration: float,
        upright: bool = True,
        sitting: bool = False,
    ) -> Verdict:
        steps = loop.steps_of(duration)

        def target(k: int, state: State, missed: int) -> Array:
            return self._clipped(between(start, end, (k + 1) / steps))

        return loop.follow(phase, steps, target, upright=upright, sitting=sitting)

    def _stand(self, loop: ControlLoop) -> Verdict:
        """Rise from wherever the legs lie: a damped robot sinks onto its belly, and its legs slide out from under it.

        They are laid flat and drawn in first. Motors that pushed the body up at once, with the feet out at the side,
        would stall at full current and then leap.
        """
        found = self._state().motor_angle
        flat, drawn, stand = lying(self.robot, found), sitting(self.robot), pose(self.robot, *self.contract.rest)
        for phase, start, end, duration in (
            ("lay legs flat", found, flat, FLAT),
            ("draw legs in", flat, drawn, FOLD),
            ("sit", drawn, drawn, STOP),
            ("stand up", drawn, stand, RISE),
            ("stand", stand, stand, HOLD),
        ):
            verdict = self._move(loop, phase, start, end, duration)
            if verdict.act is not Act.GO:
                return verdict
        return GO

    def _run_policy(
        self, loop: ControlLoop, recorder: Recorder, keep: Callable[[Array], None], begun: Callable[[float], None]
    ) -> Verdict:
        controller, step = self.controller, self.contract.control_step
        controller.reset()

        def compute(k: int, state: State, missed: int) -> Array:
            target = controller.command(k * step, controller.observe(k * step, state, missed))
            loop.inference = controller.inference
            return target

        def after(k: int, state: State, computed: bool) -> None:
            if k == 0:
                begun(loop.pacer.due(0) - self.connection.sync.offset)
                recorder.begin(state)
            rows = recorder.close(k, state, self.connection.state_sent)
            if len(rows):
                keep(rows)
            if computed:
                recorder.open(controller.observation, controller.feedback, controller.target)

        verdict = loop.follow("run", recorder.max_steps, compute, after)
        if verdict.act not in (Act.GO, Act.SIT):
            return verdict
        ending = self._slow_down(loop, recorder.steps + 1)
        return verdict if ending.act is Act.GO else ending

    def _slow_down(self, loop: ControlLoop, first: int) -> Verdict:
        """Fade from the gait to the stand: a robot that stopped in the middle of a stride would fall over its feet.

        Args:
            loop: the loop.
            first: control step of the policy with which it goes on.
        """
        controller, step = self.controller, self.contract.control_step
        stand, steps = pose(self.robot, *self.contract.rest), loop.steps_of(SLOW)

        def compute(k: int, state: State, missed: int) -> Array:
            now = (first + k) * step
            target = controller.command(now, controller.observe(now, state, missed))
            return self._clipped(between(target, stand, (k + 1) / steps))

        verdict = loop.follow("slow down", steps, compute, sitting=True)
        return verdict if verdict.act is not Act.GO else self._move(loop, "stand", stand, stand, STOP, sitting=True)

    def _finish(self, loop: ControlLoop, verdict: Verdict) -> Outcome:
        """Bring the robot to rest, whatever happened."""
        outcome = _outcome(verdict)
        try:
            if verdict.act in (Act.GO, Act.SIT):
                ending = self._sit(loop, loop.target if loop.target is not None else self._state().motor_angle)
                if ending.act is not Act.GO:
                    # What went wrong at the end is worse than what ended the run.
                    outcome, verdict = _outcome(ending), ending
            if verdict.act is Act.FALL and not self.dry_run:
                text = self._sit_after_fall(loop)
                outcome = Outcome(outcome.ended, outcome.reason, f"{outcome.text}; {text}", True)
            if verdict.act in (Act.DAMP, Act.FALL) and not self.dry_run:
                self._confirm_damped(loop)
        except (LinkLostError, SurefootError) as error:
            return Outcome("fault", "link", f"{outcome.text}; then {error}" if outcome.text else str(error), True)
        return outcome

    def _sit(self, loop: ControlLoop, start: Array, upright: bool = True) -> Verdict:
        verdict = self._move(loop, "sit down", start, sitting(self.robot), SIT, upright, True)
        if verdict.act is Act.GO and not self.dry_run:
            self.watch.phase("disarm", 0.0)
            if not self._ask_until(self.connection.disarm, lambda: self._state().mode != Mode.POSITION):
                loop.damp()
                return Verdict(Act.DAMP, "disarm", "the robot does not say that it has disarmed")
        return verdict

    def _ask_until(self, ask: Callable[[], None], condition: Callable[[], bool]) -> bool:
        """Ask, and again if there is no answer; frames may be lost."""
        for _ in range(5):
            ask()
            if self.connection.wait_for(condition, _ANSWER / 5):
                return True
        return False

    def _confirm_damped(self, loop: ControlLoop) -> None:
        self._ask_until(loop.damp, lambda: self._state().mode != Mode.POSITION)

    def _sit_after_fall(self, loop: ControlLoop) -> str:
        """Wait until a fallen robot lies still, then let it sit, if it is not on its side; says what came of it."""
        self._confirm_damped(loop)
        self.watch.phase("lie still", _STILL_PATIENCE)
        clock = self.connection.clock
        earliest = clock.now() + self._clean_time()

        def still() -> bool:
            state = self._state()
            speed = max(np.abs(state.motor_velocity).max(), np.abs(state.angular_velocity_base).max())
            return clock.now() >= earliest and bool(speed < STILL_SPEED)

        if not self._wait_clean(still, _STILL_PATIENCE):
            return "it does not come to rest and stays damped"
        tilt = np.abs(self._state().roll_pitch_yaw[:2]).max()
        if self.handshake is not None and tilt > self.handshake.tilt_limit:
            return "it lies on its side and stays damped"
        try:
            self._arm()
        except SurefootError as error:
            return f"it stays damped: {error}"
        ending = self._sit(loop, self._state().motor_angle, upright=False)
        return "it has sat down" if ending.act is Act.GO else f"it stays damped: {ending.text}"

    def close(self) -> None:
        """Give the robot back."""
        with contextlib.suppress(LinkLostError, OSError):
            self.connection.close()


def _outcome(verdict: Verdict) -> Outcome:
    if verdict == GO:
        return Outcome("time", "time", "done", False)
    if verdict.act is Act.FALL:
        return Outcome("fall", verdict.reason, verdict.text, True)
    if verdict.reason == "operator":
        return Outcome("stopped", verdict.reason, verdict.text, verdict.act is Act.DAMP)
    if verdict.act is Act.SIT:
        return Outcome("stopped", verdict.reason, verdict.text, True)
    return Outcome("fault", verdict.reason, verdict.text, True)
