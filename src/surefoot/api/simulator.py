"""The task that a run simulates: a policy's own in another simulator, with other parameters, pushes and commands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.params import CONTROLLER
from surefoot.robot.params_file import ParamValue, find_params, read_params
from surefoot.robot.randomization import Ranges
from surefoot.task.commands import read_schedule, schedule_duration
from surefoot.task.config import TaskConfig
from surefoot.task.terrain import TerrainConfig
from surefoot.world.interface import WorldConfig
from surefoot.world.terrain import is_map


def change_simulator(
    task: TaskConfig,
    actuator: Literal["dc", "constraint"] | None = None,
    file: Path | None = None,
    settings: Mapping[str, ParamValue] | None = None,
) -> TaskConfig:
    """Return a task in another simulator.

    Args:
        task: the task.
        actuator: of the motors; the task's, if None.
        file: parameters of a robot (.toml), or the name of those that ship with it, in place of the task's.
        settings: physical parameters by name, over those of task and file.

    Raises:
        SurefootError: an actuator that the task does not go with, or a file of parameters that does not fit the task's
            robot and control step.
    """
    if file is not None:
        task = _apply_file(task, file)
    task = replace(task, actuator=actuator or task.actuator, params={**task.params, **(settings or {})})
    WorldConfig(actuator=task.actuator, thermal_protection=task.thermal_protection)  # checked early
    return task


def _apply_file(task: TaskConfig, path: Path) -> TaskConfig:
    """Return the task on the robot of a file of parameters.

    The file replaces all of the task's parameters, so that a policy that was trained on one identified robot does not
    run on a mixture of two. Only what the controller sets stays: the control step, and gains unless the file has them.
    """
    robot = RobotDescription.load(task.robot)
    path = find_params(path, robot)
    file, expected = read_params(path, robot), float(task.nominal(robot).control_step[0])
    step = float(file.params.control_step[0])
    if "control_step" in file.names and not math.isclose(step, expected, rel_tol=1e-9):
        raise SurefootError(
            f"{path}: control_step is {step:g}, and the task's is {expected:g}; "
            "it belongs to the policy, not to the robot: leave it out of the file"
        )
    own = {name: task.params[name] for name in CONTROLLER if name in task.params and name not in file.names}
    return replace(task, params={**file.values, **own}, params_source=file.source)


def evaluation_task(
    task: TaskConfig,
    robot: RobotDescription,
    ranges: Ranges,
    pushes: bool = False,
    push_force: tuple[float, float] | None = None,
    commands: Path | None = None,
    terrain: str = "flat",
) -> TaskConfig:
    """Return a task as evaluations run it: randomized, pushed and commanded as requested, not as in training.

    A file of commands is followed to its end, also where episodes of the task are shorter.

    Args:
        task: as the policy was trained, in the simulator to run it in.
        robot: the task's robot.
        ranges: ranges of the parameters that every episode draws.
        pushes: push the robot at random, as the task says.
        push_force: least and greatest force [N]; the robot is pushed, if given.
        commands: file of commands (CSV: time, forward, sideways, yaw_rate [s, m/s, rad/s]); drawn ones, if None.
        terrain: what robots stand on, see `TerrainConfig.ground`.

    Raises:
        SurefootError: a value that the robot does not allow, or commands of a task that has none.
    """
    task.nominal(robot)  # refuses parameters that the robot does not allow
    followed = replace(task.commands, ramp=0)
    if commands is not None:
        if not task.commands.enabled:
            raise SurefootError(f"--commands is given; task '{task.name}' has no commands to follow")
        followed = replace(followed, schedule=read_schedule(commands))
    pushed = task.pushes.for_evaluation(pushes, push_force)
    task = replace(task, randomize=ranges, randomize_ramp=0, pushes=pushed, commands=followed)
    task = on_terrain(task, terrain)
    whole = with_duration(task, robot, schedule_duration(followed.schedule))
    return whole if whole.max_steps > task.max_steps else task


def on_terrain(task: TaskConfig, terrain: str) -> TaskConfig:
    """Return the task on one terrain for all robots, see `TerrainConfig.ground`.

    Robots that follow commands are turned in every direction at their start, so that they meet different places; on
    a map they head along x.

    Raises:
        SurefootError: no such terrain, or a map that no robot can stand on.
    """
    ground = str(Path(terrain).resolve()) if is_map(terrain) else terrain
    every = task.commands.enabled and terrain != "flat" and not is_map(terrain)
    changed = TerrainConfig(ground=ground, heading=180.0 if every else 0.0, scan=task.terrain.scan)
    changed.build(0)  # refuses one that does not exist
    return replace(task, terrain=changed)


def with_duration(task: TaskConfig, robot: RobotDescription, duration: float) -> TaskConfig:
    """Return the task with episodes of a duration [s]."""
    steps = round(duration / float(task.nominal(robot).control_step[0]))
    return replace(task, max_steps=max(steps, 1))
