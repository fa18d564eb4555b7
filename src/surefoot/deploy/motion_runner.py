"""Motions of a connected robot under control loop and guard, from arming to disarming.

Deployments, the doctor and identification use it. The link may lose frames, so requests that matter are repeated.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.loop import ControlLoop, RunMonitor
from surefoot.deploy.messages import Fault, Handshake, Mode, Reason, State
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.poses import lying_pose, minimum_jerk, sitting_pose
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.safety import GO, Act, Guard, SafetyLimits, Verdict
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

FLAT, FOLD_TIME, PAUSE_TIME, RISE_TIME, HOLD = 1.0, 1.0, 0.3, 1.5, 0.5
"""Time [s] to lay the legs flat, to draw them in, to come to rest, to stand up, and to stand before the policy starts
(as long as a robot settles in simulation)."""
UP = FLAT + FOLD_TIME + PAUSE_TIME + RISE_TIME + HOLD
"""Time [s] from arming to the policy's start."""
DROP_TIME, REST, SIT = 0.2, 0.7, 1.5
"""Time [s] to drop from a gait to sitting, to come to rest there, and to sit down from standing or from a fall."""
SHUTDOWN_TIME = max(DROP_TIME + REST, SIT)
"""Longest time [s] from the policy's end to disarming."""
STILL_SPEED = 0.5
"""Speed [rad/s] of motors and base below which a fallen robot lies still."""
_STILL_TIMEOUT = 5.0
_ANSWER_TIMEOUT, _PING_PERIOD, _ATTEMPTS = 0.3, 0.02, 5
_CLEAN_MARGIN = 0.1


class MotionRunner:
    """A connected robot that can be armed, moved and disarmed; each motion is smooth and checked by the guard.

    Args:
        control_step: time between two commands [s].
        tilt: roll or pitch [rad] that is a fall; the limits', if not given.
        mode: what the commands are.
        lead: time [s] between a state's sending and the next command; the link's, if not given.
        dry_run: compute everything and send nothing.

    Raises:
        SurefootError: the robot is not connected.
    """

    def __init__(
        self,
        link: RobotLink,
        robot: RobotDescription,
        control_step: float,
        operator: StopSignals,
        monitor: RunMonitor | None = None,
        limits: SafetyLimits | None = None,
        tilt: float | None = None,
        mode: Mode = Mode.POSITION,
        lead: float | None = None,
        timing: LoopTiming | None = None,
        dry_run: bool = False,
    ) -> None:
        if link.handshake is None:
            raise SurefootError("the robot is not connected")
        self.link, self.robot, self.control_step, self.lead = link, robot, control_step, lead
        self.handshake: Handshake = link.handshake
        self.mode = mode
        guard = Guard(limits or SafetyLimits.from_robot(robot), control_step, link.session, tilt, mode)
        monitor, timing = monitor or RunMonitor(), timing or LoopTiming(0)
        self.loop = ControlLoop(link, control_step, guard, operator, monitor, timing, dry_run)
        self.clean_time = self.handshake.rearm_after + _CLEAN_MARGIN
        """Time [s] of a clean link after which a damped robot arms, with a margin."""
        self.risen = False
        """Whether the robot has begun to rise from sitting, so that it must sit down again."""

    @property
    def state(self) -> State:
        """The newest state."""
        return self.link.last_state()

    @property
    def target(self) -> Array:
        """Motor angles (M,) [rad] that were sent last, or else measured."""
        return self.loop.target if self.loop.target is not None else self.state.motor_angle

    def arm(self) -> None:
        """Arm: servos hold the present pose, or motors have no duty.

        Raises:
            SurefootError: the robot does not arm; with its reason.
        """
        if self.state.mode == Mode.FAULT or self.state.reason != Reason.NONE:
            self.ping_until(lambda: False, self.clean_time)
        refusal = self._request_arming()
        if refusal is not None and refusal.reason == Reason.NOT_CLEAN:
            self.ping_until(lambda: False, self.clean_time)
            refusal = self._request_arming()
        if self.state.mode != self.mode:
            self.link.disarm()
            raise SurefootError(f"the robot does not arm: {refusal.text if refusal is not None else 'no answer'}")

    def _request_arming(self) -> Fault | None:
        faults = self.link.faults
        before = len(faults)
        self._repeat_until(
            lambda: self.link.arm(self.mode, self.control_step, self.lead),
            lambda: self.state.mode == self.mode or len(faults) > before,
        )
        return faults[-1] if len(faults) > before else None

    def release(self, damp: bool = False) -> bool:
        """Disarm the robot, or damp its motors, until it reports that; return whether it did."""
        request = self.loop.damp if damp else self.link.disarm
        if self._repeat_until(request, lambda: self.state.mode in (Mode.DISARMED, Mode.FAULT)):
            return True
        self.loop.damp()
        return False

    def ping_until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait until a condition holds, at most `timeout` [s], and ping meanwhile; return whether it does."""
        return self.link.ping_until(condition, timeout, _PING_PERIOD)

    def _repeat_until(self, request: Callable[[], None], condition: Callable[[], bool]) -> bool:
        for _ in range(_ATTEMPTS):
            request()
            if self.link.wait_for(condition, _ANSWER_TIMEOUT / _ATTEMPTS):
                return True
        return False

    def move(
        self,
        phase: str,
        end: Array,
        duration: float,
        start: Array | None = None,
        upright: bool = True,
        sitting: bool = False,
    ) -> Verdict:
        """Move smoothly to a pose, and return the verdict of `ControlLoop.follow`.

        Targets are clipped to the angles that the robot takes: it may be switched on in a pose beyond them.

        Args:
            phase: name of the motion.
            end: motor angles (M,) [rad].
            duration: [s].
            start: motor angles (M,) [rad] to start from; the present target, if not given.
            upright: see `ControlLoop.follow`.
            sitting: see `ControlLoop.follow`.
        """
        start, steps = self.target if start is None else start, self.loop.num_steps(duration)

        def compute(k: int, state: State, missed: int) -> Array:
            self.check_state(state)
            target = minimum_jerk(start, end, (k + 1) / steps)
            return np.clip(target, self.handshake.angle_low, self.handshake.angle_high)

        return self.loop.follow(phase, steps, compute, upright=upright, sitting=sitting)

    def check_state(self, state: State) -> None:
        """Check the newest state before each command of a motion; an exception damps the motors."""

    def stand_up(self, standing: Array) -> Verdict:
        """Rise to motor angles (M,) [rad] from wherever the legs lie.

        A damped robot sinks onto its belly, and its legs slide out. They are laid flat and drawn in first: with the
        feet out at the side, motors stall at full current, and then the robot leaps.
        """
        present = self.state.motor_angle
        flat, drawn = lying_pose(self.robot, present), sitting_pose(self.robot)
        for phase, start, end, duration in (
            ("lay legs flat", present, flat, FLAT),
            ("draw legs in", flat, drawn, FOLD_TIME),
            ("sit", drawn, drawn, PAUSE_TIME),
            ("stand up", drawn, standing, RISE_TIME),
            ("stand", standing, standing, HOLD),
        ):
            self.risen = self.risen or phase == "stand up"
            verdict = self.move(phase, end, duration, start)
            if verdict.act is not Act.GO:
                return verdict
        return GO

    def drop(self) -> Verdict:
        """Drop from a gait to sitting, and come to rest there: a fast robot would stumble in a slow change to standing.

        A tilt beyond the limit is no fall here, since damped motors would do no better. The robot's own limit holds.
        """
        drawn = sitting_pose(self.robot)
        verdict = self.move("drop", drawn, DROP_TIME, upright=False, sitting=True)
        if verdict.act is not Act.GO:
            return verdict
        return self.move("sit", drawn, REST, start=drawn, upright=False, sitting=True)

    def sit_down(self, upright: bool = True) -> Verdict:
        """Sit down slowly from the last target."""
        return self.move("sit down", sitting_pose(self.robot), SIT, upright=upright, sitting=True)

    def disarm(self) -> Verdict:
        """End commands in good order."""
        self.loop.monitor.phase("disarm", 0.0)
        return GO if self.release() else Verdict(Act.DAMP, "disarm", "the robot does not report that it has disarmed")

    def recover_from_fall(self) -> str:
        """Wait until a damped robot lies still, then let it sit, unless it lies on its side; return the result."""
        self.release(damp=True)
        self.loop.monitor.phase("lie still", _STILL_TIMEOUT)
        clock = self.link.clock
        earliest = clock.now() + self.clean_time

        def still() -> bool:
            speed = max(np.abs(self.state.motor_velocity).max(), np.abs(self.state.angular_velocity_base).max())
            return clock.now() >= earliest and bool(speed < STILL_SPEED)

        if not self.ping_until(still, _STILL_TIMEOUT):
            return "it does not come to rest and stays damped"
        if np.abs(self.state.roll_pitch_yaw[:2]).max() > self.handshake.tilt_limit:
            return "it lies on its side and stays damped"
        self.loop.monitor.phase("arm", 0.0)
        try:
            self.arm()
        except SurefootError as error:
            return f"it stays damped: {error}"
        self.loop.target = None
        ending = self.sit_down(upright=False)
        if ending.act is Act.GO:
            ending = self.disarm()
        return "it has sat down" if ending.act is Act.GO else f"it stays damped: {ending.text}"
