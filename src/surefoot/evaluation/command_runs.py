"""One simulated robot under live control; commands, parameters and pushes act from the next control step on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import Controller, EpisodeRecorder
from surefoot.robot.params import PARAMETERS, Parameter
from surefoot.rotations import in_heading_frame
from surefoot.task.commands import CommandGenerator
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.terrain import TerrainConfig
from surefoot.task.trace import EpisodeTrace
from surefoot.world.registry import find_world, is_modelled

FIXED_PARAMETERS = ("control_step",)
"""Physical parameters that are part of the policy's contract and can't be changed while it runs."""
_SEED = 1
_MAX_STEPS = 1_000_000
_LIE_TIME = 1.5
"""Time between a fall and the reset to the start [s]."""
MAX_RECORDING = 120.0
"""Maximum length of a recording [s]."""
_MAX_FORCE = 2000.0
"""Maximum force of a push [N]."""


@dataclass(frozen=True)
class LiveParameter:
    """A physical parameter that can be changed while the robot runs."""

    name: str
    """Name of the parameter; if its columns have different meanings, with the column's name after a dot."""
    group: str
    label: str
    unit: str
    """Unit; empty for dimensionless numbers, "x nominal" for ratios."""
    meaning: str
    low: float
    """Minimum that the robot allows."""
    high: float
    """Maximum that the robot allows."""
    nominal: float
    """Value in the policy's task; the mean if each motor has its own value."""
    value: float
    """Current value; the mean if each motor has its own value."""


@dataclass(frozen=True)
class DrivenStep:
    """State of a driven robot at the end of a control step."""

    time: float
    """Simulated time since the robot was created [s]."""
    position: Array
    """Position of the base in the world frame (3,) [m]."""
    velocity: Array
    """Forward and sideways speed in the heading frame [m/s] and yaw rate [rad/s] (3,)."""
    command: Array
    """Filtered command that the gait follows (3,) [m/s, m/s, rad/s]; NaN without commands."""
    torque: Array
    """Motor torques (M,) [N m]."""
    heat: float
    """Heating power of all motors [W]."""
    contact: Array
    """Fraction of the step in which each foot touched the ground (L,)."""


class DrivenRecording:
    """Recording of a driven robot, which ends at a fall, a restart, `MAX_RECORDING` or a call of `end`.

    Args:
        env: environment of the robot.
        meta: additional entries of the trace's metadata.
    """

    def __init__(self, env: LocomotionEnv, meta: dict[str, Any]) -> None:
        self._env, self._recorder, self._meta = env, EpisodeRecorder(env, pushed=True), meta
        self.ended = ""
        """How it ended, as in a trace's metadata; empty while it is running."""
        self.on_rows: Callable[[Array], None] = lambda rows: None
        """Called with the row (1, width) of every control step."""

    @property
    def duration(self) -> float:
        """Length [s]."""
        return len(self._recorder.rows) * float(self._env.world.params.control_step[0])

    def add(self, observation: NDArray[np.float32], fell: bool) -> None:
        """Add the last control step, unless the recording has ended; `observation` (1, O) is the one at its start."""
        if self.ended:
            return
        if self._env.state.truth.diverged[0]:
            self.end("fault")
            return
        self.on_rows(self._recorder.record(self._env.state.readings.time, observation))
        if fell or self.duration >= MAX_RECORDING:
            self.end("fall" if fell else "time")

    def end(self, ended: str) -> None:
        """End the recording; without effect if it has already ended."""
        self.ended = self.ended or ended

    def head(self) -> bytes:
        """Return the header line of the file that stores its rows."""
        return self._recorder.head(0, self._meta).line()

    def trace(self) -> EpisodeTrace:
        """Return the trace.

        Raises:
            SurefootError: no control step was recorded.
        """
        if not self._recorder.rows:
            raise SurefootError("no control step was recorded")
        meta = {**self._meta, "ended": self.ended or "stopped"}
        return self._recorder.trace(0, len(self._recorder.rows), meta)


class DrivenRobot:
    """Simulated robot that runs a policy one control step at a time.

    Args:
        policy: computes the feedback.
        task: the policy's task; its pushes and randomization are switched off.
        world: name of the world.
        terrain: terrain, as in `TerrainConfig.ground`.
    """

    def __init__(self, policy: Controller, task: TaskConfig, world: str, terrain: str = "flat") -> None:
        pushes = replace(task.pushes, enabled=False)
        # Every start is the same, so that two robots that start together can be compared.
        task = replace(task, start_linear_speed=0.0, start_angular_speed=0.0)
        ground = TerrainConfig(ground=terrain, scan=task.terrain.scan)
        task = replace(task, pushes=pushes, max_steps=_MAX_STEPS, randomize={}, terrain=ground)
        self._command = CommandGenerator(1)
        self.policy, self.world = policy, world
        self.env = LocomotionEnv(task, 1, find_world(world), _SEED, autoreset=False, threads=1, source=self._command)
        self.robot, self.step_time = self.env.robot, float(self.env.world.params.control_step[0])
        self.limits = task.commands.limits(self.robot)
        self.rows: deque[DrivenStep] = deque(maxlen=4000)
        self.falls, self.steps, self.restarts = 0, 0, 0
        self._push_until = self._stand_at = np.inf
        self._observation, _ = self.env.reset()
        self._recording: DrivenRecording | None = None

    @property
    def commanded(self) -> Array:
        """Command (3,) [m/s, m/s, rad/s], clamped to the limits, before the filter."""
        command: Array = self._command.command[0]
        return command

    @property
    def push_force_world(self) -> Array:
        """Current push on the base, in the world frame (3,) [N]."""
        force: Array = self.env.state.push_force[0]
        return force

    @property
    def must_stand_up(self) -> bool:
        """Whether the next step resets the robot, `_LIE_TIME` after a fall."""
        return self.time >= self._stand_at

    @property
    def time(self) -> float:
        """Simulated time since the robot was created [s]."""
        return self.steps * self.step_time

    def command(self, command: ArrayLike) -> None:
        """Set the command (3,) [m/s, m/s, rad/s], clamped to the policy's limits; `CommandFilter` follows it.

        Raises:
            SurefootError: the policy has no commands, or a number is not finite.
        """
        if self.limits is None:
            raise SurefootError("this policy follows no commands")
        self._command.command[0], _ = self.limits.clamp(command)

    def push(self, force: ArrayLike, duration: float) -> None:
        """Push the base with a force (3,) [N] in the heading frame, for a duration [s].

        Raises:
            SurefootError: a number is not finite, or the force or duration is too large.
        """
        vector = np.asarray(force, float)
        if vector.shape != (3,) or not (np.linalg.norm(vector) <= _MAX_FORCE) or not 0.0 < duration <= 10.0:
            raise SurefootError(f"push: must be up to {_MAX_FORCE:g} N, for up to 10 s")
        yaw = self.env.state.truth.roll_pitch_yaw[0, 2]
        self._push(in_heading_frame(vector[None], np.array([-yaw])))
        self._push_until = self.time + duration

    def _push(self, force_world: Array) -> None:
        self.env.state.push_force[:] = force_world
        self.env.world.push(force_world)

    def live_parameters(self) -> list[LiveParameter]:
        """Return the parameters that can be changed: those that the motors have and the world's engine models."""
        parameters = []
        for name, declared in PARAMETERS.items():
            if not self._has(name, declared):
                continue
            unit = "x nominal" if declared.nominal == 1.0 else declared.unit_for(self.robot)
            unit = "" if unit == "1" else unit
            values, nominal = (getattr(one, name)[0] for one in (self.env.world.params, self.env.nominal))
            parts = {"": (nominal.mean(), values.mean())}
            if declared.per not in ("", "motors"):
                parts = dict(zip(declared.element_names(()), zip(nominal, values, strict=True), strict=True))
            parameters += [
                LiveParameter(
                    f"{name}.{part}".removesuffix("."),
                    declared.group,
                    f"{declared.label}, {part}".removesuffix(", "),
                    unit,
                    declared.meaning,
                    *self.robot.allowed[name],
                    *map(float, pair),
                )
                for part, pair in parts.items()
            ]
        return parameters

    def _has(self, name: str, declared: Parameter) -> bool:
        ignored = declared.servo_only and self.env.task.actuator == "constraint"
        return (
            name not in FIXED_PARAMETERS
            and declared.belongs_to(self.robot)
            and is_modelled(self.world, name)
            and not ignored
        )

    def set(self, parameter: str, value: float) -> None:
        """Set a physical parameter in the running simulation.

        If each motor has its own value, all are scaled to the new mean.

        Raises:
            SurefootError: no such parameter, or the robot or the engine does not allow the value; nothing has changed.
        """
        name, _, column = parameter.partition(".")
        if parameter not in (one.name for one in self.live_parameters()):
            raise SurefootError(f"'{parameter}' is not a parameter of {self.robot.name} that can be set while it runs")
        world = self.env.world
        now, nominal = getattr(world.params, name), getattr(self.env.nominal, name)
        if column:
            values = now.copy()
            values[:, PARAMETERS[name].element_names(()).index(column)] = value
        else:
            mean = float(nominal.mean())
            values = nominal / mean * value if mean else np.full_like(now, value)
        world.set_params([0], world.params.rows([0]).with_values(self.robot, **{name: values}))

    def restart(self) -> None:
        """Reset the robot to its start and end its recording; parameters keep their values."""
        self.restarts += 1
        if self._recording is not None:
            self._recording.end("stopped")
        self._observation, _ = self.env.reset()
        self._push(np.zeros((1, 3)))
        self._push_until = self._stand_at = np.inf

    def record(self, policy: str) -> DrivenRecording:
        """Start a new recording, whose trace names the policy `policy`; it replaces an earlier recording."""
        self._recording = DrivenRecording(self.env, {"policy": policy, "world": self.world, "seed": _SEED})
        return self._recording

    def step(self) -> DrivenStep:
        """Run one control step; a robot that fell is reset after `_LIE_TIME`."""
        env = self.env
        if self.must_stand_up:
            self.restart()
        if self.time >= self._push_until:
            self._push(np.zeros((1, 3)))
            self._push_until = np.inf
        observation = self._observation
        self._observation, _, fell, over, _ = env.step(env.gait.action(self.policy.feedback(observation)))
        self.steps += 1
        if self._recording is not None:
            self._recording.add(observation, bool(fell[0]))
        if fell[0] or over[0]:
            self.falls += int(fell[0])
            self._stand_at = self.time + _LIE_TIME
        truth, velocity = env.state.truth, env.state.planar_velocity[0]
        state, torque = env.state.gait_state, truth.motor_torque[0]
        command = np.full(3, np.nan) if state is None else state.command[0]
        heat = float(truth.heat.sum()) / self.step_time
        row = DrivenStep(
            self.time, truth.base_position_world[0], velocity, command, torque, heat, truth.foot_contact[0]
        )
        self.rows.append(row)
        return row
