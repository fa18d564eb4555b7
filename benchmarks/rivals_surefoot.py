"""Process of `rivals.py` that trains surefoot's policies and times its simulation; see `worker_process.serve`."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from processor_time import time_turn
from rivals_inputs import BLOCK, EVALUATION_SEED, random_actions, random_targets
from velocity_tracking import checkpoints
from worker_process import WorkerError, serve

from surefoot.arrays import Array
from surefoot.cli import robot as robot_command
from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import run_to_end
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.robot import RobotDescription
from surefoot.robot.archive import DATA_SHEET
from surefoot.robot.randomization import Ranges, load_ranges
from surefoot.task.env import LocomotionEnv
from surefoot.task.pushes import PushConfig
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

TASK = "steer"


def about(robots: list[str]) -> dict[str, str]:
    """Return the versions of this side; reject robots that do not exist."""
    import mujoco
    import torch

    import surefoot

    for name in robots:
        RobotDescription.load(name)
    return {"surefoot": surefoot.__version__, "mujoco": mujoco.__version__, "torch": torch.__version__}


def import_robot(model: str, folder: str, name: str) -> None:
    """Write the folder of a robot from its MJCF, as `surefoot robot new` does."""
    code = robot_command.main(["new", model, "--out", folder, "--name", name])
    if code not in (0, 3):  # 3: a check failed, which does not prevent a training
        raise WorkerError(f"{model}: surefoot robot new ended with exit code {code}; its messages are above")


def warm_up(robot: str, randomize: str) -> None:
    """Compile what a training needs, so that the first one finds it on the disk."""
    PpoLearner(replace(_config(robot, randomize, 0, 1), num_envs=8), SimWorld).update()


def train(
    robot: str,
    randomize: str,
    seed: int,
    threads: int,
    times: list[float],
    commands: list[tuple[float, float, float]],
    seconds: float,
    cases: dict[str, list[tuple[float, float, float]]],
    cases_at: list[float],
    folder: str,
) -> list[dict[str, Any]]:
    """Train, and write what the deterministic policy does at points of the training's clock; return one row per point.

    Args:
        robot: name or folder.
        randomize: table of ranges for randomization.
        seed: seed of the training.
        threads: threads of simulation and learning.
        times: wall times of training [s].
        commands: a command for each evaluated robot [m/s, m/s, rad/s].
        seconds: duration of a command [s].
        cases: commands of further evaluations by name: `randomized` is one of robots in the ranges of the training.
        cases_at: times at which policies are evaluated in these cases too [s].
        folder: where poses are written; see `command_following.command_errors`.
    """
    config, rows, previous = _config(robot, randomize, seed, threads), list[dict[str, Any]](), 0.0
    for spent, watch, learner in checkpoints(config, times):
        point: dict[str, Any] = {**watch.times(), "samples": learner.steps}
        wanted = {"nominal": commands}
        if any(previous < time <= spent for time in cases_at):
            wanted |= cases
        for case, own in wanted.items():
            path = Path(folder) / f"{case}-{len(rows)}.npz"
            write_poses(learner, own, seconds, config.task.randomize if case == "randomized" else {}, path)
            point[case] = str(path)
        rows.append(point)
        previous = spent
    return rows


def _config(robot: str, randomize: str, seed: int, threads: int) -> TrainConfig:
    """Return the configuration of `surefoot train steer --robot ROBOT --randomize TABLE --seed SEED`."""
    config = load_train_config(TASK, robot)
    task = replace(config.task, randomize=load_ranges(randomize, robot=config.task.robot))
    return replace(config, task=task, seed=seed, threads=threads, learning_threads=threads)


def write_poses(
    learner: PpoLearner, commands: list[tuple[float, float, float]], seconds: float, ranges: Ranges, path: Path
) -> None:
    """Write time (T + 1, N) [s], position (T + 1, N, 3) [m] and orientation (T + 1, N, 4) of robots with commands."""
    config = learner.config
    task = replace(
        config.task,
        commands=replace(config.task.commands, each=tuple(map(tuple, commands)), ramp=0),  # type: ignore[arg-type]
        pushes=PushConfig(enabled=False),
        randomize=ranges,
        physics_step=0.0,
        max_steps=1_000_000,
    )
    env = LocomotionEnv(task, len(commands), SimWorld, EVALUATION_SEED, autoreset=False, threads=config.threads)
    observation, _ = env.reset()
    steps = np.ceil(seconds / env.world.params.control_step - 1e-9).astype(np.int64)
    poses: dict[str, list[Array]] = {"time": [], "position": [], "quat": []}

    def record(*_: object) -> None:
        truth = env.state.truth
        for name, values in zip(
            poses, (env.state.readings.time, truth.base_position_world, truth.base_quat_world), strict=True
        ):
            poses[name].append(values.copy())

    record()
    run_to_end(learner.act, env, observation, steps, record=record)
    arrays = {name: np.array(values) for name, values in poses.items()}
    arrays["time"] -= arrays["time"][0]
    np.savez(path, **arrays)  # type: ignore[arg-type]


def turn(layer: str, robot: str, timestep: float, num_envs: int, threads: int, seconds: float) -> dict[str, Any]:
    """Time control steps of a layer (`world` or `env`) for some wall time; return its steps of physics and times.

    Args:
        layer: `world` or `env`.
        robot: name or folder.
        timestep: step of the physics [s].
        num_envs: number of robots.
        threads: threads of the simulation.
        seconds: wall time [s].
    """
    step, physics_steps = _layer(layer, robot, timestep, num_envs, threads)
    return time_turn(step, physics_steps, seconds)


@cache
def _layer(layer: str, robot: str, timestep: float, num_envs: int, threads: int) -> tuple[Callable[[int], object], int]:
    """Return a function that runs the k-th control step of all robots, and the steps of physics in it."""
    task = replace(load_train_config(TASK, _with_timestep(robot, timestep)).task, physics_step=0.0)
    env = LocomotionEnv(task, num_envs, SimWorld, 0, threads=threads)
    env.reset()
    physics_steps = num_envs * round(float(env.nominal.control_step[0]) / timestep)
    if layer == "env":
        actions = random_actions(*env.action_space.shape)

        def step(k: int) -> object:
            return env.step(actions[k % BLOCK])
    else:
        world = SimWorld(env.robot, num_envs, env.nominal, config=WorldConfig(threads=threads))
        targets = random_targets(world.resting_angles, num_envs)

        def step(k: int) -> object:
            return world.step(targets[k % BLOCK])

    step(0)
    return step, physics_steps


@cache
def _with_timestep(robot: str, timestep: float) -> str:
    """Return the folder of a copy of a robot with another step of the physics [s]; it lasts as long as the process."""
    folder = Path(tempfile.mkdtemp(dir=_copies().name)) / "robot"
    shutil.copytree(RobotDescription.find_folder(robot), folder)
    sheet = folder / DATA_SHEET
    text, found = re.subn("(?m)^servo_step = .*", f"servo_step = {timestep:g}", sheet.read_text(encoding="utf-8"))
    if found != 1:
        raise WorkerError(f"{robot}: its {DATA_SHEET} has {found} lines with servo_step; there must be one")
    sheet.write_text(text, encoding="utf-8")
    return str(folder)


@cache
def _copies() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="rivals-")


def _answering(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function whose one-line errors are errors of the request."""

    def call(**arguments: Any) -> Any:
        try:
            return function(**arguments)
        except SurefootError as error:
            raise WorkerError(str(error)) from error

    return call


if __name__ == "__main__":
    serve({one.__name__: _answering(one) for one in (about, import_robot, warm_up, train, turn)})
