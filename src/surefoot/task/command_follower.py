"""The command that a gait follows, the same in simulation and on the robot: limited in its change, with a phase."""

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
"""Time in which a gait goes from standing to full steps, and back [sqrt(l / g)]."""


class CommandFilter:
    """Turns the commands that are given into those that a gait follows, the same in simulation and on the robot.

    Changes are limited, steps begin and end gradually, the phase advances with the gait's frequency, and the
    heading is held: the integral of the commanded yaw rate, against the IMU's yaw.

    Args:
        limits: of the commands.
        natural_time: sqrt(l / g) of the legs [s].
        num_envs: robots.
        frequency: gives the gait's frequency [Hz] (N,) for commands (N, 3) and the share of the gait over holes (N,).
    """

    arrays = ("filtered_command", "correction", "heading_error", "activity", "phase", "heading")
    """Names of the arrays that change over time."""

    def __init__(
        self, limits: CommandLimits, natural_time: float, num_envs: int, frequency: Callable[..., Array]
    ) -> None:
        self.limits, self._frequency = limits, frequency
        self._start_rate = 1.0 / (_START_DURATION * natural_time)
        self.filtered_command = np.zeros((num_envs, 3))
        """The given commands, their change limited, (N, 3)."""
        self.correction = np.zeros(num_envs)
        """Yaw rate that holds the heading [rad/s], (N,)."""
        self.heading_error = np.zeros(num_envs)
        """Heading that is held less the robot's [rad], (N,)."""
        self.activity = np.zeros(num_envs)
        self.phase = np.zeros(num_envs)
        self.heading = np.zeros(num_envs)
        """The heading that is held [rad], (N,)."""

    def reset(self, rows: NDArray[np.int64], yaw: Array) -> None:
        """Let robots stand, whose IMU says `yaw` (N,) [rad]."""
        for array in (self.filtered_command, self.correction, self.heading_error, self.activity, self.phase):
            array[rows] = 0.0
        self.heading[rows] = yaw[rows]

    def advance(self, target: Array, step: Array, yaw: Array, over_holes: Array | None = None) -> None:
        """Go on by a control step.

        Args:
            target: commands (N, 3).
            step: its duration (N,) [s].
            yaw: of the IMU (N,) [rad].
            over_holes: share of the gait over holes (N,).
        """
        limits = self.limits
        change = np.array(limits.acceleration) * step[:, None]
        self.filtered_command += np.clip(target - self.filtered_command, -change, change)
        walks = ~limits.stands(target) | ~limits.stands(self.filtered_command)
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
        """Filtered command, activity and phase that the gait follows now; the arrays are copies."""
        command = self.filtered_command.copy()
        command[:, 2] += self.correction
        return CommandState(command, self.activity.copy(), self.phase.copy())


class CommandFollower(RobotComponent):
    """Commands to N robots, and what their gait follows.

    Args:
        source: gives the commands.
        commands: filters them.
    """

    def __init__(self, source: CommandGenerator, commands: CommandFilter) -> None:
        self.source, self.commands = source, commands

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays of source and filter that an exact resume needs, by name."""
        parts: dict[str, Any] = {"source": self.source, "commands": self.commands}
        return {f"{prefix}_{name}": getattr(part, name) for prefix, part in parts.items() for name in part.arrays}

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Streams of random numbers of the source, by name."""
        return {"command_streams": self.source.streams}

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Command zero velocity, or what the source begins with, and hold the current heading."""
        self.source.reset(rows)
        self.commands.reset(rows, state.readings.roll_pitch_yaw[:, 2])
        self.publish(state)

    def after_step(self, state: RobotState) -> None:
        """Take new commands and follow them for a control step."""
        self.source.update(state.readings.time)
        over_holes = None if state.gait_state is None else state.gait_state.over_holes
        self.commands.advance(self.source.command, state.duration, state.readings.roll_pitch_yaw[:, 2], over_holes)
        self.publish(state)

    def privileged(self, state: EnvState) -> Privileged:
        """Return the heading error."""
        return [(["heading_error"], self.commands.heading_error[:, None])]

    def publish(self, state: RobotState) -> None:
        """Write the commands to the state; footholds and lift in it stay."""
        now, before = self.commands.state, state.gait_state
        state.command, state.filtered_command = self.source.command, self.commands.filtered_command
        state.heading_error = self.commands.heading_error
        if before is not None:
            now = replace(before, command=now.command, activity=now.activity, phase=now.phase)
        state.gait_state = now
