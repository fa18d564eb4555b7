"""A policy on a robot from beginning to end: greet, check, arm, stand up, run, sit down, disarm."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from surefoot.arrays import Array
from surefoot.deploy.command_sources import CommandSource
from surefoot.deploy.controller import Controller
from surefoot.deploy.loop import ControlLoop, RunMonitor
from surefoot.deploy.messages import Handshake, State
from surefoot.deploy.motion_runner import MotionRunner
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.recorder import Recorder
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.safety import GO, Act, Guard, SafetyLimits, Verdict
from surefoot.errors import SurefootError
from surefoot.stop_signals import StopSignals

Keep = Callable[[Array], None]
Begun = Callable[[float], None]

_WARM_UP = 20
PUNCTUAL, TRIES = 200, 10
"""Control steps that must come and go without a fault before a robot is armed, and how often that is tried."""


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended."""

    ended: str
    """time, fall, fault or stopped, as traces have it: how the policy's part ended."""
    reason: str
    """In a word or two."""
    text: str
    """In plain words, what came afterwards included."""
    safe: bool
    """Whether the robot's or the computer's safety ended the run."""


class Deployment:
    """One operator's time with a robot.

    Args:
        link: to the robot.
        controller: the policy on it.
        operator: may ask to stop.
        monitor: is told how it goes.
        dry_run: compute everything, and neither arm nor send.
        commands: what steers it, of a policy with commands; without it the robot stands.
    """

    def __init__(
        self,
        link: RobotLink,
        controller: Controller,
        operator: StopSignals,
        monitor: RunMonitor,
        dry_run: bool = False,
        commands: CommandSource | None = None,
    ) -> None:
        self.commands = commands
        self.link, self.controller, self.operator, self.monitor = link, controller, operator, monitor
        self.contract, self.robot = controller.contract, controller.robot
        self.limits, self.dry_run = SafetyLimits.of(self.robot), dry_run
        self._moved = False

    def greet(self, check: Callable[[Handshake], None]) -> None:
        """Ask for the robot, check it, and wait until it tells its state.

        Args:
            check: raises an error for a robot that the policy is not for.

        Raises:
            SurefootError: no robot, another one, one that tells nothing or that must not be armed; or a computer that
                does not keep time.
        """
        self.monitor.phase("greet", 0.0)
        try:
            check(self.link.connect(state_period=self.contract.control_step))
            if not self.link.wait_for(lambda: self.link.state is not None, 1.0):
                raise SurefootError("the robot tells nothing of itself within 1 s; switch it off and on again")
            self._warm_up()
            if not self.link.lockstep:
                self._keep_time()
        except LinkLostError as error:
            raise SurefootError(f"the robot was lost before it was armed: {error}") from error
        self.controller.reset()

    def _warm_up(self) -> None:
        """Ask the policy some times: a network's first runs are slow, and what fails is best found now."""
        try:
            for _ in range(_WARM_UP):
                self.controller.command(0.0, self.controller.observe(0.0, self.link.last_state()))
        except SurefootError:
            raise
        except Exception as error:
            text = " ".join(str(error).split())
            raise SurefootError(
                f"policy '{self.contract.name}' fails on what the robot tells now: {type(error).__name__}: {text}"
            ) from error

    def _keep_time(self) -> None:
        """Go through control steps as if the robot were armed, until the computer does them in time.

        What is done for the first time takes longer: pages are read, caches filled. And a computer that is too busy,
        or a robot that should not be armed, shows it here, while nothing moves.

        Raises:
            SurefootError: something that would end a run is so from the start, or goes wrong again and again.
        """
        step, verdict = self.contract.control_step, GO

        def compute(k: int, state: State, missed: int) -> Array:
            return self.controller.command(k * step, self.controller.observe(k * step, state, missed))

        for _ in range(TRIES):
            guard = Guard(self.limits, step, self.link.session, math.inf)
            loop = ControlLoop(
                self.link, step, guard, self.operator, self.monitor, LoopTiming(PUNCTUAL + 1), dry_run=True
            )
            verdict = loop.follow("keep time", PUNCTUAL, compute)
            if verdict.act in (Act.GO, Act.SIT):
                # The operator's wish to stop is for `run` to heed; a battery or a motor that is at its limit is not.
                break
        if verdict.act is not Act.GO and not self.operator.stops:
            raise SurefootError(f"the robot is not armed: {verdict.text}")

    def run(self, recorder: Recorder, timing: LoopTiming, keep: Keep, begun: Begun) -> RunOutcome:
        """Arm, stand up, run the policy, sit down, disarm.

        Args:
            recorder: takes the policy's control steps; as many are done as it has place for.
            timing: keeps lateness.
            keep: called with rows that have been closed.
            begun: called with the robot's time [s] when the policy starts.

        Raises:
            SurefootError: the robot was not greeted, or does not arm for its first run; nothing has moved.
        """
        contract = self.contract
        runner = MotionRunner(
            self.link,
            self.robot,
            contract.control_step,
            self.operator,
            self.monitor,
            self.limits,
            self.controller.task.fall_angle,
            timing=timing,
            dry_run=self.dry_run,
        )
        if self.operator.stops:
            return RunOutcome("stopped", "operator", "stopped before anything moved", False)
        try:
            if not self.dry_run:
                self.monitor.phase("arm", 0.0)
                runner.arm()
        except (LinkLostError, SurefootError) as error:
            if not self._moved:
                raise SurefootError(str(error)) from error
            return RunOutcome("fault", "arm", str(error), True)
        self._moved = True
        verdict, ran = runner.stand_up(self.robot.pose_angles(*contract.rest)), False
        if verdict.act is Act.GO:
            verdict, ran = self._run_policy(runner.loop, recorder, keep, begun), True
        return self._finish(runner, verdict, ran)

    def _run_policy(self, loop: ControlLoop, recorder: Recorder, keep: Keep, begun: Begun) -> Verdict:
        controller, step = self.controller, self.contract.control_step
        controller.reset()

        said = ""

        def compute(k: int, state: State, missed: int) -> Array:
            nonlocal said
            if self.commands is not None:
                changed = controller.give(self.commands.read(k * step))
                if changed and not said:
                    self.monitor.warn(f"command out of range: {changed}")
                said = changed
            target = controller.command(k * step, controller.observe(k * step, state, missed))
            loop.inference = controller.inference
            return target

        def after(k: int, state: State, computed: bool) -> None:
            if k == 0:
                begun(loop.pacer.due(0) - self.link.sync.offset)
                recorder.begin(state)
            rows = recorder.close(k, state, self.link.state_sent)
            if len(rows):
                keep(rows)
            if computed:
                recorder.open(controller.observation, controller.feedback, controller.target, controller.given)

        return loop.follow("run", recorder.max_steps, compute, after)

    def _finish(self, runner: MotionRunner, verdict: Verdict, running: bool) -> RunOutcome:
        """Bring the robot to rest, whatever ended the run, and whether the policy was running or not."""
        outcome = _outcome(verdict)
        try:
            if verdict.act in (Act.GO, Act.SIT):
                if running:
                    ending = runner.drop()
                else:
                    # A robot that still lies would stall its motors to sit: it is let go as it is.
                    ending = runner.sit_down() if runner.risen else GO
                if ending.act is Act.GO and not self.dry_run:
                    ending = runner.disarm()
                if ending.act is not Act.GO:
                    outcome = replace(outcome, text=f"{outcome.text}; then {ending.text}", safe=True)
                    verdict = ending
            if self.dry_run:
                return outcome
            if verdict.act is Act.FALL:
                return replace(outcome, text=f"{outcome.text}; {runner.recover_from_fall()}", safe=True)
            if verdict.act is Act.DAMP:
                runner.release(damp=True)
        except (LinkLostError, SurefootError) as error:
            return replace(outcome, text=f"{outcome.text}; then {error}", safe=True)
        return outcome

    def close(self) -> None:
        """Give the robot back."""
        with contextlib.suppress(LinkLostError, OSError):
            self.link.close()


def _outcome(verdict: Verdict) -> RunOutcome:
    if verdict == GO:
        return RunOutcome("time", "time", "done", False)
    operator = verdict.reason == "operator"
    ended = {Act.FALL: "fall", Act.SIT: "stopped"}.get(verdict.act, "stopped" if operator else "fault")
    return RunOutcome(ended, verdict.reason, verdict.text, not operator or verdict.act is Act.DAMP)
