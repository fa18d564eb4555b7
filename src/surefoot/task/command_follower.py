"""Command filter and gait phase, the same in simulation and on the robot: rate limits, gradual start, heading hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot.commands import CommandLimits
from surefoot.task.commands import MAX_HEADING_ERROR, MAX_STANDING_HEADING_ERROR, CommandGenerator, CommandState
from surefoot.task.component import Privileged, RobotComponent
from surefoot.task.state import EnvState, RobotState

_START_DURATION = 1.5
"""Time from standing to full steps, and back [sqrt(l / g)]."""


class CommandFilter:
    """Filter between the requested commands and the gait.

    It limits the rate of change of commands, starts and stops stepping gradually, advances the gait's phase, and holds
    the heading: the desired heading is the integral of the commanded yaw rate, and the yaw of the IMU is controlled to
    it.

    Args:
        limits: limits of the commands.
        natural_time: sqrt(l / g) of the legs [s].
        num_envs: number of robots.
        frequency: function that returns the gait's frequency (N,) [Hz] for commands (N, 3) and the blend weight (N,) of
            the gait over holes.
    """

    arrays = ("filtered_command", "correction", "heading_error", "activity", "phase", "heading")
    """Names of the arrays that change over time."""

    def __init__(
        self, limits: CommandLimits, natural_time: float, num_envs: int, frequency: Callable[..., Array]
    ) -> None:
        self.limits, self._frequency = limits, frequency
        self._start_rate = 1.0 / (_START_DURATION * natural_time)
        self.filtered_command = np.zeros((num_envs, 3))
        """Commands after the rate limit (N, 3) [m/s, m/s, rad/s]."""
        self.correction = np.zeros(num_envs)
        """Yaw rate added to hold the heading (N,) [rad/s]."""
        self.heading_error = np.zeros(num_envs)
        """Desired minus measured heading (N,) [rad]."""
        self.activity = np.zeros(num_envs)
        self.phase = np.zeros(num_envs)
        self.heading = np.zeros(num_envs)
        """Desired heading (N,) [rad]."""

    def reset(self, rows: NDArray[np.int64], yaw: Array) -> None:
        """Command zero velocity and hold the current heading `yaw` (N,) [rad]."""
        for array in (self.filtered_command, self.correction, self.heading_error, self.activity, self.phase):
            array[rows] = 0.0
        self.heading[rows] = yaw[rows]

    def advance(self, target: Array, step: Array, yaw: Array, over_holes: Array | None = None) -> None:
        """Advance by one control step.

        Args:
            target: requested commands (N, 3) [m/s, m/s, rad/s].
            step: duration of the control step (N,) [s].
            yaw: yaw measured by the IMU (N,) [rad].
            over_holes: blend weight of the gait over holes (N,).
        """
        limits = self.limits
        change = np.array(limits.acceleration) * step[:, None]
        self.filtered_command += np.clip(target - self.filtered_command, -change, change)
        walks = ~limits.in_deadband(target) | ~limits.in_deadband(self.filtered_command)
        change = self._start_rate * step
        self.activity += np.clip(walks - self.activity, -change, change)
        self.phase = (self.phase + self._frequency(self.filtered_command, over_holes) * step) % 1.0
        self.heading += self.filtered_command[:, 2] * step
        error = (self.heading - yaw + np.pi) % (2 * np.pi) - np.pi
        limit = np.where(walks, MAX_HEADING_ERROR, MAX_STANDING_HEADING_ERROR)
        self.heading_error = np.clip(error, -limit, limit)
        self.heading = yaw + self.heading_error
        self.correction = np.where(walks, limits.heading_gain * self.heading_error, 0.0)

    @property
    def state(self) -> CommandState:
        """Current filtered command, activity and phase, as copies."""
        command = self.filtered_command.copy()
        command[:, 2] += self.correction
        return CommandState(command, self.activity.copy(), self.phase.copy())


class CommandFollower(RobotComponent):
    """Component that generates the commands of N robots and filters them for their gait.

    Args:
        source: command generator.
        commands: command filter.
    """

    def __init__(self, source: CommandGenerator, commands: CommandFilter) -> None:
        self.source, self.commands = source, commands

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays of source and filter that an exact resume needs, by name."""
        parts: dict[str, Any] = {"source": self.source, "commands": self.commands}
        return {f"{prefix}_{name}": getattr(part, name) for prefix, part in parts.items() for name in part.arrays}

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Random streams of the command generator, by name."""
        return {"command_streams": self.source.streams}

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Start with the generator's first commands, zero filtered velocity and the current heading."""
        self.source.reset(rows)
        self.commands.reset(rows, state.readings.roll_pitch_yaw[:, 2])
        self.publish(state)

    def after_step(self, state: RobotState) -> None:
        """Update the commands and advance the filter by one control step."""
        self.source.update(state.readings.time)
        over_holes = None if state.gait_state is None else state.gait_state.over_holes
        self.commands.advance(self.source.command, state.duration, state.readings.roll_pitch_yaw[:, 2], over_holes)
        self.publish(state)

    def privileged(self, state: EnvState) -> Privileged:
        """Return the heading error."""
        return [(["heading_error"], self.commands.heading_error[:, None])]

    def publish(self, state: RobotState) -> None:
        """Write the commands to the state and keep its footholds and lift."""
        now, before = self.commands.state, state.gait_state
        state.command, state.filtered_command = self.source.command, self.commands.filtered_command
        state.heading_error = self.commands.heading_error
        if before is not None:
            now = replace(before, command=now.command, activity=now.activity, phase=now.phase)
        state.gait_state = now
