"""Domain randomization: random physical parameters for every episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.robot.randomization import Randomizer
from surefoot.task.component import Component, Privileged
from surefoot.task.state import EnvState


class RandomizedParams(Component):
    """Component that draws the physical parameters of each episode.

    Args:
        randomizer: distribution of the parameters.
    """

    def __init__(self, randomizer: Randomizer) -> None:
        self.randomizer = randomizer

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays of the randomizer that an exact resume needs, by name."""
        return {f"randomizer_{name}": getattr(self.randomizer, name) for name in self.randomizer.arrays}

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Random streams, one per robot."""
        return {"randomize_streams": self.randomizer.streams}

    def before_reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Draw the parameters of new episodes."""
        state.world.set_params(rows, self.randomizer.draw(rows))

    def privileged(self, state: EnvState) -> Privileged:
        """Return the randomized parameters, scaled to -1 to 1 over their ranges."""
        return [(self.randomizer.columns, self.randomizer.normalize(state.world.params))]
