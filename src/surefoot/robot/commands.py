"""Commands of a robot that is steered: speeds forward and sideways and a yaw rate, all in the heading frame.

The heading frame stands upright and has the base's yaw: x forward, y left, z up. All three commands zero mean: stand.
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
"""Names of the commands in order, with units; sideways is positive to the left, the yaw rate about +z."""
STAND = (0.0, 0.0, 0.0)
"""The command that means stand."""
_MAX_COMMAND = 1e3


@dataclass(frozen=True)
class CommandLimits:
    """What a policy can be commanded, as its contract states it."""

    forward: tuple[float, float]
    """Range of speeds forward [m/s]."""
    sideways: tuple[float, float]
    """Range of speeds to the left [m/s]; (0, 0) for legs without abduction."""
    yaw_rate: tuple[float, float]
    """Range of yaw rates [rad/s]."""
    acceleration: Annotated[tuple[float, float, float], Within(0.0, _MAX_COMMAND, above=True)]
    """How fast each command that the gait follows may change [m/s^2, m/s^2, rad/s^2]."""
    deadband: Annotated[tuple[float, float, float], Within(0.0, _MAX_COMMAND)]
    """Commands that are all no greater than this mean stand [m/s, m/s, rad/s]."""
    heading_gain: Annotated[float, Within(0.0, _MAX_COMMAND)] = 0.0
    """Yaw rate that is added per heading error [1/s]; 0: the heading is not held."""

    def __post_init__(self) -> None:
        """Refuse ranges that are reversed or do not contain zero."""
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
        """Return a command (3,) within the limits, and what was changed in words, empty if nothing.

        Raises:
            SurefootError: not three finite numbers.
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

    def stands(self, command: Array) -> NDArray[np.bool_]:
        """Return whether commands (..., 3) mean stand (...)."""
        return np.asarray(np.all(np.abs(command) <= np.array(self.deadband), axis=-1))
