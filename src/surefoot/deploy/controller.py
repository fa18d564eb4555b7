"""The policy on a robot: from a state to motor angles, with the arithmetic of training."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.deploy.messages import State
from surefoot.deploy.safety import check_finite
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.commands import STAND
from surefoot.task.commands import CommandState
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.follower import Follower
from surefoot.task.observation import ObservationInputs, Observer
from surefoot.world.interface import Readings


class Controller:
    """Observation, history, policy and reference for one robot, step by step.

    Raises:
        SurefootError: an observation that does not exist, or a gait that the robot does not allow.
    """

    def __init__(self, policy: PolicyRuntime, robot: RobotDescription) -> None:
        self.policy, self.robot, self.contract = policy, robot, policy.contract
        self.task = task_from_contract(policy.contract, robot)
        contract, limits = self.contract, self.contract.commands
        self.observer = Observer(robot, tuple(part.name for part in contract.observation), contract.action_names)
        self.gait = self.task.gait(robot)
        self.observation, self.feedback = np.zeros(self.observer.width), np.zeros(len(contract.action_names))
        self.target, self.inference = robot.resting_angles, 0.0
        """The newest observation (O,), feedback (A,), motor angles (M,) [rad], and time of inference [s]."""
        self.command = np.array(STAND)
        """The command (3,), within the contract's limits: speeds [m/s], yaw rate [rad/s]."""
        self.heights: Array | None = None
        """Heights of the ground (K,) [m] on the grid of the contract's map, for a policy that sees them."""
        self._history: NDArray[np.float32] | None = None
        self._follower = None if limits is None else Follower(self.gait.reference, limits, robot, 1)

    def reset(self) -> None:
        """Start a new episode, with the command to stand."""
        self.feedback = np.zeros_like(self.feedback)
        self.command = np.array(STAND)
        self._history = None

    def set_command(self, command: ArrayLike) -> str:
        """Set the command (3,) from the next control step on; return what was clamped, in words.

        Raises:
            SurefootError: a policy without commands, or not three finite numbers.
        """
        if self.contract.commands is None:
            raise SurefootError(f"policy '{self.contract.name}' has no commands to follow")
        self.command, clamped = self.contract.commands.clamp(command)
        return clamped

    def _state(self) -> CommandState | None:
        return None if self._follower is None else self._follower.state

    def observe(self, moment: float, state: State, missed: int = 0) -> NDArray[np.float32]:
        """Return the policy's input (1, O * history), the newest observation first.

        Args:
            moment: of the episode [s].
            state: the newest state.
            missed: control steps missed before; in the history they have the last step's observation.

        Raises:
            NotFiniteError: a reading that is not finite.
        """
        readings = Readings(
            time=np.array([moment]),
            roll_pitch_yaw=state.roll_pitch_yaw[None],
            angular_velocity_base=state.angular_velocity_base[None],
            motor_angle=state.motor_angle[None],
            motor_velocity=state.motor_velocity[None],
        )
        heights = None if self.heights is None else self.heights[None]
        if self._follower is not None and self._history is None:
            self._follower.reset(np.arange(1), readings.roll_pitch_yaw[:, 2])
        elif self._follower is not None:
            step = np.array([self.contract.control_step * (missed + 1)])
            self._follower.advance(self.command[None], step, readings, self.target[None], heights)
        inputs = ObservationInputs(
            readings, self.gait.reference, self.feedback[None], self._state(), self.gait.memory, heights
        )
        self.observation = self.observer.observe(inputs)[0]
        check_finite("observation", self.contract.columns, self.observation)
        if self._history is None:
            self._history = np.tile(self.observation, (self.contract.history, 1)).astype(np.float32)
        else:
            for _ in range(min(missed + 1, self.contract.history)):
                self._history[1:] = self._history[:-1].copy()
            self._history[0] = self.observation
        return self._history.reshape(1, -1)

    def compute_target(self, moment: float, observation: NDArray[np.float32]) -> Array:
        """Return motor angles (M,) [rad] for the policy's input at a moment of the episode [s].

        Raises:
            NotFiniteError: feedback or target that is not finite.
        """
        started = time.perf_counter()
        self.feedback = np.asarray(self.policy.feedback(observation), float)[0]
        self.inference = time.perf_counter() - started
        check_finite("feedback", self.contract.action_names, self.feedback)
        self.target = self.gait.motor_targets(np.array([moment]), self.feedback[None], self._state())[0]
        check_finite("target", self.robot.motor_names, self.target)
        return self.target
