"""One simulated robot under live control: commands, parameters and pushes act from the next control step on."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import Policy
from surefoot.robot.params import PARAMETERS
from surefoot.rotations import in_heading_frame
from surefoot.task.commands import CommandGenerator
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.reward import base_rates
from surefoot.world.interface import SimulationFactory

FIXED = ("control_step",)
"""Parameters that belong to the policy, and can't be changed while it runs."""
_MAX_STEPS = 1_000_000
_LIE_TIME = 1.5
"""How long a robot that fell lies until it stands again at its start [s]."""
_MAX_FORCE = 2000.0
"""Greatest force of a push [N]."""


@dataclass(frozen=True)
class Knob:
    """A physical parameter that can be changed while the robot runs: name, unit and bounds."""

    name: str
    """The parameter, and behind a dot the column of one that has several columns of different meaning."""
    unit: str
    meaning: str
    low: float
    """Least value that the robot allows."""
    high: float
    """Greatest value that the robot allows."""
    value: float
    """Present value; the motors' mean, where each has its own."""


@dataclass(frozen=True)
class DrivenStep:
    """A control step of a driven robot."""

    time: float
    """Simulated time since the robot was made [s]."""
    position: Array
    """Base in the world (3,) [m]."""
    velocity: Array
    """Base in the heading frame (3,) [m/s]; the third is the yaw rate [rad/s]."""
    command: Array
    """What the gait follows (3,) [m/s, m/s, rad/s]; NaN without commands."""
    torque: Array
    """Motors (M,) [N m]."""
    heat: float
    """All motors [W]."""
    contact: Array
    """Share of the step in which each foot touched the ground (L,)."""


class DrivenRobot:
    """A policy in a world, run one control step at a time.

    Args:
        policy: gives the feedback.
        task: what it was trained on; neither pushes nor randomization act.
        make_world: makes the simulation.
    """

    def __init__(self, policy: Policy, task: TaskConfig, make_world: SimulationFactory) -> None:
        pushes = replace(task.pushes, enabled=False)
        task = replace(task, pushes=pushes, max_steps=_MAX_STEPS, randomize={})
        self._command = CommandGenerator(1)
        self.policy = policy
        self.env = LocomotionEnv(task, 1, make_world, seed=1, autoreset=False, threads=1, source=self._command)
        self.robot, self.step_time = self.env.robot, float(self.env.world.params.control_step[0])
        self.limits = task.commands.limits(self.robot)
        self.rows: deque[DrivenStep] = deque(maxlen=4000)
        self.falls, self.steps, self.restarts = 0, 0, 0
        self._push_until = self._stand_at = np.inf
        self._observation, _ = self.env.reset()

    @property
    def time(self) -> float:
        """Simulated time since the robot was made [s]."""
        return self.steps * self.step_time

    def command(self, command: ArrayLike) -> None:
        """Set the command (3,) [m/s, m/s, rad/s], clamped to the policy's limits; `CommandFilter` follows it.

        Raises:
            SurefootError: a policy without commands, or numbers that are not finite.
        """
        if self.limits is None:
            raise SurefootError("this policy follows no commands")
        self._command.command[0], _ = self.limits.clamp(command)

    def push(self, force: ArrayLike, duration: float) -> None:
        """Push the base with a force (3,) [N] in the heading frame, for a duration [s].

        Raises:
            SurefootError: numbers that are not finite, or too large.
        """
        vector = np.asarray(force, float)
        if vector.shape != (3,) or not (np.linalg.norm(vector) <= _MAX_FORCE) or not 0.0 < duration <= 10.0:
            raise SurefootError(f"push: must be up to {_MAX_FORCE:g} N, for up to 10 s")
        yaw = self.env.truth.roll_pitch_yaw[0, 2]
        self.env.world.push(in_heading_frame(vector[None], np.array([-yaw])))
        self._push_until = self.time + duration

    def knobs(self) -> list[Knob]:
        """Return the numbers that can be set."""
        knobs = []
        for name, declared in PARAMETERS.items():
            if name in FIXED or not declared.belongs_to(self.robot):
                continue
            low, high = self.robot.allowed[name]
            about = (declared.unit, declared.meaning, low, high)
            values = getattr(self.env.world.params, name)
            if declared.per in ("", "motors"):
                knobs.append(Knob(name, *about, float(values.mean())))
            else:
                columns = zip(declared.parts(()), values[0], strict=True)
                knobs += [Knob(f"{name}.{column}", *about, float(value)) for column, value in columns]
        return knobs

    def set(self, knob: str, value: float) -> None:
        """Set a knob's parameter in the running simulation.

        Where each motor has a value of its own, all are scaled to the new mean.

        Raises:
            SurefootError: no such knob, or a value that robot or engine do not allow; then nothing has changed.
        """
        name, _, column = knob.partition(".")
        if knob not in (one.name for one in self.knobs()):
            raise SurefootError(f"'{knob}' is not a parameter of {self.robot.name} that can be set while it runs")
        world = self.env.world
        now, nominal = getattr(world.params, name), getattr(self.env.nominal, name)
        if column:
            values = now.copy()
            values[:, PARAMETERS[name].parts(()).index(column)] = value
        else:
            mean = float(nominal.mean())
            values = nominal / mean * value if mean else np.full_like(now, value)
        world.set_params([0], world.params.rows([0]).with_values(self.robot, **{name: values}))

    def restart(self) -> None:
        """Reset the robot to its start; parameters stay."""
        self.restarts += 1
        self._observation, _ = self.env.reset()
        self.env.world.push(np.zeros((1, 3)))
        self._push_until = self._stand_at = np.inf

    def step(self) -> DrivenStep:
        """Run one control step; a robot that fell stands up again after a while."""
        env = self.env
        if self.time >= self._stand_at:
            self.restart()
        if self.time >= self._push_until:
            env.world.push(np.zeros((1, 3)))
            self._push_until = np.inf
        before = env.truth
        self._observation, _, fell, over, _ = env.step(env.gait.action(self.policy.feedback(self._observation)))
        self.steps += 1
        if fell[0] or over[0]:
            self.falls += int(fell[0])
            self._stand_at = self.time + _LIE_TIME
        truth = env.truth
        (velocity,), (turn,) = base_rates(before, truth, self.step_time)
        velocity[2] = turn[2]
        state, torque = env.command_state, truth.motor_torque[0]
        command = np.full(3, np.nan) if state is None else state.command[0]
        heat = float(truth.heat.sum()) / self.step_time
        row = DrivenStep(
            self.time, truth.base_position_world[0], velocity, command, torque, heat, truth.foot_contact[0]
        )
        self.rows.append(row)
        return row
