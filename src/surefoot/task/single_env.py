"""One robot on one task, as a Gymnasium environment; and the batch inside environments of other packages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.errors import SurefootError
from surefoot.task.config import TaskConfig
from surefoot.task.env import Camera, LocomotionEnv
from surefoot.world.interface import SimulationFactory


class LocomotionSingleEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One robot on one task, for learners without support of vector environments: a batch of one.

    Observations (O,), actions (A,), rewards and arguments are `LocomotionEnv`'s; without a seed any is taken. `info`
    describes every step, with what a batch has in arrays; at the end of an episode it holds its `figures`.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self, task: TaskConfig, make_world: SimulationFactory, seed: int | None = None, camera: Camera | None = None
    ) -> None:
        first = int(self.np_random.integers(2**31)) if seed is None else seed
        self.batch = LocomotionEnv(
            task, 1, make_world, first, autoreset=False, threads=1, camera=camera, step_info=True
        )
        self.render_mode = self.batch.render_mode
        self.metadata = {**self.metadata, "render_fps": self.batch.metadata["render_fps"]}
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
        # The figures are not under the key `episode`, which belongs to Gymnasium's own wrapper.
        single: dict[str, Any] = _first({name: part for name, part in info.items() if not name.startswith("_")})
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), single

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override, unused-ignore]
        """Return a picture (height, width, 3); None without a camera."""
        pictures = self.batch.render()
        return None if pictures is None else pictures[0]


def _first(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a batch's information says of its first robot: arrays of a row, numbers and flags."""
    return {
        name: _first(part) if isinstance(part, Mapping) else part[0] if part.ndim > 1 else part[0].item()
        for name, part in info.items()
    }


def find_batch(env: Any) -> LocomotionEnv:
    """Return the batch of robots inside an environment: of Gymnasium or Stable-Baselines3, wrapped or not.

    Raises:
        SurefootError: an environment of another package, or one in another process.
    """
    inner = env
    while inner is not None and not isinstance(inner, LocomotionEnv):
        if isinstance(inner, LocomotionSingleEnv):
            inner = inner.batch
        elif isinstance(several := getattr(inner, "envs", None), list | tuple):
            inner = several[0]
        else:
            inner = next((part for name in ("venv", "env") if (part := getattr(inner, name, None)) is not None), None)
    if inner is None:
        raise SurefootError(f"env is a {type(env).__name__}; it must be an environment of surefoot, in this process")
    return inner
