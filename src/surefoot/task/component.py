"""Base classes of components: optional capabilities of an environment with hooks into its control step.

`LocomotionEnv` calls the hooks of its components in the order of `components.make_components`, which lists only the
components that the task needs. Hooks do nothing unless a component overrides them. A robot's control computer runs the
components that are a `RobotComponent`: velocity estimate, commands, contact reflex and footholds.
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
    """Base class of components, with hooks that do nothing.

    Hooks receive the state of the batch and write their own fields of it. `rows` (n,) are the indices of robots whose
    episodes start.
    """

    prefix = ""
    """Unique prefix of the component's arrays in a checkpoint."""
    changing: tuple[str, ...] = ()
    """Names of array attributes that change over time, which checkpoints store."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays that an exact resume needs, by name."""
        return {f"{self.prefix}_{name}": getattr(self, name) for name in self.changing}

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Random streams by name, with one per robot, for an exact resume."""
        return {}

    def before_reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Prepare the world for new episodes, for example place robots or draw their parameters."""

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Start new episodes after the world has reset the robots."""

    def before_step(self, state: EnvState) -> None:
        """Act on the world before a control step."""

    def measure(self, state: EnvState) -> None:
        """Compute inputs of reward terms, after the physics step."""

    def after_step(self, state: EnvState) -> None:
        """Prepare the next control step, after `state.reward` was computed."""

    def privileged(self, state: EnvState) -> Privileged:
        """Return the component's privileged observations for the critic."""
        return []

    def info(self, state: EnvState) -> Mapping[str, Any]:
        """Return the component's entries of the step's `info`."""
        return {}

    def metrics(self) -> Mapping[str, Any]:
        """Return metrics of the batch for the training log, by name."""
        return {}

    def publish(self, state: EnvState) -> None:
        """Write the component's outputs to the state, after `set_state`."""


class RobotComponent(Component):
    """Component that a robot's control computer also runs, so its hooks receive a `RobotState`."""

    def reset(self, rows: NDArray[np.int64], state: RobotState) -> None:
        """Start new episodes of robots."""

    def after_step(self, state: RobotState) -> None:
        """Prepare the next control step."""

    def publish(self, state: RobotState) -> None:
        """Write the component's outputs to the state."""
