"""What the gaits of robots follow, the same in simulation and on the robot: commands, footholds and touch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task.commands import CommandFilter, CommandState
from surefoot.task.footholds import Footholds
from surefoot.task.reference import Reference
from surefoot.task.touch import TouchLift
from surefoot.world.interface import Readings


class Follower:
    """Commands that N robots follow, and what their reference makes of a map, of touch and of attitude.

    Args:
        reference: the gait's.
        limits: of the commands.
        robot: the robot.
        num_envs: robots.
    """

    def __init__(self, reference: Reference, limits: CommandLimits, robot: RobotDescription, num_envs: int) -> None:
        self.commands = CommandFilter.from_reference(reference, limits, robot, num_envs)
        self.footholds = Footholds.of(reference, num_envs)
        self.touch = TouchLift.of(reference, num_envs)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays that change over time, by name."""
        parts = {"commands": self.commands, "footholds": self.footholds, "touch": self.touch}
        return {
            f"{prefix}_{name}": getattr(part, name)
            for prefix, part in parts.items()
            if part is not None
            for name in part.arrays
        }

    def reset(self, rows: NDArray[np.int64], yaw: Array) -> None:
        """Let robots stand, whose IMU says `yaw` (N,) [rad]."""
        self.commands.reset(rows, yaw)
        for part in (self.footholds, self.touch):
            if part is not None:
                part.reset(rows)

    def advance(
        self, command: Array, step: Array, readings: Readings, target: Array, heights: Array | None = None
    ) -> None:
        """Go on by a control step.

        Args:
            command: speeds forward and to the left [m/s] and yaw rate [rad/s] that are given (N, 3).
            step: its duration (N,) [s].
            readings: at its end.
            target: motor angles (N, M) [rad] that were commanded.
            heights: maps of heights (N, P) [m]; without them footholds stay.
        """
        over_holes = None if self.footholds is None else self.footholds.over_holes
        self.commands.advance(command, step, readings.roll_pitch_yaw[:, 2], over_holes)
        state = replace(self.commands.state, over_holes=over_holes)
        if self.touch is not None:
            self.touch.update(target, readings.motor_angle, state, step)
        if self.footholds is not None and heights is not None:
            self.footholds.choose(heights, state, readings, step)

    @property
    def state(self) -> CommandState:
        """Commands, phase, footholds and lift that the gait follows now; the arrays are copies."""
        state = self.commands.state
        if self.footholds is not None:
            feet = self.footholds
            state = replace(
                state,
                lift_off=feet.lift_off.copy(),
                landing=feet.landing.copy(),
                over_holes=feet.over_holes.copy(),
            )
        return state if self.touch is None else replace(state, lift=self.touch.lift.copy())
