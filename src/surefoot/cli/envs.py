"""The tasks as Gymnasium environments, with the simulation wired in.

    import gymnasium
    import surefoot.cli.envs

    env = gymnasium.make("surefoot/Gallop-v0")
    envs = gymnasium.make_vec("surefoot/Gallop-v0", num_envs=64)

Without the second import, `gymnasium.make("surefoot.cli.envs:surefoot/Gallop-v0")` does the same.
"""

from __future__ import annotations

from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.registration import register_envs
from surefoot.task.single import LocomotionSingleEnv
from surefoot.world.sim_world import SimWorld


def make_single(task: str | TaskConfig, seed: int | None = None) -> LocomotionSingleEnv:
    """Return one robot on a task, given by preset name, path of a YAML file, or configuration."""
    return LocomotionSingleEnv(_config(task), SimWorld, seed)


def make_vector(task: str | TaskConfig, num_envs: int = 1, seed: int = 0, threads: int = 0) -> LocomotionEnv:
    """Return a batch of robots on a task, given by preset name, path of a YAML file, or configuration."""
    return LocomotionEnv(_config(task), num_envs, SimWorld, seed, threads=threads)


def _config(task: str | TaskConfig) -> TaskConfig:
    return task if isinstance(task, TaskConfig) else load_task(task)[0]


IDS = register_envs("surefoot.cli.envs:make_single", "surefoot.cli.envs:make_vector")
"""Ids that are registered."""
