"""Deployments of other frameworks, reimplemented in 32-bit arithmetic from their published sources.

Each computes the network's observation from readings and a command, and motor angles from the network's action, which
it stores as the last action.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from third_party_policies import Readings

MOTORS = 12


def single(values: object) -> np.ndarray:
    """Return values in single precision."""
    return np.asarray(values, np.float32)


def rotate_inverse(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate a vector from the world to the base frame, quaternion w x y z, as Isaac's `quat_rotate_inverse`."""
    w, xyz = quaternion[0], quaternion[1:]
    rotated: np.ndarray = vector * (2 * w * w - 1) - np.cross(xyz, vector) * w * 2 + xyz * np.dot(xyz, vector) * 2
    return rotated


def gravity(readings: Readings) -> np.ndarray:
    """Return the direction of gravity in the base frame."""
    return rotate_inverse(single(readings.quaternion), single([0, 0, -1]))


class RlSar:
    """Deployment of rl_sar (`rl_sdk.cpp`, `observation_buffer.cpp`); `config` is the content of its `config.yaml`."""

    def __init__(self, config: dict[str, Any]) -> None:
        self._config = config
        self._history: list[np.ndarray] = []
        self._actions = np.zeros(MOTORS, np.float32)

    def _array(self, key: str) -> np.ndarray:
        return single(self._config[key])

    def observe(self, readings: Readings, command: np.ndarray) -> np.ndarray:
        """Compute the network's input."""
        mapping = self._config["joint_mapping"]
        position = single(readings.motor_angle[mapping]) - self._array("default_dof_pos")
        terms = {
            "commands": single(command) * self._array("commands_scale"),
            "ang_vel": single(readings.angular_velocity_base) * self._array("ang_vel_scale"),
            "gravity_vec": gravity(readings),
            "dof_pos": position * self._array("dof_pos_scale"),
            "dof_vel": single(readings.motor_velocity[mapping]) * self._array("dof_vel_scale"),
            "actions": self._actions,
        }
        limit = self._config["clip_obs"]
        observation = np.clip(np.concatenate([terms[name] for name in self._config["observations"]]), -limit, limit)
        ages = self._config["observations_history"]
        if not ages:
            return observation
        length = max(ages) + 1
        self._history = [observation, *(self._history or [observation] * length)][:length]
        return np.concatenate([self._history[age] for age in ages])

    def targets(self, actions: np.ndarray) -> np.ndarray:
        """Convert the network's output to motor angles."""
        self._actions = np.clip(actions, self._array("clip_actions_lower"), self._array("clip_actions_upper"))
        angles = np.zeros(MOTORS, np.float32)
        angles[self._config["joint_mapping"]] = self._actions * self._array("action_scale") + self._array(
            "default_dof_pos"
        )
        return angles


@dataclass
class IsaacLab:
    """Deployment of Isaac Lab's managers, also used by mjlab and unitree_rl_lab.

    Terms are clipped, scaled and stored in a queue, which is initially filled with the first value.
    """

    order: list[int]
    """Motor of each joint."""
    pose: Any
    layout: list[tuple[str, Any, Any, int]]
    """Name, clipping limits, scale and history length of each term."""
    action_scale: Any
    target_clip: Any = None
    by_step: bool = False
    """Option `use_gym_history` of unitree_rl_lab: all terms of a step, then all terms of the next step."""
    scale_first: bool = False
    phase_step: float = 0.0
    """Increase of the gait phase per control step, also before the first one [cycles]."""
    step: int = 0
    _queues: list[deque[np.ndarray]] = field(default_factory=list)
    _actions: np.ndarray = field(default_factory=lambda: np.zeros(MOTORS, np.float32))

    def _term(self, name: str, readings: Readings, command: np.ndarray) -> np.ndarray:
        phase = 2 * np.pi * (self.step * self.phase_step % 1.0)
        return single(
            {
                "base_ang_vel": readings.angular_velocity_base,
                "projected_gravity": gravity(readings),
                "command": command,
                "joint_pos": single(readings.motor_angle[self.order]) - single(self.pose),
                "joint_vel": readings.motor_velocity[self.order],
                "actions": self._actions,
                "phase": [np.sin(phase), np.cos(phase)],
            }[name]
        )

    def observe(self, readings: Readings, command: np.ndarray) -> np.ndarray:
        """Compute the network's input."""
        self.step += 1
        self._queues = self._queues or [deque(maxlen=max(length, 1)) for *_, length in self.layout]
        for queue, (name, clip, scale, _) in zip(self._queues, self.layout, strict=True):
            low, high = clip or (-np.inf, np.inf)
            value = self._term(name, readings, command)
            value = np.clip(value * single(scale), low, high) if self.scale_first else np.clip(value, low, high) * scale
            queue.extend([single(value)] * (1 if queue else queue.maxlen or 1))
        if self.by_step:
            return np.concatenate([queue[age] for age in range(len(self._queues[0])) for queue in self._queues])
        return np.concatenate([value for queue in self._queues for value in queue])

    def targets(self, actions: np.ndarray) -> np.ndarray:
        """Convert the network's output to motor angles."""
        self._actions = single(actions)
        joints = self._actions * single(self.action_scale) + single(self.pose)
        if self.target_clip is not None:
            joints = np.clip(joints, *single(self.target_clip).T)
        angles = np.zeros(MOTORS, np.float32)
        angles[self.order] = joints
        return angles


@dataclass
class LeggedGym:
    """Deployment of legged_gym (`legged_robot.py`: `compute_observations`, `_compute_torques`), no base velocity."""

    order: list[int]
    pose: Any
    action_scale: float
    _actions: np.ndarray = field(default_factory=lambda: np.zeros(MOTORS, np.float32))

    def observe(self, readings: Readings, command: np.ndarray) -> np.ndarray:
        """Compute the network's input."""
        parts = [
            single(readings.angular_velocity_base) * single(0.25),
            gravity(readings),
            single(command) * single([2.0, 2.0, 0.25]),
            single(readings.motor_angle[self.order]) - single(self.pose),
            single(readings.motor_velocity[self.order]) * single(0.05),
            self._actions,
        ]
        return np.clip(np.concatenate(parts), -100, 100)

    def targets(self, actions: np.ndarray) -> np.ndarray:
        """Convert the network's output to motor angles."""
        self._actions = np.clip(single(actions), -100, 100)
        angles = np.zeros(MOTORS, np.float32)
        angles[self.order] = self._actions * single(self.action_scale) + single(self.pose)
        return angles
