"""The functions of `import surefoot`. They call what the commands of the same names call."""

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
"""Physical parameters by name, or a file of a robot's (.toml, or the name of one that ships with it)."""


@report_missing_extras
def robots(*folders: str | Path) -> dict[str, RobotDescription]:
    """Return descriptions of robots by name: those that ship, and those of own folders.

    Raises:
        SurefootError: a folder without a valid description.
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
    """Train a policy, as `surefoot train` does, with a progress display.

    The run folder is printed first. Ctrl-C, or an interrupt of a notebook's kernel, stops after the present update with
    a `KeyboardInterrupt`: the folder holds the newest policy then, and `surefoot train --resume` goes on.

    Args:
        task: name of a task, such as "trot", or a YAML file.
        robot: name of a robot that ships, or an own robot's folder; the task's, if None.
        steps: control steps of all robots together; the task's, if None.
        seed: the one seed of the run; the task's, if None. The same seed gives the same policy.
        world: name of the world, such as "mujoco" or "bullet"; the task's, if None.
        settings: further settings as a task's file nests them, over the task's own, for example
            `{"num_envs": 64, "ppo": {"gamma": 0.98}, "task": {"reward": {"energy": -0.004}}}`.
        runs: folder for run folders.
        figures: evaluate the policy at the end, and write a table, figures and a video to the run folder.

    Raises:
        SurefootError: a task, robot or setting that does not exist or does not fit.
    """
    if figures:
        _require_drawing()
    from rich.console import Console

    from surefoot.api.training import check_config, run_training, symmetry_note
    from surefoot.configuration import from_mapping
    from surefoot.learn.config import TrainConfig, load_train_config
    from surefoot.learn.run_folder import RunFolder
    from surefoot.robot.randomization import resolve_table

    base = load_train_config(str(task), None if robot is None else str(robot))
    chosen = {name: value for name, value in (("steps", steps), ("seed", seed), ("world", world)) if value is not None}
    data = {**(settings or {}), **chosen}
    if isinstance(changes := data.get("task"), Mapping):
        changes = resolve_table(dict(changes), robot=base.task.robot)
        for name in ("reward", "reward_limits", "params"):  # as a task's file over its base
            if isinstance(table := changes.get(name), Mapping):
                changes[name] = {**getattr(base.task, name), **table}
        data["task"] = changes
    config = from_mapping(TrainConfig, data, base=base)
    check_config(config)
    console = Console(highlight=False, soft_wrap=True, markup=False)
    if (note := symmetry_note(config)) is not None:
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
    """Run a policy in simulation and measure it, as `surefoot evaluate` does.

    Args:
        policy: as `load` takes it.
        episodes: how many; they run side by side.
        world: name of the world: one of `surefoot.world.registry.WORLDS`.
        seed: seed of the episodes.
        robot: another robot than the policy's own.
        duration: of an episode [s]; the task's, if None.
        params: physical parameters that differ from the policy's, such as `{"motor_strength": 0.8}`.
        randomize: ranges that every episode draws its parameters from: a name such as "table1", a YAML file, or ranges
            by name such as `{"control_latency": (0.01, 0.03)}`; nothing is drawn, if None.
        pushes: push the robot at random, as its task says.
        push_force: least and greatest force of pushes [N].
        commands: file of commands to follow (CSV: time, forward, sideways, yaw_rate [s, m/s, rad/s]).
        terrain: what the robot stands on, such as "stairs:0.10", or a map of heights (.npz, .png).
        threads: threads of the simulation; 0: one a core.

    Raises:
        SurefootError: a policy, world or value that does not exist or is not allowed.
    """
    from surefoot.api.evaluation import run_evaluation
    from surefoot.world.registry import find_world

    find_world(world)
    loaded = load(policy, robot=robot)
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
    """Run a policy once and make a video of it, which a notebook plays.

    Args:
        policy: as `load` takes it.
        out: MP4 to write; if None, POLICY.mp4 here, or in a notebook a temporary file.
        duration: how long the robot runs [s].
        world: name of the world.
        seed: seed of the episode.
        robot: another robot than the policy's own.
        params: physical parameters that differ from the policy's.
        pushes: push the robot at random, as its task says.
        commands: file of commands to follow.
        terrain: what the robot stands on, as in `evaluate`.

    Raises:
        SurefootError: as `evaluate`, or a file of another ending than .mp4.
    """
    _require_drawing()
    from surefoot.api.episodes import film
    from surefoot.api.policies import run_policy
    from surefoot.world.registry import find_world

    find_world(world)
    loaded = load(policy, robot=robot)
    folder = Path(tempfile.mkdtemp(prefix="surefoot-")) if out is None and in_notebook() else Path()
    path = folder / f"{loaded.name}.mp4" if out is None else Path(out)
    if path.suffix.lower() != ".mp4":
        raise SurefootError(f"video {path}: the name must end in .mp4")
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
    """Serve a page in the background, on which the robot is steered, pushed and changed; a notebook shows it.

    Args:
        policy: as `load` takes it.
        world: name of the world.
        robot: another robot than the policy's own.
        terrain: what the robot stands on, as in `evaluate`; the page has a choice.
        host: address to listen at for other machines; this machine only, if None.
        port: TCP port; 0: a free one.

    Raises:
        SurefootError: as `load`, a world that does not exist, or a port that is taken.
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
    """Write a policy of another learner as a policy file, complete for `evaluate`, `drive` and `surefoot deploy`.

    The file's actions are compared with the model's before it is written.

    Args:
        model: a torch module that takes raw observations (N, O * history) in SI units and gives (N, A); or a model of
            Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG), whose deterministic actions are written, with the statistics
            of its `VecNormalize`, if it has one.
        path: .onnx to write.
        env: environment that the model was trained on, one robot or a batch, wrapped or not; the model's own, if None.
        name: of the policy; the task's, if None.
        output: what a module gives: "action", -1 to 1 between the feedback's bounds, as the environment takes them;
            or "feedback" itself, in leg space (rad; extension of serial legs in lengths of the straight leg).

    Raises:
        SurefootError: an environment of another package, a module that does not fit it, or an operator that policy
            files can't hold.
    """
    from torch import nn

    from surefoot.policy.export import export_policy
    from surefoot.task.contract_mapping import make_contract
    from surefoot.task.single_env import find_batch

    network = model
    if not isinstance(model, nn.Module):
        from surefoot.learn.sb3 import Actor

        network, env = Actor(model), model.get_env() if env is None else env
    if env is None:
        raise SurefootError("no env is given; give the environment that the module was trained on")
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
    """Return what a policy is run under; `changes` are further fields of `Condition`."""
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
    """Import what draws, so that a missing package is reported before anything is simulated."""
    for module in ("matplotlib", "imageio_ffmpeg", "PIL"):
        import_module(module)


def in_notebook() -> bool:
    """Return whether this runs in the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and hasattr(shell, "kernel")
