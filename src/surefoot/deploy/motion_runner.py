"""Scripted motions of a connected robot, such as standing up, run by the control loop and checked by the guard.

Deployments, the doctor and identification use them. The link may lose frames, so important requests are repeated.
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
from surefoot.stop_signals import SIT, StopSignals

LAY_FLAT_TIME, FOLD_TIME, PAUSE_TIME, RISE_TIME, STAND_TIME = 1.0, 1.0, 0.3, 1.5, 0.5
"""Durations of laying the legs flat, drawing them in, pausing, standing up, and standing before the policy starts [s].
The last one is as long as a robot settles in simulation."""
STARTUP_TIME = LAY_FLAT_TIME + FOLD_TIME + PAUSE_TIME + RISE_TIME + STAND_TIME
"""Time from arming to the start of the policy [s]."""
DROP_TIME, SITTING_TIME, SIT_DOWN_TIME = 0.2, 0.7, 1.5
"""Durations of dropping from a gait to a sitting pose, of coming to rest there, and of sitting down slowly [s]."""
SHUTDOWN_TIME = max(DROP_TIME + SITTING_TIME, SIT_DOWN_TIME)
"""Maximum time from the end of the policy to disarming [s]."""
STILL_SPEED = 0.5
"""Maximum speed of motors and base at which a fallen robot counts as lying still [rad/s]."""
_STILL_TIMEOUT = 5.0
_ANSWER_TIMEOUT, _PING_PERIOD, _ATTEMPTS = 0.3, 0.02, 5
_CLEAN_MARGIN = 0.1


class MotionRunner:
    """Arms, moves and disarms a connected robot; each motion is smooth and checked by the guard.

    Args:
        link: link to the robot.
        robot: its description.
        control_step: period of the commands [s].
        operator: stop requests of the operator.
        monitor: receives progress and warnings.
        limits: safety limits. Default to the robot's.
        tilt: roll or pitch that counts as a fall [rad]. Defaults to the safety limits' tilt.
        mode: whether commands are angles or duties.
        lead: time from the sending of a state to the next command [s]. Defaults to the link's.
        timing: receives lateness and inference times.
        dry_run: compute everything, but send no commands.

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
        """Time that the link must be clean before a damped robot can be armed, with a margin [s]."""
        self.has_risen = False
        """Whether the robot has started to stand up, so that it must sit down again."""

    @property
    def state(self) -> State:
        """Latest state of the robot."""
        return self.link.last_state()

    @property
    def target(self) -> Array:
        """Last motor target sent (M,) [rad]; the measured angles if none was sent."""
        return self.loop.target if self.loop.target is not None else self.state.motor_angle

    def arm(self) -> None:
        """Arm the robot: servos hold the present pose, or motors get zero duty.

        Raises:
            SurefootError: the robot cannot be armed; the message has the robot's reason.
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
        """Disarm the robot, or damp its motors; repeat until it confirms, and return whether it did."""
        request = self.loop.damp if damp else self.link.disarm
        if self._repeat_until(request, lambda: self.state.mode in (Mode.DISARMED, Mode.FAULT)):
            return True
        self.loop.damp()
        return False

    def ping_until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Ping until a condition holds, at most `timeout` [s]; return whether it holds."""
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
        """Move to a pose along a minimum-jerk trajectory; return the verdict of `ControlLoop.run_phase`.

        Targets are clipped to the robot's angle limits: when switched on, it may be in a pose beyond them.

        Args:
            phase: name of the motion.
            end: final motor angles (M,) [rad].
            duration: duration of the motion [s].
            start: initial motor angles (M,) [rad]. Default to the present target.
            upright: see `ControlLoop.run_phase`.
            sitting: see `ControlLoop.run_phase`.
        """
        start, steps = self.target if start is None else start, self.loop.num_steps(duration)

        def compute(k: int, state: State, missed: int) -> Array:
            self.check_state(state)
            target = minimum_jerk(start, end, (k + 1) / steps)
            return np.clip(target, self.handshake.angle_low, self.handshake.angle_high)

        return self.loop.run_phase(phase, steps, compute, upright=upright, sitting=sitting)

    def check_state(self, state: State) -> None:
        """Check the latest state before each command of a motion; an exception damps the motors."""

    def stand_up(self, standing: Array) -> Verdict:
        """Stand up to motor angles (M,) [rad] from any lying pose.

        A damped robot sinks onto its belly, and its legs slide outward. They are first laid flat and drawn in. With the
        feet far out, the motors would stall at full current, and then the robot would leap.
        """
        present = self.state.motor_angle
        flat, drawn = lying_pose(self.robot, present), sitting_pose(self.robot)
        for phase, start, end, duration in (
            ("lay legs flat", present, flat, LAY_FLAT_TIME),
            ("draw legs in", flat, drawn, FOLD_TIME),
            ("sit", drawn, drawn, PAUSE_TIME),
            ("stand up", drawn, standing, RISE_TIME),
            ("stand", standing, standing, STAND_TIME),
        ):
            self.has_risen = self.has_risen or phase == "stand up"
            verdict = self.move(phase, end, duration, start)
            if verdict.act is not Act.GO:
                return verdict
        return GO

    def drop(self) -> Verdict:
        """Drop from a gait to the sitting pose and come to rest; in a slow transition a fast robot would stumble.

        A tilt beyond the limit is not a fall here, since damping would not help. The robot's own limit still holds.
        """
        drawn = sitting_pose(self.robot)
        verdict = self.move("drop", drawn, DROP_TIME, upright=False, sitting=True)
        if verdict.act is not Act.GO:
            return verdict
        return self.move("sit", drawn, SITTING_TIME, start=drawn, upright=False, sitting=True)

    def sit_down(self, upright: bool = True) -> Verdict:
        """Move slowly from the last target to the sitting pose."""
        return self.move("sit down", sitting_pose(self.robot), SIT_DOWN_TIME, upright=upright, sitting=True)

    def disarm(self) -> Verdict:
        """Disarm the robot normally, and return `GO` if it confirms."""
        self.loop.monitor.phase("disarm", 0.0)
        return GO if self.release() else Verdict(Act.DAMP, "disarm", "the robot does not confirm that it is disarmed")

    def recover_from_fall(self) -> str:
        """Damp the motors until a fallen robot lies still, then move it to the sitting pose; return the result as text.

        A robot that lies on its side stays damped, and so does one that the operator stops at once.
        """
        heard = len(self.link.faults)
        self.release(damp=True)
        self.loop.monitor.phase("lie still", _STILL_TIMEOUT)
        clock = self.link.clock
        earliest = clock.now() + self.clean_time

        def still() -> bool:
            speed = max(np.abs(self.state.motor_velocity).max(), np.abs(self.state.angular_velocity_base).max())
            return clock.now() >= earliest and bool(speed < STILL_SPEED)

        def stopped() -> bool:
            remote = any(fault.reason == Reason.REMOTE for fault in self.link.faults[heard:])
            return remote or self.loop.operator.stops > SIT

        rested = self.ping_until(lambda: stopped() or still(), _STILL_TIMEOUT)
        if stopped():
            return "it stays damped: stopped at once by the operator"
        if not rested:
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
