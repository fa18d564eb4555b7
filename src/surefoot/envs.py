"""The tasks as Gymnasium environments, with the simulation wired in.

    import gymnasium
    import surefoot.envs

    env = gymnasium.make("surefoot/Gallop-v0")
    envs = gymnasium.make_vec("surefoot/Gallop-v0", num_envs=64)

Without the second import, `gymnasium.make("surefoot.envs:surefoot/Gallop-v0")` does the same.
"""

from __future__ import annotations

import gymnasium

from surefoot.task.config import TaskConfig, load_task, preset_names
from surefoot.task.env import LocomotionEnv, LocomotionSingleEnv
from surefoot.world.sim_world import SimWorld


def make_single(task: str | TaskConfig, seed: int | None = None) -> LocomotionSingleEnv:
    """Return one robot on a task, given by preset name, path of a YAML file, or configuration."""
    return LocomotionSingleEnv(_config(task), SimWorld, seed)


def make_vector(task: str | TaskConfig, num_envs: int = 1, seed: int = 0, threads: int = 0) -> LocomotionEnv:
    """Return a batch of robots on a task, given by preset name, path of a YAML file, or configuration."""
    return LocomotionEnv(_config(task), num_envs, SimWorld, seed, threads=threads)


def _config(task: str | TaskConfig) -> TaskConfig:
    return task if isinstance(task, TaskConfig) else load_task(task)[0]


IDS = [f"surefoot/{task.title().replace('-', '')}-v0" for task in preset_names()]
"""Ids that are registered, one a preset: that of `trot-robust` is `surefoot/TrotRobust-v0`."""
for _task, _id in zip(preset_names(), IDS, strict=True):
    # No `max_episode_steps`: the task itself truncates episodes.
    gymnasium.register(
        _id, f"{__name__}:make_single", vector_entry_point=f"{__name__}:make_vector", kwargs={"task": _task}
    )
