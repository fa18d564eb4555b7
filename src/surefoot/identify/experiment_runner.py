"""Run of an experiment on a robot over the link, within the plan's limits, with everything recorded."""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np

from surefoot.arrays import Array
from surefoot.columns import columns_of
from surefoot.configuration import to_mapping
from surefoot.deploy.loop import RunMonitor
from surefoot.deploy.messages import Handshake, Mode, State
from surefoot.deploy.motion_runner import MotionRunner
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.safety import Act, SafetyLimits
from surefoot.errors import SurefootError
from surefoot.identify.plan import Phase, Plan
from surefoot.identify.recording import (
    COMPLETE,
    RecordedFrames,
    RecordedPhase,
    Recording,
    RecordingMeta,
    digest_of,
)
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

PERIOD = 0.002
"""Time between two commands, and between two states [s]: at 921,600 baud a state takes 1.7 ms."""
REST = 1.0
"""Time at rest before the robot is armed [s]."""
LATE = 0.05
"""Age of the newest state [s], and time without a command, that end an experiment: the robot damps itself then."""
BATTERY_ROOM = 0.3
"""Voltage [V] above the robot's own limit at which an experiment ends, if it stays there for a second."""


class ExperimentStoppedError(RuntimeError):
    """An experiment ended early; motors are damped or disarmed."""


class _ExperimentRunner:
    """An experiment on a connected robot; see `run_plan`."""

    def __init__(
        self, link: RobotLink, plan: Plan, robot: RobotDescription, operator: StopSignals, monitor: RunMonitor
    ) -> None:
        if link.handshake is None:
            raise SurefootError("the robot is not connected")
        self.link, self.plan, self.robot, self.operator = link, plan, robot, operator
        self.handshake: Handshake = link.handshake
        self.period = min(max(PERIOD, self.handshake.command_period_min), self.handshake.command_period_max)
        # Commands that come a little early must not put off a state that is due.
        self.lead = 0.0 if link.lockstep else self.period / 4
        steps = LATE / self.period
        # Batteries sag under an experiment's load, and recover: only the robot's own limit counts.
        low = self.handshake.voltage_min + BATTERY_ROOM
        limits = SafetyLimits.from_robot(robot)
        self._limits = replace(limits, state_age=steps, missed_steps=int(steps) - 1, battery_low=low)
        self._monitor = monitor
        self._states: list[tuple[State, float, float]] = []
        self._sent: list[tuple[int, float, int, Array]] = []
        self._changes: list[tuple[float, int]] = []
        self._overload_time = np.zeros(robot.num_motors)
        self._target: Array | None = None
        self._started = 0.0
        self._low, self._high = plan.angle_low, plan.angle_high
        self._why = ""

    def run(self) -> Recording:
        link, ended, resting = self.link, COMPLETE, 0
        statistics = link.statistics
        before = statistics.missing, statistics.damaged
        if not link.lockstep:
            link.update()  # states that have waited since the connection would count as just come
        link.on_state = lambda *received: self._states.append(received)
        self._started = link.clock.now()
        try:
            self._runner(self.plan.phases[0].mode).ping_until(lambda: False, REST)
            resting = len(self._states)
            # Legs on a rack hang down, and fold when a robot lies: the first transition starts there.
            angle = link.last_state().motor_angle
            self._low, self._high = np.minimum(self._low, angle), np.maximum(self._high, angle)
            self._run_phases()
        except (ExperimentStoppedError, LinkLostError) as stopped:
            ended = str(stopped)
        except SurefootError as refused:
            # What was recorded before a robot refuses to be armed once more is kept.
            if not self._sent:
                raise
            ended = str(refused)
        finally:
            link.on_state = None
        frames = {"missing": statistics.missing - before[0], "damaged": statistics.damaged - before[1]}
        return self._recording(ended, frames, resting)

    def _runner(self, mode: Mode) -> MotionRunner:
        tilt = self.handshake.tilt_limit
        return MotionRunner(
            self.link, self.robot, self.period, self.operator, self._monitor, self._limits, tilt, mode, self.lead
        )

    def _run_phases(self) -> None:
        runner: MotionRunner | None = None
        for index, phase in enumerate(self.plan.phases):
            if runner is None or phase.mode is not runner.mode:
                if runner is not None:
                    self._disarm(runner)
                runner = self._runner(phase.mode)
                self._changes.append((self.link.clock.now(), int(phase.mode)))
                runner.arm()
                self._target = None
            self._follow(runner, index, phase)
        if runner is not None:
            self._disarm(runner)

    def _disarm(self, runner: MotionRunner) -> None:
        self._changes.append((self.link.clock.now(), int(Mode.DISARMED)))
        if not runner.release():
            raise ExperimentStoppedError("the robot does not report that it has disarmed")

    def _follow(self, runner: MotionRunner, index: int, phase: Phase) -> None:
        loop, start = runner.loop, self._target
        low, high = self.handshake.angle_low, self.handshake.angle_high

        def target(k: int, state: State, missed: int) -> Array:
            nonlocal start
            if start is None:
                start = state.motor_angle.copy() if phase.mode == Mode.POSITION else np.zeros(self.robot.num_motors)
            self._why = self._passed_limit(state, phase)
            if self._why:
                raise ExperimentStoppedError(self._why)
            bounds = (low, high) if phase.mode == Mode.POSITION else (-1.0, 1.0)
            return np.clip(phase.signal(k * self.period, start), *bounds)

        def after(k: int, state: State, computed: bool) -> None:
            if loop.target is not None:
                self._sent.append((self.link.next_number - 1, self.link.clock.now(), index, loop.target))

        verdict = loop.follow(phase.name, loop.steps_of(phase.duration), target, after)
        self._target = loop.target
        if verdict.act is Act.SIT:
            loop.damp()
        if verdict.act is not Act.GO:
            raise ExperimentStoppedError(f"{self._why or verdict.text} (in phase '{phase.name}')")

    def _passed_limit(self, state: State, phase: Phase) -> str:
        """Return the limit of the plan that is passed; empty, if none is."""
        plan, limits, names = self.plan, self.plan.limits, self.robot.motor_names
        low, high = (self._low, self._high) if phase.use == "transition" else (plan.angle_low, plan.angle_high)
        beyond = np.maximum(low - state.motor_angle, state.motor_angle - high)
        worst = int(np.argmax(beyond))
        if self._sent and beyond[worst] > limits.angle_room:
            return (
                f"{names[worst]} is at {state.motor_angle[worst]:.2f} rad, {beyond[worst]:.2f} beyond the plan's "
                f"angles; at most {limits.angle_room:g}"
            )
        overloaded = np.abs(state.motor_torque) > limits.torque
        self._overload_time = np.where(overloaded, self._overload_time + self.period, 0.0)
        worst = int(np.argmax(self._overload_time))
        if self._overload_time[worst] > limits.torque_time:
            return f"{names[worst]} gave more than {limits.torque:g} N m for {limits.torque_time:g} s"
        worst = int(np.argmax(state.temperature))
        if state.temperature[worst] > limits.temperature:
            return f"{names[worst]} has {state.temperature[worst]:.0f} degC; at most {limits.temperature:g}"
        if self.link.clock.now() - self._started > limits.duration:
            return f"it took more than {limits.duration:g} s"
        return ""

    def _recording(self, ended: str, frames: dict[str, int], resting: int) -> Recording:
        motors = self.robot.num_motors
        states = [state for state, _, _ in self._states]
        numbers, times, phases, values = zip(*self._sent, strict=True) if self._sent else ((), (), (), ())
        arrays = {
            "sent_number": np.array(numbers, float),
            "sent_time": np.array(times, float),
            "sent_phase": np.array(phases, float),
            "sent_value": np.array(values, float).reshape(-1, motors),
            "time": np.array([sent for _, sent, _ in self._states], float),
            "host_time": np.array([received for _, _, received in self._states], float),
        }
        for name in (name for name in columns_of(Recording) if name not in arrays):
            arrays[name] = np.array([getattr(state, name) for state in states], float)
        meta = RecordingMeta(
            experiment=self.plan.experiment,
            robot=self.robot.name,
            firmware=self.handshake.firmware,
            gains={name: tuple(getattr(self.handshake, name).tolist()) for name in ("servo_kp", "servo_kd")},
            motor_names=self.robot.motor_names,
            rack=self.plan.rack,
            phases=tuple(RecordedPhase(p.name, int(p.mode), p.use, p.duration) for p in self.plan.phases),
            mode_changes=tuple(self._changes),
            ended=ended,
            period=self.period,
            lead=self.link.lead,
            servo_period=self.handshake.servo_period,
            resting_states=resting,
            frames=RecordedFrames(len(states), **frames),
            date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            digest=digest_of(arrays),
        )
        return Recording(**arrays, meta=to_mapping(meta), robot_archive=self.robot.archive)


def run_plan(link: RobotLink, plan: Plan, robot: RobotDescription, monitor: RunMonitor) -> Recording:
    """Record a connected robot at rest and in all phases, and disarm it; return the recording, however it ended.

    Nothing is raised once motors may have moved: `meta["ended"]` is why an experiment did not come to its end, such
    as a signal of the operator.

    Raises:
        SurefootError: the robot is not connected, or does not arm.
    """
    with StopSignals() as operator:
        return _ExperimentRunner(link, plan, robot, operator, monitor).run()
