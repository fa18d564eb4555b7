"""Gymnasium environments of the released tasks, single and vectorized, with the simulation already connected.

    import gymnasium
    import surefoot.envs

    env = gymnasium.make("surefoot/Gallop-v0", render_mode="rgb_array")
    envs = gymnasium.make_vec("surefoot/Gallop-v0", num_envs=64)

`gymnasium.make("surefoot.envs:surefoot/Gallop-v0")` works without the second import.
"""

from __future__ import annotations

from dataclasses import replace

import gymnasium

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig, load_task, preset_names
from surefoot.task.env import Camera, LocomotionEnv
from surefoot.task.single_env import LocomotionSingleEnv
from surefoot.world.registry import check_randomized, find_world


def make_single(
    task: str | TaskConfig,
    seed: int | None = None,
    robot: str | None = None,
    world: str = "mujoco",
    render_mode: str | None = None,
) -> LocomotionSingleEnv:
    """Return the environment of a single robot on a task.

    Args:
        task: name of a task, path of a YAML file, or a configuration.
        seed: seed of the first episode; random by default.
        robot: name or folder of a robot; defaults to the task's.
        world: name of the world (simulator).
        render_mode: "rgb_array" lets `render` return images, drawn in software; None disables rendering.
    """
    config = _config(task, robot, world)
    return LocomotionSingleEnv(config, find_world(world), seed, _camera(config, render_mode))


def make_vector(
    task: str | TaskConfig,
    num_envs: int = 1,
    seed: int = 0,
    threads: int = 0,
    robot: str | None = None,
    world: str = "mujoco",
    render_mode: str | None = None,
) -> LocomotionEnv:
    """Return the vectorized environment of a task, simulated on all cores; for the arguments see `make_single`."""
    config, make_world = _config(task, robot, world), find_world(world)
    camera = _camera(config, render_mode)
    return LocomotionEnv(config, num_envs, make_world, seed, threads=threads, camera=camera, step_info=True)


def _config(task: str | TaskConfig, robot: str | None, world: str) -> TaskConfig:
    if isinstance(task, TaskConfig):
        config = task if robot is None else replace(task, robot=robot)
    else:
        config = load_task(task, robot)[0]
    check_randomized(world, config.randomize)
    return config


def _camera(task: TaskConfig, render_mode: str | None) -> Camera | None:
    if render_mode is None:
        return None
    if render_mode != "rgb_array":
        raise SurefootError(f"render_mode is {render_mode!r}; it must be 'rgb_array' or None")
    from surefoot.report.drawing.robot_camera import RobotCamera

    return RobotCamera(RobotDescription.load(task.robot))


IDS = [f"surefoot/{task.title().replace('-', '')}-v0" for task in preset_names()]
"""Registered ids, one per preset: `trot-robust` is registered as `surefoot/TrotRobust-v0`."""
for _task, _id in zip(preset_names(), IDS, strict=True):
    # `max_episode_steps` is not set because the task truncates episodes.
    gymnasium.register(
        _id, f"{__name__}:make_single", vector_entry_point=f"{__name__}:make_vector", kwargs={"task": _task}
    )
