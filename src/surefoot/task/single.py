"""`LocomotionSingleEnv`: one robot that learns a gait, as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.world.interface import SimulationFactory


class LocomotionSingleEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One robot on one task, for learners without support of vector environments: a batch of one.

    Observations (O,), actions (2 L,) and rewards are `LocomotionEnv`'s. At the end of an episode `info` holds
    its `figures`.

    Args:
        task: its configuration.
        make_world: makes the simulation.
        seed: seeds every stream of random numbers; any, if not given.

    Raises:
        SurefootError: a task that does not fit its robot.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, task: TaskConfig, make_world: SimulationFactory, seed: int | None = None) -> None:
        first = int(self.np_random.integers(2**31)) if seed is None else seed
        self.batch = LocomotionEnv(task, 1, make_world, first, autoreset=False, threads=1)
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; with a seed, every stream of random numbers too."""
        super().reset(seed=seed)
        observation, _ = self.batch.reset(seed=seed)
        return observation[0], {}

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Run one control step."""
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        single: dict[str, Any] = {}
        if "diverged" in info:
            single["diverged"] = True
        # Not under the key `episode`, which belongs to Gymnasium's own wrapper.
        if "figures" in info:
            single["figures"] = {name: float(values[0]) for name, values in info["figures"].items()}
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), single
