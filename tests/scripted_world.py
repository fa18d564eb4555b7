"""World without physics that returns scripted states."""

from __future__ import annotations

from typing import Any

import numpy as np

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.world.interface import SensorReadings, SimState, WorldConfig

COMMAND_LIMITS = CommandLimits(
    forward=(-1.0, 2.0),
    sideways=(-0.5, 0.5),
    yaw_rate=(-1.0, 1.0),
    acceleration=(2.0, 2.0, 4.0),
    deadband=(0.02, 0.02, 0.02),
    heading_gain=2.0,
)
"""Limits of velocity commands."""


class ScriptedWorld:
    """World without physics: the base moves forward at `speed`, consumes `power`, and tilts on demand.

    The motors are at the targets of the previous control step.
    """

    def __init__(
        self,
        robot: RobotDescription,
        num_envs: int,
        params: PhysicalParams,
        seed: int = 0,
        config: WorldConfig | None = None,
    ) -> None:
        self.robot, self.num_envs, self.params = robot, num_envs, params
        self.config, self.seed = config or WorldConfig(), seed
        self.speed, self.power = np.zeros(num_envs), np.zeros(num_envs)
        self.tilt = np.zeros((num_envs, 2))
        self.diverged = np.zeros(num_envs, np.bool_)
        self.position, self.time = np.zeros(num_envs), np.zeros(num_envs)
        self.angles = np.zeros((num_envs, robot.num_motors))
        self.energy = np.zeros(num_envs)
        self.force = np.zeros((num_envs, 3))
        self.forces: list[np.ndarray] = []
        self.pushes = 0

    def reset(self, index: Any = None) -> SensorReadings:
        rows = np.arange(self.num_envs) if index is None else index
        self.position[rows], self.time[rows], self.angles[rows] = 0.0, 0.0, 0.0
        return self.readings()

    def step(self, target: Any, active: Any = None) -> SensorReadings:
        self.forces.append(self.force.copy())
        went = self.params.control_step * (True if active is None else active)
        self.time += went
        self.position += self.speed * went
        self.energy = self.power * went
        self.angles = np.array(target, float)
        return self.readings()

    def readings(self) -> SensorReadings:
        tilt = np.concatenate([self.tilt, np.zeros((self.num_envs, 1))], axis=1)
        return SensorReadings(self.time.copy(), tilt, 10 * tilt, self.angles.copy(), 2 * self.angles)

    def truth(self) -> SimState:
        zeros, motors = np.zeros((self.num_envs, 3)), np.zeros((self.num_envs, self.robot.num_motors))
        tilt = np.concatenate([self.tilt, np.zeros((self.num_envs, 1))], axis=1)
        return SimState(
            base_position_world=np.stack([self.position, 0 * self.position, 0 * self.position + 0.2], -1),
            base_quat_world=np.tile([1.0, 0, 0, 0], (self.num_envs, 1)),
            base_velocity_world=zeros,
            roll_pitch_yaw=tilt,
            motor_angle=self.angles.copy(),
            motor_velocity=motors,
            motor_torque=motors,
            energy=self.energy.copy(),
            heat=motors,
            foot_contact=np.ones((self.num_envs, 4)),
            motor_saturation=motors,
            diverged=self.diverged.copy(),
        )

    def push(self, force_world: Any) -> None:
        self.force = np.array(force_world, float)
        self.pushes += 1

    def get_state(self) -> dict[str, Any]:
        return {"streams": []}

    def set_state(self, state: dict[str, Any]) -> None:
        assert state == self.get_state()
