"""Velocity commands: forward and sideways velocity and yaw rate, all in the heading frame.

The heading frame is upright and has the yaw of the base: x forward, y left, z up. A command of zero means "stand".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.configuration import Within
from surefoot.errors import SurefootError

COMMANDS = {"forward": "m/s", "sideways": "m/s", "yaw_rate": "rad/s"}
"""Units of the commands by name, in order; sideways is positive to the left, the yaw rate is about +z."""
STAND_COMMAND = (0.0, 0.0, 0.0)
"""The command to stand still."""
_MAX_COMMAND = 1e3


@dataclass(frozen=True)
class CommandLimits:
    """Limits of the commands to a policy, stored in its contract."""

    forward: tuple[float, float]
    """Range of forward velocities [m/s]."""
    sideways: tuple[float, float]
    """Range of velocities to the left [m/s]; (0, 0) for legs without abduction."""
    yaw_rate: tuple[float, float]
    """Range of yaw rates [rad/s]."""
    acceleration: Annotated[tuple[float, float, float], Within(0.0, _MAX_COMMAND, exclusive=True)]
    """Maximum rate of change of each command that the gait follows [m/s^2, m/s^2, rad/s^2]."""
    deadband: Annotated[tuple[float, float, float], Within(0.0, _MAX_COMMAND)]
    """The robot stands still if all commands are within this deadband [m/s, m/s, rad/s]."""
    heading_gain: Annotated[float, Within(0.0, _MAX_COMMAND)] = 0.0
    """Additional yaw rate per heading error [1/s]; 0: the heading is not controlled."""

    def __post_init__(self) -> None:
        """Reject ranges that are reversed or do not contain zero."""
        for name in COMMANDS:
            low, high = getattr(self, name)
            if not -_MAX_COMMAND <= low <= 0.0 <= high <= _MAX_COMMAND:
                raise SurefootError(
                    f"commands.{name} is [{low:g}, {high:g}] {COMMANDS[name]}; it must go from 0 or less to 0 or more"
                )

    @property
    def low(self) -> Array:
        """Lower bounds of the commands (3,)."""
        return np.array([getattr(self, name)[0] for name in COMMANDS])

    @property
    def high(self) -> Array:
        """Upper bounds of the commands (3,)."""
        return np.array([getattr(self, name)[1] for name in COMMANDS])

    def clamp(self, command: ArrayLike) -> tuple[Array, str]:
        """Return a command (3,) clamped to the limits, and a text that names the clamped values, or "".

        Raises:
            SurefootError: the command is not three finite numbers.
        """
        values = np.asarray(command, float)
        if values.shape != (3,):
            raise SurefootError(f"command has shape {values.shape}; it is {', '.join(COMMANDS)}")
        for name, value in zip(COMMANDS, values, strict=True):
            if not math.isfinite(value):
                raise SurefootError(f"command {name} is {value}; it must be a finite number")
        bounded = np.clip(values, self.low, self.high)
        changed = [
            f"{name} {value:g} to {bound:g} {unit}"
            for (name, unit), value, bound in zip(COMMANDS.items(), values, bounded, strict=True)
            if value != bound
        ]
        return bounded, ", ".join(changed)

    def in_deadband(self, command: Array) -> NDArray[np.bool_]:
        """Return whether commands (..., 3) are within the deadband (...), so that the robot stands still."""
        return np.asarray(np.all(np.abs(command) <= np.array(self.deadband), axis=-1))
