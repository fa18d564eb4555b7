"""A policy on a robot from beginning to end: connect, check, arm, stand up, run, sit down, disarm."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from surefoot.arrays import Array
from surefoot.deploy.command_sources import CommandSource
from surefoot.deploy.controller import Controller
from surefoot.deploy.loop import ControlLoop, RunMonitor
from surefoot.deploy.map_channel import MapChannel
from surefoot.deploy.map_check import check_at_rest, check_standing
from surefoot.deploy.messages import Handshake, State
from surefoot.deploy.motion_runner import MotionRunner
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.recorder import Recorder
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.safety import GO, Act, Verdict
from surefoot.deploy.speedometer import Speedometer
from surefoot.errors import SurefootError, prefix_errors
from surefoot.robot.commands import STAND
from surefoot.stop_signals import StopSignals

_WARM_UP = 20
_MAP_PATIENCE = 1.0
"""Time [s] to wait for the first map of heights."""
PUNCTUAL, TRIES = 200, 10
"""Control steps that must pass without a fault before a robot is armed, and how often that is tried."""


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended: in the word of traces (time, fall, fault or stopped), with a short reason, and as a sentence.

    `safe`: whether the robot's or the computer's safety ended it.
    """

    ended: str
    reason: str
    text: str
    safe: bool


class _Runner(MotionRunner):
    """Motions during which maps are read too: the system would keep the oldest ones, and drop new ones."""

    maps: MapChannel | None = None

    def check_state(self, state: State) -> None:
        """Take the maps that have arrived."""
        if self.maps is not None:
            self.maps.read()


class Deployment:
    """One operator's use of a robot.

    A dry run computes everything, and neither arms nor sends. Without a source of commands, a policy that has them
    stands. A policy that sees the ground needs `maps`; it stands while these are late.
    """

    def __init__(
        self,
        link: RobotLink,
        controller: Controller,
        operator: StopSignals,
        monitor: RunMonitor,
        dry_run: bool = False,
        commands: CommandSource | None = None,
        maps: MapChannel | None = None,
    ) -> None:
        self.link, self.controller, self.operator, self.monitor = link, controller, operator, monitor
        self.contract, self.robot, self.commands = controller.contract, controller.robot, commands
        self.maps = maps
        self.dry_run, self._moved = dry_run, False

    def connect(self, check: Callable[[Handshake], None]) -> None:
        """Connect to the robot, check its handshake, and make sure that policy and computer keep time.

        Raises:
            SurefootError: no robot, another one, one that sends no state or must not be armed, a policy that fails, or
                a computer that does not keep time.
        """
        self.monitor.phase("connect", 0.0)
        try:
            check(self.link.connect(state_period=self.contract.control_step))
            if not self.link.wait_for(lambda: self.link.state is not None, 1.0):
                raise SurefootError("the robot sends no state within 1 s; switch it off and on again")
            self._await_map()
            self._warm_up()
            if not self.link.lockstep:
                self._check_timing()
            if self.link.hears_others:
                self.monitor.phase("listen for other programs", 0.0)
            if heard := self.link.listen():
                raise SurefootError(f"the robot is not armed: {heard}; end it, also on the robot's own computer")
        except LinkLostError as error:
            raise SurefootError(f"the robot was lost before it was armed: {error}") from error
        self.controller.reset()

    def _await_map(self) -> None:
        maps = self.maps
        if maps is None:
            return
        if self.link.wait_for(lambda: maps.read() is not None, _MAP_PATIENCE) and maps.newest is not None:
            with prefix_errors("the robot is not armed"):
                check_at_rest(maps.newest.sent, maps.grid, self.robot)
            return
        why = f" ({maps.why})" if maps.why else ""
        refused = f"; {maps.refused} datagrams were none of the policy's grid{why}" if maps.refused else ""
        raise SurefootError(
            f"no map of heights arrives at port {maps.port} within {_MAP_PATIENCE:g} s{refused}; start the program "
            "that sends it"
        )

    def _runner(self, timing: LoopTiming, tilt: float, dry_run: bool) -> MotionRunner:
        runner = _Runner(
            self.link,
            self.robot,
            self.contract.control_step,
            self.operator,
            self.monitor,
            tilt=tilt,
            timing=timing,
            dry_run=dry_run,
        )
        runner.maps = self.maps
        return runner

    def _target(self, k: int, state: State, missed: int = 0) -> Array:
        moment = k * self.contract.control_step
        if self.maps is not None:
            self.controller.heights = self.maps.read()
            if not self.maps.is_fresh:
                self.controller.set_command(STAND)
        return self.controller.compute_target(moment, self.controller.observe(moment, state, missed))

    def _warm_up(self) -> None:
        """Run the policy some times: its first runs are slow, and a policy that fails should fail before arming."""
        try:
            for _ in range(_WARM_UP):
                self._target(0, self.link.last_state())
        except SurefootError:
            raise
        except Exception as error:
            text = " ".join(str(error).split())
            raise SurefootError(
                f"policy '{self.contract.name}' fails on the robot's present state: {type(error).__name__}: {text}"
            ) from error

    def _check_timing(self) -> None:
        """Run control steps as if the robot were armed, until the computer does them in time.

        First runs take longer. A busy computer, or a robot that should not be armed, is refused while nothing moves.
        """
        verdict = GO
        for _ in range(TRIES):
            loop = self._runner(LoopTiming(PUNCTUAL + 1), math.inf, dry_run=True).loop
            verdict = loop.follow("check timing", PUNCTUAL, self._target)
            if verdict.act in (Act.GO, Act.SIT):
                break
        # `run` handles an operator who asks to stop; a battery or a motor at its limit is an error.
        if verdict.act is not Act.GO and not self.operator.stops:
            raise SurefootError(f"the robot is not armed: {verdict.text}")

    def run(self, recorder: Recorder, timing: LoopTiming) -> RunOutcome:
        """Arm, stand up, run the policy for `recorder.max_steps`, sit down, disarm.

        Raises:
            SurefootError: the robot is not connected, or does not arm for its first run; nothing has moved.
        """
        runner = self._runner(timing, self.controller.task.fall_angle, self.dry_run)
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
        verdict, ran = runner.stand_up(self.robot.pose_angles(*self.contract.rest)), False
        if verdict.act is Act.GO and not self.dry_run:
            verdict = self._check_standing(self.link.last_state())
        if verdict.act is Act.GO:
            verdict, ran = self._run_policy(runner.loop, recorder), True
        return self._finish(runner, verdict, ran)

    def _check_standing(self, state: State) -> Verdict:
        """Return whether a standing robot may go on: the ground of its map must be under its feet."""
        maps = self.maps
        if maps is None or maps.read() is None or maps.newest is None:
            return GO
        try:
            check_standing(maps.newest.sent, maps.grid, self.robot, state.motor_angle, state.roll_pitch_yaw)
        except SurefootError as error:
            return Verdict(Act.SIT, "map", str(error))
        return GO

    def _run_policy(self, loop: ControlLoop, recorder: Recorder) -> Verdict:
        controller = self.controller
        controller.reset()
        speedometer, shown = Speedometer(self.robot, self.contract.control_step), 0
        clamped = ""

        def compute(k: int, state: State, missed: int) -> Array:
            nonlocal clamped
            if self.commands is not None:
                before, clamped = clamped, controller.set_command(self.commands.read(k * self.contract.control_step))
                if clamped and not before:
                    self.monitor.warn(f"command out of range: {clamped}")
            target = self._target(k, state, missed)
            loop.inference = controller.inference
            if self.maps is not None:
                loop.guard.map_age = self.maps.age
                if not self.maps.is_fresh:
                    loop.guard.warn("the map of heights was late; the robot stands until the next one")
            return target

        def after(k: int, state: State, computed: bool) -> None:
            nonlocal shown
            if k == 0:
                recorder.begin(state, loop.pacer.due(0) - self.link.sync.offset)
            speedometer.update(state, max(k - shown, 1))
            shown, loop.speed = k, (*speedometer.velocity.tolist(), speedometer.distance)
            recorder.close(k, state)
            if computed:
                recorder.open(
                    controller.observation,
                    controller.feedback,
                    controller.target,
                    controller.command,
                    controller.heights,
                )

        return loop.follow("run", recorder.max_steps, compute, after)

    def _finish(self, runner: MotionRunner, verdict: Verdict, ran: bool) -> RunOutcome:
        """Bring the robot to rest, whatever ended the run, and whether the policy ran or not."""
        outcome = _outcome(verdict)
        try:
            if verdict.act in (Act.GO, Act.SIT):
                # A robot that still lies would stall its motors to sit: it is disarmed as it is.
                ending = runner.drop() if ran else runner.sit_down() if runner.risen else GO
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
        """End the session and the link."""
        with contextlib.suppress(LinkLostError, OSError):
            self.link.close()


def _outcome(verdict: Verdict) -> RunOutcome:
    if verdict == GO:
        return RunOutcome("time", "time", "done", False)
    operator = verdict.reason == "operator"
    ended = {Act.FALL: "fall", Act.SIT: "stopped"}.get(verdict.act, "stopped" if operator else "fault")
    return RunOutcome(ended, verdict.reason, verdict.text, not operator or verdict.act is Act.DAMP)
