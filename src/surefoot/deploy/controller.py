"""Policy controller of one robot: from sensor readings to motor angles, with the same arithmetic as in training."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.deploy.messages import State
from surefoot.deploy.readings import sensor_readings
from surefoot.deploy.safety import check_finite
from surefoot.errors import SurefootError
from surefoot.estimation.torque_delay import TorqueDelay
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.commands import STAND_COMMAND
from surefoot.task.base_velocity import BaseVelocity
from surefoot.task.commands import CommandGenerator
from surefoot.task.component import RobotComponent
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.gait_components import gait_components
from surefoot.task.observation import Observer
from surefoot.task.state import RobotState


class _OperatorCommand(CommandGenerator):
    """Last command of the operator; a new episode keeps it."""

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Keep the command."""


class Controller:
    """Observation, history, policy and reference gait of one robot, evaluated once per control step.

    Raises:
        SurefootError: an unknown observation, or a gait that is outside the robot's limits.
    """

    def __init__(self, policy: PolicyRuntime, robot: RobotDescription) -> None:
        self.policy, self.robot, self.contract = policy, robot, policy.contract
        self.task = task_from_contract(policy.contract, robot)
        contract, limits = self.contract, self.contract.commands
        self.observer = Observer(robot, tuple(part.name for part in contract.observation), contract.action_names)
        self.gait = self.task.gait(robot)
        self.observation, self.feedback = np.zeros(self.observer.width), np.zeros(len(contract.action_names))
        self.target, self.inference = robot.resting_angles, 0.0
        """Latest observation (O,), feedback (A,), motor target (M,) [rad] and inference time [s]."""
        self.heights: Array | None = None
        """Ground heights (K,) [m] on the height-map grid of the contract; None for a blind policy."""
        self._history: NDArray[np.float32] | None = None
        self._source = _OperatorCommand(1)
        self._components: list[RobotComponent] = []
        self._torque_delay: TorqueDelay | None = None
        """Makes torques as old as the other readings, for policies that observe an estimated velocity."""
        if self.task.needs_base_velocity:
            self._components.append(BaseVelocity(robot, 1))
        if limits is not None:
            self._components += gait_components(self.gait, limits, self._source, 1)
        self._state: RobotState

    def reset(self, lead: float = 0.0) -> None:
        """Start a new episode with a zero velocity command.

        Args:
            lead: time from the sending of a state to its control step [s].
        """
        if self.task.needs_base_velocity:
            self._torque_delay = TorqueDelay(self.robot, lead)
        self.feedback = np.zeros_like(self.feedback)
        self._source.command[:] = STAND_COMMAND
        self._history = None

    @property
    def command(self) -> Array:
        """Velocity command (3,) within the contract's limits: forward and lateral speed [m/s], yaw rate [rad/s]."""
        command: Array = self._source.command[0].copy()
        return command

    def set_command(self, command: ArrayLike) -> str:
        """Set the velocity command (3,) for the next control step; return a description of clamped values, or "".

        Raises:
            SurefootError: the policy follows no commands, or the command is not three finite numbers.
        """
        if self.contract.commands is None:
            raise SurefootError(f"policy '{self.contract.name}' has no commands to follow")
        self._source.command[0], clamped = self.contract.commands.clamp(command)
        return clamped

    def observe(self, moment: float, state: State, missed: int = 0) -> NDArray[np.float32]:
        """Return the policy's input (1, O * history), the newest observation first.

        Args:
            moment: time since the start of the episode [s].
            state: latest state of the robot.
            missed: control steps missed before this one; the history repeats the previous observation for them.

        Raises:
            NotFiniteError: a sensor reading is not finite.
        """
        step, torque = self.contract.control_step * (missed + 1), state.motor_torque
        if self._torque_delay is not None:
            torque = self._torque_delay.update(torque, step)
        readings, duration = sensor_readings(state, moment, torque), np.array([step])
        if self._history is None:
            self._state = RobotState.initial(self.gait, readings, duration)
        now = self._state
        now.readings, now.duration = readings, duration
        now.feedback, now.target = self.feedback[None], self.target[None]
        now.heights = None if self.heights is None else self.heights[None]
        for component in self._components:
            if self._history is None:
                component.reset(np.arange(1), now)
            else:
                component.after_step(now)
        self.observation = self.observer.observe(now)[0]
        check_finite("observation", self.contract.columns, self.observation)
        if self._history is None:
            self._history = np.tile(self.observation, (self.contract.history, 1)).astype(np.float32)
        else:
            for _ in range(min(missed + 1, self.contract.history)):
                self._history[1:] = self._history[:-1].copy()
            self._history[0] = self.observation
        return self._history.reshape(1, -1)

    def compute_target(self, moment: float, observation: NDArray[np.float32]) -> Array:
        """Run the policy on its input at time `moment` of the episode [s]; return the motor target (M,) [rad].

        Raises:
            NotFiniteError: feedback or target is not finite.
        """
        started = time.perf_counter()
        self.feedback = np.asarray(self.policy.feedback(observation), float)[0]
        self.inference = time.perf_counter() - started
        check_finite("feedback", self.contract.action_names, self.feedback)
        self.target = self.gait.motor_targets(np.array([moment]), self.feedback[None], self._state.gait_state)[0]
        check_finite("target", self.robot.motor_names, self.target)
        return self.target
