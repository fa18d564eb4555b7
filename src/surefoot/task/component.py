"""Components: the capabilities of an environment, each with the hooks of a control step that it needs.

`LocomotionEnv` calls the hooks of its components in the order of `components.make_components`. The control computer of
a robot runs those of them that are a `RobotComponent`: commands, contact reflex and footholds. A hook that a component
does not override does nothing. A capability that a task does not have is not in
the list.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.task.state import EnvState, RobotState

Privileged = list[tuple[list[str], Array]]
"""Groups of privileged observations: names and numbers (N, width)."""


class Component:
    """A capability of an environment; this one has none.

    Hooks take the state of the batch and may write to it what they own. `rows` (n,) are robots whose episodes start.
    """

    prefix = ""
    """Name in the state for an exact resume, which no other component has."""
    changing: tuple[str, ...] = ()
    """Names of the attributes that are arrays and change over time."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays that an exact resume needs, by name."""
        return {f"{self.prefix}_{name}": getattr(self, name) for name in self.changing}

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Streams of random numbers by name, one per robot, for an exact resume."""
        return {}

    def before_reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Prepare the world for new episodes: place robots, draw their parameters."""

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Start new episodes of robots that the world has reset."""

    def before_step(self, state: EnvState) -> None:
        """Act on the world before a control step."""

    def measure(self, state: EnvState) -> None:
        """Measure what reward terms take, after the world's step."""

    def after_step(self, state: EnvState) -> None:
        """Go on to the next control step; `state.reward` is known."""

    def privileged(self, state: EnvState) -> Privileged:
        """Return what a critic may observe of this in simulation."""
        return []

    def info(self, state: EnvState) -> Mapping[str, Any]:
        """Return entries of the `info` of the control step."""
        return {}

    def metrics(self) -> Mapping[str, Any]:
        """Return metrics of the batch for the log of a training, by name."""
        return {}

    def publish(self, state: EnvState) -> None:
        """Write to the state what others read of this component, after `set_state`."""


class RobotComponent(Component):
    """A capability that the control computer of a robot has too: these hooks take a `RobotState`."""

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Start new episodes of robots."""

    def after_step(self, state: RobotState) -> None:
        """Go on to the next control step."""

    def publish(self, state: RobotState) -> None:
        """Write to the state what others read of this component."""
