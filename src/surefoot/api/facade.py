"""Functions of `import surefoot`, which share their implementation with the commands of the same names."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from surefoot.api.extras import report_missing_extras
from surefoot.api.results import Drive, Evaluation, Policy, Run, Video, load
from surefoot.errors import SurefootError

__all__ = ["drive", "evaluate", "export", "load", "play", "robots", "train"]

if TYPE_CHECKING:
    from surefoot.evaluation.conditions import Condition
    from surefoot.robot import RobotDescription

Parameters = Mapping[str, Any] | str | Path | None
"""Physical parameters by name, a parameter file (.toml), or the name of a file released with the robot."""


@report_missing_extras
def robots(*folders: str | Path) -> dict[str, RobotDescription]:
    """Return the descriptions of all released robots, and of robots in given folders, by name.

    Raises:
        SurefootError: a folder has no valid description.
    """
    from surefoot.robot import RobotDescription

    described = [RobotDescription.load(robot) for robot in (*RobotDescription.available(), *folders)]
    return {robot.name: robot for robot in described}


@report_missing_extras
def train(
    task: str | Path,
    *,
    robot: str | Path | None = None,
    steps: int | None = None,
    seed: int | None = None,
    world: str | None = None,
    settings: Mapping[str, Any] | None = None,
    runs: str | Path = "runs",
    figures: bool = True,
) -> Run:
    """Train a policy with a progress display, as `surefoot train` does.

    The run folder is printed first. Ctrl-C, or an interrupt of a notebook's kernel, stops after the present update with
    a `KeyboardInterrupt`; the folder then contains the newest policy, and `surefoot train --resume` continues.

    Args:
        task: name of a task, such as "trot", or path of a YAML file.
        robot: name of a released robot, or folder of a robot; defaults to the task's.
        steps: total control steps of all robots; defaults to the task's.
        seed: seed of all random numbers of the run; defaults to the task's. The same seed gives the same policy.
        world: name of the world, such as "mujoco" or "bullet"; defaults to the task's.
        settings: further settings that override the task's, nested as in a task file, for example
            `{"num_envs": 64, "ppo": {"gamma": 0.98}, "task": {"reward": {"energy": -0.004}}}`.
        runs: parent folder of the run folder.
        figures: evaluate the policy after the training, and write a table, figures and a video to the run folder.

    Raises:
        SurefootError: a task, robot or setting does not exist or is not valid.
    """
    if figures:
        _require_drawing()
    from rich.console import Console

    from surefoot.api.training import check_config, run_training, training_notes
    from surefoot.configuration import from_mapping
    from surefoot.learn.config import TrainConfig, load_train_config
    from surefoot.learn.run_folder import RunFolder
    from surefoot.robot.randomization import resolve_table

    base = load_train_config(str(task), None if robot is None else str(robot))
    chosen = {name: value for name, value in (("steps", steps), ("seed", seed), ("world", world)) if value is not None}
    data = {**(settings or {}), **chosen}
    if isinstance(changes := data.get("task"), Mapping):
        changes = resolve_table(dict(changes), robot=base.task.robot)
        for name in ("reward", "reward_limits", "params"):  # merged as in a task file with a base
            if isinstance(table := changes.get(name), Mapping):
                changes[name] = {**getattr(base.task, name), **table}
        data["task"] = changes
    config = from_mapping(TrainConfig, data, base=base)
    check_config(config)
    console = Console(highlight=False, soft_wrap=True, markup=False)
    for note in training_notes(config):
        console.print(f"note: {note}")
    folder = RunFolder.create(config, Path(runs))
    summaries = run_training(folder, console, figures=figures)
    if summaries is None:
        raise KeyboardInterrupt
    return Run(folder.path, summaries)


@report_missing_extras
def evaluate(
    policy: str | Path | Run | Policy,
    *,
    episodes: int = 20,
    world: str = "mujoco",
    seed: int = 1,
    robot: str | Path | None = None,
    duration: float | None = None,
    params: Parameters = None,
    randomize: str | Path | Mapping[str, Any] | None = None,
    pushes: bool = False,
    push_force: tuple[float, float] | None = None,
    commands: str | Path | None = None,
    terrain: str | Path = "flat",
    threads: int = 0,
) -> Evaluation:
    """Run a policy in simulation and compute its metrics, as `surefoot evaluate` does.

    Args:
        policy: policy, run, name or path, see `load`.
        episodes: number of episodes, which run in parallel.
        world: name of the world, one of `surefoot.world.registry.WORLDS`.
        seed: seed of the episodes.
        robot: name or folder of the robot; defaults to the policy's.
        duration: duration of an episode [s]; defaults to the task's.
        params: physical parameters to change, such as `{"motor_strength": 0.8}`.
        randomize: ranges of parameters that are randomized in every episode: a name such as "table1", a YAML file, or
            ranges by name such as `{"control_latency": (0.01, 0.03)}`. By default nothing is randomized.
        pushes: push the robot at random times, as configured in its task.
        push_force: minimum and maximum force of pushes [N].
        commands: file of velocity commands (CSV: time [s], forward, sideways [m/s], yaw_rate [rad/s]).
        terrain: terrain such as "stairs:0.10", or a height map (.npz, .png).
        threads: threads of the simulation; 0: one per core.

    Raises:
        SurefootError: a policy, world or value does not exist or is not valid.
    """
    from surefoot.api.evaluation import check_arguments, run_evaluation
    from surefoot.world.registry import find_world

    find_world(world)
    loaded = load(policy, robot=robot)
    check_arguments(episodes=episodes, seed=seed, duration=duration, threads=threads)
    condition = _condition(
        loaded, params, duration, randomize, pushes=pushes, push_force=push_force, commands=commands, terrain=terrain
    )
    task = condition.apply(loaded.task, loaded.robot)
    return run_evaluation(replace(loaded, task=task), episodes, world, seed, threads)


@report_missing_extras
def play(
    policy: str | Path | Run | Policy,
    *,
    out: str | Path | None = None,
    duration: float = 6.0,
    world: str = "mujoco",
    seed: int = 1,
    robot: str | Path | None = None,
    params: Parameters = None,
    pushes: bool = False,
    commands: str | Path | None = None,
    terrain: str | Path = "flat",
) -> Video:
    """Run a policy once and record a video, which a notebook plays.

    Args:
        policy: policy, run, name or path, see `load`.
        out: video (.mp4) to write; defaults to POLICY.mp4, or a temporary file in a notebook.
        duration: duration of the run [s].
        world: name of the world.
        seed: seed of the episode.
        robot: name or folder of the robot; defaults to the policy's.
        params: physical parameters to change.
        pushes: push the robot at random times, as configured in its task.
        commands: file of velocity commands, see `evaluate`.
        terrain: terrain, see `evaluate`.

    Raises:
        SurefootError: see `evaluate`; or the name of the file does not end in .mp4.
    """
    _require_drawing()
    from surefoot.api.episodes import film
    from surefoot.api.evaluation import check_arguments
    from surefoot.api.policies import run_policy
    from surefoot.world.registry import find_world

    find_world(world)
    loaded = load(policy, robot=robot)
    folder = Path(tempfile.mkdtemp(prefix="surefoot-")) if out is None and in_notebook() else Path()
    path = folder / f"{loaded.name}.mp4" if out is None else Path(out)
    if path.suffix.lower() != ".mp4":
        raise SurefootError(f"video {path}: the name must end in .mp4")
    check_arguments(seed=seed, duration=duration)
    condition = _condition(loaded, params, duration, pushes=pushes, commands=commands, terrain=terrain)
    task = condition.apply(loaded.task, loaded.robot)
    (trace,) = run_policy(loaded.controller, task, 1, world, seed, name=loaded.name)
    return Video(film(loaded.robot, trace, path, task.terrain.build(seed).ground))


@report_missing_extras
def drive(
    policy: str | Path | Run | Policy,
    *,
    world: str = "mujoco",
    robot: str | Path | None = None,
    terrain: str | Path = "flat",
    host: str | None = None,
    port: int = 0,
) -> Drive:
    """Serve a page in the background to steer, push and modify the simulated robot; a notebook embeds it.

    Args:
        policy: policy, run, name or path, see `load`.
        world: name of the world.
        robot: name or folder of the robot; defaults to the policy's.
        terrain: initial terrain, see `evaluate`; it can be changed on the page.
        host: address at which other machines can open the page; by default only this machine can.
        port: TCP port; 0 selects a free one.

    Raises:
        SurefootError: see `load`; or the world does not exist, or the port is in use.
    """
    from surefoot.api.drive_page import DrivePage

    loaded = load(policy, robot=robot)
    name = policy if isinstance(policy, str) else str(loaded.path)
    return Drive(DrivePage(name, world, loaded.robot.location, terrain=str(terrain)), host, port)


@report_missing_extras
def export(
    model: Any,
    path: str | Path,
    *,
    env: Any = None,
    name: str | None = None,
    output: Literal["action", "feedback"] = "action",
) -> Policy:
    """Export a policy trained with another library to a policy file for `evaluate`, `drive` and `surefoot deploy`.

    Before the file is written, its actions are compared with the model's.

    Args:
        model: a torch module that maps raw observations (N, O * history) in SI units to outputs (N, A); or a model of
            Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG), whose deterministic actions are exported, including the
            statistics of `VecNormalize`.
        path: policy file (.onnx) to write.
        env: environment on which the model was trained, single or vectorized; defaults to the model's. Give it for a
            model that was loaded from a file. Wrappers must leave observations and actions as they are, except
            `VecNormalize`.
        name: name of the policy; defaults to the task's.
        output: output of a torch module: "action", normalized to -1 to 1 as the environment's action, or "feedback",
            in leg space (rad; the extension of serial legs in lengths of the straight leg).

    Raises:
        SurefootError: the environment is not surefoot's, or a wrapper changes observations or actions; the module does
            not match it, or an operator is not supported in policy files.
    """
    from torch import nn

    from surefoot.policy.export import export_policy
    from surefoot.task.contract_mapping import make_contract
    from surefoot.task.single_env import find_batch

    network = model
    if not isinstance(model, nn.Module):
        from surefoot.learn.sb3 import Actor

        network, env = Actor(model, env), model.get_env() if env is None else env
    if env is None:
        raise SurefootError("env is missing; give the environment on which the module was trained")
    batch = find_batch(env)
    contract = make_contract(batch, replace(batch.task, name=name or batch.task.name))
    return load(export_policy(network, contract, path, output, batch.robot.archive))


def _condition(
    policy: Policy,
    params: Parameters,
    duration: float | None,
    randomize: str | Path | Mapping[str, Any] | None = None,
    commands: str | Path | None = None,
    terrain: str | Path = "flat",
    **changes: Any,
) -> Condition:
    """Return the condition of a run; `changes` are further fields of `Condition`."""
    from surefoot.configuration import from_mapping
    from surefoot.evaluation.conditions import Condition
    from surefoot.robot.randomization import resolve_table
    from surefoot.task.config import TaskConfig

    table = {} if randomize is None else randomize if isinstance(randomize, Mapping) else str(randomize)
    data = resolve_table({"randomize": table}, robot=policy.task.robot)
    return Condition(
        params_file=Path(params) if isinstance(params, str | Path) else None,
        params=params if isinstance(params, Mapping) else {},
        randomize=from_mapping(TaskConfig, data, base=replace(policy.task, randomize={})).randomize,
        commands=None if commands is None else Path(commands),
        terrain=str(terrain),
        duration=duration,
        **changes,
    )


def _require_drawing() -> None:
    """Import the drawing packages, so that a missing one is reported before the simulation."""
    for module in ("matplotlib", "imageio_ffmpeg", "PIL"):
        import_module(module)


def in_notebook() -> bool:
    """Return whether the code runs in a notebook's kernel."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and hasattr(shell, "kernel")
