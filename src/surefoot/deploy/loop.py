"""The control loop: one beat for all phases, from an armed robot to one that is disarmed or damped.

A tick: wait until the step is due, take what the robot has said, judge, compute, send; everything else comes after.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass

from surefoot.arrays import Array
from surefoot.deploy.messages import State
from surefoot.deploy.pacer import LoopTiming, Pacer
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.safety import GO, Act, Guard, NotFiniteError, Verdict
from surefoot.errors import SurefootError
from surefoot.stop_signals import StopSignals

Compute = Callable[[int, State, int], Array]
"""Motor angles for a step: its number in the phase, the newest state, steps missed before it."""
After = Callable[[int, State, bool], None]
"""Called when a step's command is on its way: its number, the state that it saw, whether a command was computed."""

EARLY = 0.0005
"""How long before a step is due [s] the loop looks at the link a first time."""


@dataclass(frozen=True)
class Snapshot:
    """How the loop does, for monitors."""

    phase: str
    """What the robot is doing."""
    left: float
    """Time that the phase still takes [s]."""
    rate: float
    """Steps done a second since the last telling [Hz]."""
    lateness: tuple[float, ...]
    """How late the steps since then were [s]."""
    inference: float
    """How long the policy took, the longest since then [s]; NaN, if it was not asked."""
    missed: int
    """Steps missed so far in this run."""
    state_age: float
    """Age of the newest state [s]."""
    state: State
    """The newest state."""
    dropped: int
    """Frames lost or damaged so far."""


class RunMonitor:
    """No-op monitor of a run. Methods must return at once."""

    period = 0.1
    """Time between two calls of `tick` [s]."""

    def phase(self, name: str, duration: float) -> None:
        """A phase of so many seconds starts."""

    def tick(self, snapshot: Snapshot) -> None:
        """Several times a second."""

    def warn(self, text: str) -> None:
        """Something that the operator should know."""

    def recording(self, text: str) -> None:
        """How recording goes."""

    def close(self) -> None:
        """It is over."""


class ControlLoop:
    """Ticks of one run.

    Args:
        link: to the robot.
        control_step: time between two commands [s].
        guard: judges each tick.
        operator: may ask to stop.
        monitor: is told how it goes.
        timing: keeps lateness.
        dry_run: compute everything and send nothing.
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
        """How long the policy took in this step [s]; whoever asks it says so here."""
        self._phase, self._steps = "", 0
        self._states = link.states
        self._told, self._told_steps, self._told_warnings, self._worst = -math.inf, 0, 0, math.nan

    def steps_of(self, duration: float) -> int:
        """Control steps in a time [s], at least one."""
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
        """Do so many control steps, and one more that sees how the last one ended and holds its target.

        Args:
            phase: what the robot does meanwhile.
            steps: how many.
            compute: gives the motor angles of steps 0 to `steps` - 1.
            after: is told of each step, and of the one more.
            upright: whether a tilt is a fall.
            sitting: the robot is about to be disarmed, so that nothing less than damping can come sooner.

        Returns:
            `GO`, or what ended the phase early; damping has been asked for already, where it is due.
        """
        self.monitor.phase(phase, steps * self.control_step)
        self._phase, self._steps = phase, steps
        self.pacer.restart()
        while True:
            verdict, index = self._tick(steps, compute, after, upright, sitting)
            if verdict.act is not Act.GO or index >= steps:
                return verdict

    def _tick(
        self, steps: int, compute: Compute, after: After | None, upright: bool, sitting: bool
    ) -> tuple[Verdict, int]:
        link, clock = self.link, self.link.clock
        try:
            if not link.lockstep:
                # What has come by then is taken apart before it is needed.
                clock.wait_until(self.pacer.due(self.pacer.index + 1) - EARLY)
                link.update()
            tick = self.pacer.next()
            link.update()
        except (LinkLostError, SurefootError) as error:
            self.damp()
            return Verdict(Act.GONE, "link", str(error)), steps
        state = link.state
        if state is None:
            return Verdict(Act.GONE, "link", "the robot has said nothing yet"), steps
        self.inference = math.nan
        computed = False
        try:
            verdict = self.guard.judge(
                clock.now(), state, link.state_age(), tick.missed, self.operator.stops, not self.dry_run, upright
            )
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
        fresh = link.states > self._states
        self._states = link.states
        self.timing.add(tick.late, sent, self.inference, tick.missed, fresh)
        if after is not None:
            after(tick.index, state, computed and verdict.act is Act.GO)
        self._tell(tick.index, state)
        return verdict, tick.index

    def _send(self) -> None:
        if self.dry_run:
            # Whoever says nothing for a second may lose the robot to another operator.
            if self.timing.steps % 16 == 0:
                self.link.ping()
        elif self.target is not None:
            self.link.command(self.guard.mode, self.target)

    def damp(self) -> None:
        """Ask for damped motors, if there is still somebody to ask."""
        if not self.dry_run:
            with contextlib.suppress(LinkLostError):
                self.link.damp()

    def _tell(self, index: int, state: State) -> None:
        if not math.isnan(self.inference):
            self._worst = max(self.inference, self._worst) if not math.isnan(self._worst) else self.inference
        now = self.link.clock.now()
        if now - self._told < self.monitor.period:
            return
        for text in self.guard.warnings[self._told_warnings :]:
            self.monitor.warn(text)
        self._told_warnings = len(self.guard.warnings)
        done = self.timing.steps - self._told_steps
        statistics = self.link.statistics
        self.monitor.tick(
            Snapshot(
                phase=self._phase,
                left=max(self._steps - index, 0) * self.control_step,
                rate=done / (now - self._told),
                lateness=tuple(self.timing.last(min(done, 100)).tolist()),
                inference=self._worst,
                missed=self.timing.missed,
                state_age=self.link.state_age(),
                state=state,
                dropped=statistics.missing + statistics.damaged,
            )
        )
        self._told, self._told_steps, self._worst = now, self.timing.steps, math.nan


def _failure(error: Exception) -> Verdict:
    if isinstance(error, LinkLostError):
        return Verdict(Act.GONE, "link", str(error))
    text = " ".join(str(error).split())
    if isinstance(error, NotFiniteError) or (isinstance(error, SurefootError) and "not finite" in text):
        return Verdict(Act.DAMP, "not finite", text)
    return Verdict(Act.DAMP, "exception", f"{type(error).__name__}: {text}")
