"""Single-robot Gymnasium environment, and access to the batch inside wrapped environments."""

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

_CHANGING = (
    *(gymnasium.ObservationWrapper, gymnasium.ActionWrapper),
    *(gymnasium.vector.VectorObservationWrapper, gymnasium.vector.VectorActionWrapper),
)
"""Wrappers that change observations or actions."""
_UNCHANGED = (gymnasium.wrappers.ClipAction, gymnasium.wrappers.FlattenObservation)
"""Those that leave surefoot's as they are: the environment clips actions itself, and observations are flat."""


class LocomotionSingleEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Gymnasium environment with one robot, for learning libraries without support for vector environments.

    It wraps a `LocomotionEnv` with one robot and has the same observations (O,), actions (A,), rewards and arguments.
    Without a seed, a random one is used. `info` describes every step (see `StepInfo`), with scalars instead of arrays.
    At the end of an episode it contains its metrics (`figures`).
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
        """Start an episode; a seed also restarts all random streams."""
        super().reset(seed=seed)
        observation, _ = self.batch.reset(seed=seed)
        return observation[0], {}

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Apply an action (A,) for one control step; return observation, reward, terminated, truncated and info."""
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        # Metrics of the episode do not use the key `episode`, which belongs to Gymnasium's RecordEpisodeStatistics.
        single: dict[str, Any] = _first({name: part for name, part in info.items() if not name.startswith("_")})
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), single

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override, unused-ignore]
        """Return an image (height, width, 3), or None without a camera."""
        images = self.batch.render()
        return None if images is None else images[0]


def _first(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a batch's `info` for its first robot."""
    return {
        name: _first(part) if isinstance(part, Mapping) else part[0] if part.ndim > 1 else part[0].item()
        for name, part in info.items()
    }


def find_batch(env: Any) -> LocomotionEnv:
    """Return the `LocomotionEnv` inside an environment of Gymnasium or Stable-Baselines3, which may be wrapped.

    Raises:
        SurefootError: an environment of another package, one in another process, or a wrapper of Gymnasium that changes
            observations or actions, which a policy file does not contain.
    """
    inner = env
    while inner is not None and not isinstance(inner, LocomotionEnv):
        if isinstance(inner, _CHANGING) and not isinstance(inner, _UNCHANGED):
            raise SurefootError(
                f"env has the wrapper {type(inner).__name__}, which changes observations or actions and would be lost; "
                "train without it, or export a torch module that contains it"
            )
        if isinstance(inner, LocomotionSingleEnv):
            inner = inner.batch
        elif isinstance(several := getattr(inner, "envs", None), list | tuple):
            inner = several[0]
        else:
            inner = next((part for name in ("venv", "env") if (part := getattr(inner, name, None)) is not None), None)
    if inner is None:
        raise SurefootError(f"env is a {type(env).__name__}; it must be an environment of surefoot, in this process")
    return inner
