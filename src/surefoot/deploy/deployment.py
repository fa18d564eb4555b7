"""Deployment of a policy on a robot: connect, check, arm, stand up, run, sit down, disarm."""

from __future__ import annotations

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
from surefoot.deploy.robot_link import LinkLostError, RobotLink, close_link
from surefoot.deploy.safety import GO, Act, Verdict
from surefoot.deploy.speedometer import Speedometer
from surefoot.errors import SurefootError, prefix_errors
from surefoot.robot.commands import STAND_COMMAND
from surefoot.stop_signals import StopSignals

_WARM_UP_STEPS = 20
_MAP_TIMEOUT = 1.0
"""Maximum time to wait for the first height map [s]."""
TIMING_STEPS, TIMING_ATTEMPTS = 200, 10
"""Control steps of a timing check before the robot is armed, and the maximum number of checks."""


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended."""

    ended: str
    """Kind of end, as in traces: time, fall, fault or stopped."""
    reason: str
    """Reason in one or two words."""
    text: str
    """Description for the operator."""
    safe: bool
    """Whether a safety function of the robot or of this computer ended the run."""


class _Runner(MotionRunner):
    """Motion runner that also reads height maps: unread datagrams fill the socket, and new ones would be dropped."""

    maps: MapChannel | None = None

    def check_state(self, state: State) -> None:
        """Read the height maps that have arrived."""
        if self.maps is not None:
            self.maps.read()


class Deployment:
    """A policy on a connected robot, from the connection to the end of its runs.

    Args:
        link: link to the robot.
        controller: the policy's controller.
        operator: stop requests of the operator.
        monitor: receives progress and warnings.
        dry_run: compute everything, but neither arm the robot nor send commands.
        commands: source of velocity commands. Without one, a policy that follows commands stands.
        maps: height maps, for a perceptive policy. The robot stands while they are late.
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
        """Connect to the robot, check its handshake, and verify that policy and computer meet their deadlines.

        Raises:
            SurefootError: no robot or another one, no states, a robot that must not be armed, a policy that fails, or a
                computer that is too slow.
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
            if self.link.detects_other_programs:
                self.monitor.phase("listen for other programs", 0.0)
            if heard := self.link.listen():
                raise SurefootError(f"the robot is not armed: {heard}; stop it, also on the robot's own computer")
        except LinkLostError as error:
            raise SurefootError(f"connection lost before the robot was armed: {error}") from error
        self.controller.reset()

    def _await_map(self) -> None:
        maps = self.maps
        if maps is None:
            return
        if self.link.wait_for(lambda: maps.read() is not None, _MAP_TIMEOUT) and maps.newest is not None:
            with prefix_errors("the robot is not armed"):
                check_at_rest(maps.newest.unclipped, maps.grid, self.robot)
            return
        error = f" ({maps.last_error})" if maps.last_error else ""
        rejected = f"; {maps.rejected} datagrams did not match the policy's grid{error}" if maps.rejected else ""
        raise SurefootError(
            f"no height map arrived at port {maps.port} within {_MAP_TIMEOUT:g} s{rejected}; start the program that "
            "sends it"
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
        time = k * self.contract.control_step
        if self.maps is not None:
            self.controller.heights = self.maps.read()
            if not self.maps.is_fresh:
                self.controller.set_command(STAND_COMMAND)
        return self.controller.compute_target(time, self.controller.observe(time, state, missed))

    def _warm_up(self) -> None:
        """Run the policy a few times: the first inferences are slow, and errors should occur before arming."""
        try:
            for _ in range(_WARM_UP_STEPS):
                self._target(0, self.link.last_state())
        except SurefootError:
            raise
        except Exception as error:
            text = " ".join(str(error).split())
            raise SurefootError(
                f"policy '{self.contract.name}' fails in the robot's present state: {type(error).__name__}: {text}"
            ) from error

    def _check_timing(self) -> None:
        """Run control steps without commands until the computer meets all deadlines of a check.

        The first steps take longer. A busy computer, or a robot that must not be armed, is detected before anything
        moves.

        Raises:
            SurefootError: no check passes.
        """
        verdict = GO
        for _ in range(TIMING_ATTEMPTS):
            loop = self._runner(LoopTiming(TIMING_STEPS + 1), math.inf, dry_run=True).loop
            verdict = loop.run_phase("check timing", TIMING_STEPS, self._target)
            if verdict.act in (Act.GO, Act.SIT):
                break
        # `run` handles stop requests of the operator. A low battery or a hot motor is an error.
        if verdict.act is not Act.GO and not self.operator.stops:
            raise SurefootError(f"the robot is not armed: {verdict.text}")

    def run(self, recorder: Recorder, timing: LoopTiming) -> RunOutcome:
        """Arm, stand up, run the policy for `recorder.max_steps`, sit down, disarm.

        Raises:
            SurefootError: the robot is not connected, or cannot be armed for its first run. Nothing has moved.
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
        verdict, policy_ran = runner.stand_up(self.robot.pose_angles(*self.contract.rest)), False
        if verdict.act is Act.GO and not self.dry_run:
            verdict = self._check_standing(self.link.last_state())
        if verdict.act is Act.GO:
            verdict, policy_ran = self._run_policy(runner.loop, recorder), True
        return self._finish(runner, verdict, policy_ran)

    def _check_standing(self, state: State) -> Verdict:
        """Check that the ground of the height map is under the feet of the standing robot."""
        maps = self.maps
        if maps is None or maps.read() is None or maps.newest is None:
            return GO
        try:
            check_standing(maps.newest.unclipped, maps.grid, self.robot, state.motor_angle, state.roll_pitch_yaw)
        except SurefootError as error:
            return Verdict(Act.SIT, "map", str(error))
        return GO

    def _run_policy(self, loop: ControlLoop, recorder: Recorder) -> Verdict:
        controller = self.controller
        controller.reset(self.link.lead)
        if self.commands is not None:
            self.commands.start()
        speedometer, shown = None, 0
        if self.monitor.shows_speed:
            speedometer = Speedometer(self.robot, self.contract.control_step, self.link.lead)
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
                    loop.guard.warn("the height map was late; the robot stands until the next one")
            return target

        def after(k: int, state: State, computed: bool) -> None:
            nonlocal shown
            if math.isnan(recorder.start):  # not always at step 0: a computer that is late misses the first steps
                recorder.begin(state, loop.pacer.due(0) - self.link.sync.offset)
            if speedometer is not None:
                speedometer.update(state, max(k - shown, 1))
                shown, loop.speed = k, (*speedometer.velocity.tolist(), speedometer.distance)
            recorder.complete_rows(k, state)
            if computed:
                recorder.start_row(
                    controller.observation,
                    controller.feedback,
                    controller.target,
                    controller.command,
                    controller.heights,
                )

        return loop.run_phase("run", recorder.max_steps, compute, after)

    def _finish(self, runner: MotionRunner, verdict: Verdict, policy_ran: bool) -> RunOutcome:
        """Bring the robot to rest after a run, according to the verdict that ended it."""
        outcome = _outcome(verdict)
        try:
            if verdict.act in (Act.GO, Act.SIT):
                # A lying robot is disarmed as it is: moving it to a sitting pose would stall the motors.
                ending = runner.drop() if policy_ran else runner.sit_down() if runner.has_risen else GO
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
        """End the session and close the link."""
        close_link(self.link, self.monitor.warn)


def _outcome(verdict: Verdict) -> RunOutcome:
    if verdict == GO:
        return RunOutcome("time", "time", "done", False)
    operator = verdict.reason == "operator"
    ended = {Act.FALL: "fall", Act.SIT: "stopped"}.get(verdict.act, "stopped" if operator else "fault")
    return RunOutcome(ended, verdict.reason, verdict.text, not operator or verdict.act is Act.DAMP)
