"""Runs an experiment on a robot over the link within the plan's limits, and records all commands and states."""

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
    digest_arrays,
)
from surefoot.robot import RobotDescription
from surefoot.robot.params import GAINS
from surefoot.stop_signals import StopSignals

COMMAND_PERIOD = 0.002
"""Time between two commands, and between two states [s]. At 921,600 baud a state takes 1.7 ms."""
REST_TIME = 1.0
"""Time at rest before the robot is armed [s]."""
MAX_STATE_AGE = 0.05
"""Age of the newest state, or time without a command [s], that stops the experiment; the robot then damps itself."""
BATTERY_MARGIN = 0.3
"""Voltage [V] above the robot's own limit below which the experiment stops, if it persists for a second."""


class ExperimentStoppedError(RuntimeError):
    """The experiment stopped early; motors are damped or disarmed."""


class _ExperimentRunner:
    """Runs one experiment on a connected robot; see `run_plan`."""

    def __init__(
        self, link: RobotLink, plan: Plan, robot: RobotDescription, operator: StopSignals, monitor: RunMonitor
    ) -> None:
        if link.handshake is None:
            raise SurefootError("the robot is not connected")
        self.link, self.plan, self.robot, self.operator = link, plan, robot, operator
        self.handshake: Handshake = link.handshake
        self.period = min(max(COMMAND_PERIOD, self.handshake.command_period_min), self.handshake.command_period_max)
        # Commands are sent slightly early, so that they do not delay a state that is due.
        self.lead = 0.0 if link.lockstep else self.period / 4
        steps = MAX_STATE_AGE / self.period
        # Batteries sag under the load of an experiment and recover, so the limit is close to the robot's own.
        low = self.handshake.voltage_min + BATTERY_MARGIN
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
        self._stop_reason = ""

    def run(self) -> Recording:
        link, ended, resting = self.link, COMPLETE, 0
        statistics = link.statistics
        before = statistics.missing, statistics.damaged
        if not link.lockstep:
            link.update()  # states that have waited since the connection would count as just come
        link.on_state = lambda *received: self._states.append(received)
        self._started = link.clock.now()
        try:
            self._runner(self.plan.phases[0].mode).ping_until(lambda: False, REST_TIME)
            resting = len(self._states)
            # Legs hang down on a rack, and are folded when the robot lies: the first transition starts from there.
            angle = link.last_state().motor_angle
            self._low, self._high = np.minimum(self._low, angle), np.maximum(self._high, angle)
            self._run_phases()
        except (ExperimentStoppedError, LinkLostError) as stopped:
            ended = str(stopped)
        except SurefootError as error:
            # If the robot can't be armed again between phases, what was recorded so far is kept.
            if not self._sent:
                raise
            ended = str(error)
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
            self._stop_reason = self._exceeded_limit(state, phase)
            if self._stop_reason:
                raise ExperimentStoppedError(self._stop_reason)
            bounds = (low, high) if phase.mode == Mode.POSITION else (-1.0, 1.0)
            return np.clip(phase.signal(k * self.period, start), *bounds)

        def after(k: int, state: State, computed: bool) -> None:
            if loop.target is not None:
                self._sent.append((self.link.next_number - 1, self.link.clock.now(), index, loop.target))

        verdict = loop.run_phase(phase.name, loop.num_steps(phase.duration), target, after)
        self._target = loop.target
        if verdict.act is Act.SIT:
            loop.damp()
        if verdict.act is not Act.GO:
            raise ExperimentStoppedError(f"{self._stop_reason or verdict.text} (in phase '{phase.name}')")

    def _exceeded_limit(self, state: State, phase: Phase) -> str:
        """Return a message about a limit of the plan that is exceeded; empty if there is none."""
        plan, limits, names = self.plan, self.plan.limits, self.robot.motor_names
        low, high = (self._low, self._high) if phase.use == "transition" else (plan.angle_low, plan.angle_high)
        beyond = np.maximum(low - state.motor_angle, state.motor_angle - high)
        worst = int(np.argmax(beyond))
        if self._sent and beyond[worst] > limits.angle_margin:
            return (
                f"{names[worst]} is at {state.motor_angle[worst]:.2f} rad, {beyond[worst]:.2f} beyond the plan's "
                f"angles; at most {limits.angle_margin:g}"
            )
        overloaded = np.abs(state.motor_torque) > limits.torque
        self._overload_time = np.where(overloaded, self._overload_time + self.period, 0.0)
        worst = int(np.argmax(self._overload_time))
        if self._overload_time[worst] > limits.torque_time:
            limit = np.broadcast_to(limits.torque, len(names))[worst]
            return f"{names[worst]} exceeded {limit:g} N m for {limits.torque_time:g} s"
        worst = int(np.argmax(state.temperature))
        if state.temperature[worst] > limits.temperature:
            return f"{names[worst]} is at {state.temperature[worst]:.0f} degC; at most {limits.temperature:g}"
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
            gains={name: tuple(getattr(self.handshake, name).tolist()) for name in GAINS},
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
            digest=digest_arrays(arrays),
        )
        return Recording(**arrays, meta=to_mapping(meta), robot_archive=self.robot.archive)


def run_plan(link: RobotLink, plan: Plan, robot: RobotDescription, monitor: RunMonitor) -> Recording:
    """Run a plan on a connected robot, disarm it, and return the recording, even if the experiment stopped early.

    Nothing is raised once motors may have moved: `meta["ended"]` states why an experiment stopped early, such as a
    signal from the operator.

    Raises:
        SurefootError: the robot is not connected or does not arm.
    """
    with StopSignals() as operator:
        return _ExperimentRunner(link, plan, robot, operator, monitor).run()
