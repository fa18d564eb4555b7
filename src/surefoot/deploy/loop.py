"""Control loop of a robot: the same control step in every phase of a run.

A control step waits until it is due, receives states, checks them, computes the target and sends it. Recording and
display come afterwards.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.messages import State
from surefoot.deploy.pacer import LoopTiming, Pacer
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.safety import GO, ROBOT_REASON, Act, Guard, NotFiniteError, Verdict
from surefoot.errors import SurefootError
from surefoot.stop_signals import StopSignals

ComputeTarget = Callable[[int, State, int], Array]
"""Compute the motor target from the number of the control step, the latest state, and the steps missed before."""
AfterStep = Callable[[int, State, bool], None]
"""Called after the command was sent, with the step's number, its state, and whether a new target was computed."""

EARLY_RECEIVE = 0.0005
"""Time before a step is due at which states are received a first time, to leave little to decode then [s]."""
PING_INTERVAL = 16
"""Control steps between two pings of a dry run; after a second of silence another operator could take the robot."""


@dataclass(frozen=True)
class Snapshot:
    """Status of the control loop, for monitors. Times in s."""

    phase: str
    left: float
    """Time until the phase ends."""
    rate: float
    """Control steps per second since the last snapshot [Hz]."""
    lateness: tuple[float, ...]
    """Lateness of each step since the last snapshot."""
    inference: float
    """Longest inference since the last snapshot; NaN if there was none."""
    missed: int
    """Control steps missed in the whole run."""
    state_age: float
    state: State
    dropped: int
    """Frames that were lost or damaged in the whole run."""
    speed: tuple[float, float, float] | None = None
    """Estimated speeds forward and to the left [m/s], and length of the path [m]. None while no policy runs, and for
    monitors that do not show it."""


class RunMonitor:
    """No-op monitor of a run. All methods must return immediately."""

    period = 0.1
    """Period of snapshots [s]."""
    shows_speed = False
    """Whether `Snapshot.speed` is used; it is not estimated otherwise."""

    def phase(self, name: str, duration: float) -> None:
        """Receive the name of a phase that starts, and its duration [s]."""

    def tick(self, snapshot: Snapshot) -> None:
        """Receive the status of the control loop, once per `period`."""

    def warn(self, text: str) -> None:
        """Receive a warning for the operator."""

    def recording(self, text: str) -> None:
        """Receive a message about the recording."""

    def close(self) -> None:
        """Called at the end of the run."""


class ControlLoop:
    """Runs the control steps of one run on a robot.

    Args:
        link: link to the robot.
        control_step: period of the commands [s].
        guard: checks every state.
        operator: stop requests of the operator.
        monitor: receives progress and warnings.
        timing: receives lateness and inference times.
        dry_run: compute everything, but send no commands.
    """

    def __init__(
        self,
        link: RobotLink,
        control_step: float,
        guard: Guard,
        operator: StopSignals,
        monitor: RunMonitor,
        timing: LoopTiming,
        dry_run: bool = False,
    ) -> None:
        self.link, self.guard, self.operator, self.monitor = link, guard, operator, monitor
        self.timing, self.dry_run, self.control_step = timing, dry_run, control_step
        self.pacer = Pacer(link.clock, control_step)
        self.target: Array | None = None
        """Last motor target sent (M,): angles [rad], or duties in PWM mode."""
        self.inference = math.nan
        """Inference time in this step [s]; set by the caller that runs the policy."""
        self.speed: tuple[float, float, float] | None = None
        """Estimated speeds and path length, see `Snapshot`; set by whoever runs the policy."""
        self._phase, self._steps = "", 0
        self._states = link.states
        self._reported, self._reported_steps, self._reported_warnings = -math.inf, 0, 0
        self._longest_inference = math.nan

    def num_steps(self, duration: float) -> int:
        """Return the number of control steps in a time [s], at least one."""
        return max(round(duration / self.control_step), 1)

    def run_phase(
        self,
        phase: str,
        steps: int,
        compute: ComputeTarget,
        after: AfterStep | None = None,
        upright: bool = True,
        sitting: bool = False,
    ) -> Verdict:
        """Run a phase of `steps` control steps, and a final step that receives the last state and holds the target.

        Args:
            phase: name of the phase.
            steps: number of control steps, 0 or more.
            compute: computes the target, in each step except the final one.
            after: called after each step, including the final one.
            upright: whether a tilt beyond the limit counts as a fall.
            sitting: whether the robot is sitting down already, so that only a verdict to damp ends the phase early.

        Returns:
            `GO`, or the verdict that ended the phase early. If it is to damp, the request was already sent.
        """
        self.monitor.phase(phase, steps * self.control_step)
        self._phase, self._steps = phase, steps
        self.pacer.restart()
        while True:
            verdict, index = self._step(steps, compute, after, upright, sitting)
            if verdict.act is not Act.GO or index >= steps:
                return verdict

    def _step(
        self, steps: int, compute: ComputeTarget, after: AfterStep | None, upright: bool, sitting: bool
    ) -> tuple[Verdict, int]:
        link, clock = self.link, self.link.clock
        try:
            if not link.lockstep:
                clock.wait_until(self.pacer.due(self.pacer.index + 1) - EARLY_RECEIVE)
                link.update()
            tick = self.pacer.next()
            link.update()
            state = link.last_state()
        except (LinkLostError, SurefootError) as error:
            self.damp()
            return Verdict(Act.GONE, "link", str(error)), steps
        self.inference, computed, age = math.nan, False, link.state_age()
        try:
            verdict = self.guard.check(
                clock.now(), state, age, tick.missed, self.operator.stops, not self.dry_run, upright
            )
            if verdict.reason.startswith(ROBOT_REASON) and (text := link.fault_text(state.reason)):
                verdict = replace(verdict, text=f"{verdict.text}: {text}")
            if sitting and verdict.act is Act.SIT:
                verdict = GO
            if verdict.act in (Act.DAMP, Act.FALL):
                self.damp()
            elif verdict.act is not Act.GONE:
                if verdict.act is Act.GO and tick.index < steps:
                    self.target, computed = compute(tick.index, state, tick.missed), True
                self._send()
        except Exception as error:  # Damp the motors first, whatever went wrong.
            self.damp()
            verdict = _failure(error)
        sent = clock.now() - tick.due
        fresh, self._states = link.states > self._states, link.states
        self.timing.add(tick.late, sent, self.inference, age, tick.missed, fresh)
        if after is not None:
            after(tick.index, state, computed and verdict.act is Act.GO)
        self._report(tick.index, state)
        return verdict, tick.index

    def _send(self) -> None:
        if not self.dry_run:
            if self.target is not None:
                self.link.command(self.guard.mode, self.target)
        elif self.timing.steps % PING_INTERVAL == 0:
            self.link.ping()

    def damp(self) -> None:
        """Ask the robot to damp its motors, unless the link is lost."""
        if not self.dry_run:
            with contextlib.suppress(LinkLostError):
                self.link.damp()

    def _report(self, index: int, state: State) -> None:
        self._longest_inference = float(np.fmax(self.inference, self._longest_inference))
        now = self.link.clock.now()
        if now - self._reported < self.monitor.period:
            return
        for text in self.guard.warnings[self._reported_warnings :]:
            self.monitor.warn(text)
        done, statistics = self.timing.steps - self._reported_steps, self.link.statistics
        self.monitor.tick(
            Snapshot(
                phase=self._phase,
                left=max(self._steps - index, 0) * self.control_step,
                rate=done / (now - self._reported),
                lateness=tuple(self.timing.last(min(done, 100)).tolist()),
                inference=self._longest_inference,
                missed=self.timing.missed,
                state_age=self.link.state_age(),
                state=state,
                dropped=statistics.missing + statistics.damaged,
                speed=self.speed,
            )
        )
        self._reported, self._reported_steps, self._longest_inference = now, self.timing.steps, math.nan
        self._reported_warnings = len(self.guard.warnings)


def _failure(error: Exception) -> Verdict:
    if isinstance(error, LinkLostError):
        return Verdict(Act.GONE, "link", str(error))
    text = " ".join(str(error).split())
    if isinstance(error, NotFiniteError) or (isinstance(error, SurefootError) and "not finite" in text):
        return Verdict(Act.DAMP, "not finite", text)
    return Verdict(Act.DAMP, "exception", f"{type(error).__name__}: {text}")
