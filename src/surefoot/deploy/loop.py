"""The control loop: one cycle for all phases, from an armed robot to one that is disarmed or damped.

A cycle waits until its step is due, receives states, checks, computes and sends; everything else comes afterwards.
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
from surefoot.deploy.safety import GO, OF_ROBOT, Act, Guard, NotFiniteError, Verdict
from surefoot.errors import SurefootError
from surefoot.stop_signals import StopSignals

Compute = Callable[[int, State, int], Array]
"""Motor angles for a step: its number in the phase, the newest state, steps missed before it."""
After = Callable[[int, State, bool], None]
"""Called when a step's command has been sent: its number, the state that it saw, whether a command was computed."""

EARLY = 0.0005
"""Time [s] before a step is due at which the loop receives a first time, so that little is left to decode then."""
PING_STEPS = 16
"""Steps between two pings of a dry run: a silent operator may lose the robot to another one after a second."""


@dataclass(frozen=True)
class Snapshot:
    """State of the control loop, for monitors. Times in s.

    Since the last snapshot: `rate` of steps [Hz], `lateness` of each, and the longest `inference`, NaN without any. In
    the whole run: steps `missed` and frames `dropped`, which were lost or damaged.
    """

    phase: str
    left: float
    """Time until the phase ends."""
    rate: float
    lateness: tuple[float, ...]
    inference: float
    missed: int
    state_age: float
    state: State
    dropped: int
    speed: tuple[float, float, float] | None = None
    """Estimated speeds forward and to the left [m/s], and length of the path [m]; None while no policy runs."""


class RunMonitor:
    """No-op monitor of a run. Methods must return at once."""

    period = 0.1
    """Time between two snapshots [s]."""

    def phase(self, name: str, duration: float) -> None:
        """Take the name of a phase that starts, and its duration [s]."""

    def tick(self, snapshot: Snapshot) -> None:
        """Take the state of the loop, once every `period`."""

    def warn(self, text: str) -> None:
        """Take a warning for the operator."""

    def recording(self, text: str) -> None:
        """Take a line about the recording."""

    def close(self) -> None:
        """End with the run."""


class ControlLoop:
    """Control steps of one run.

    `control_step` is the time between two commands [s]. A dry run computes everything and sends nothing.
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
        """Motor angles (M,) [rad] that were sent last, or duties if the guard's mode is that of duties."""
        self.inference = math.nan
        """Time [s] that the policy took in this step; set by whoever runs it."""
        self.speed: tuple[float, float, float] | None = None
        """Estimated speeds and path length, see `Snapshot`; set by whoever runs the policy."""
        self._phase, self._steps = "", 0
        self._states = link.states
        self._reported, self._reported_steps, self._reported_warnings = -math.inf, 0, 0
        self._longest_inference = math.nan

    def steps_of(self, duration: float) -> int:
        """Return the control steps in a time [s], at least one."""
        return max(round(duration / self.control_step), 1)

    def follow(
        self,
        phase: str,
        steps: int,
        compute: Compute,
        after: After | None = None,
        upright: bool = True,
        sitting: bool = False,
    ) -> Verdict:
        """Run a phase of `steps` control steps, and one more that sees how the last one ended and holds its target.

        Args:
            phase: its name.
            steps: how many, from 0.
            compute: called in each step but the one more.
            after: called after each step, and after the one more.
            upright: whether a tilt is a fall.
            sitting: the robot sits down anyway, so that only what damps it ends the phase early.

        Returns:
            `GO`, or what ended the phase early. Where that damps, the robot has been asked to.
        """
        self.monitor.phase(phase, steps * self.control_step)
        self._phase, self._steps = phase, steps
        self.pacer.restart()
        while True:
            verdict, index = self._step(steps, compute, after, upright, sitting)
            if verdict.act is not Act.GO or index >= steps:
                return verdict

    def _step(
        self, steps: int, compute: Compute, after: After | None, upright: bool, sitting: bool
    ) -> tuple[Verdict, int]:
        link, clock = self.link, self.link.clock
        try:
            if not link.lockstep:
                clock.wait_until(self.pacer.due(self.pacer.index + 1) - EARLY)
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
            if verdict.reason.startswith(OF_ROBOT) and (text := link.fault_text(state.reason)):
                verdict = replace(verdict, text=f"{verdict.text}: {text}")
            if sitting and verdict.act is Act.SIT:
                verdict = GO
            if verdict.act in (Act.DAMP, Act.FALL):
                self.damp()
            elif verdict.act is not Act.GONE:
                if verdict.act is Act.GO and tick.index < steps:
                    self.target, computed = compute(tick.index, state, tick.missed), True
                self._send()
        except Exception as error:  # Whatever went wrong, the motors come first.
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
        elif self.timing.steps % PING_STEPS == 0:
            self.link.ping()

    def damp(self) -> None:
        """Ask the robot to damp its motors, if the link is not lost."""
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
