"""Evaluation conditions: differences from the simulation in which a policy was trained."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.params import CONTROLLER_PARAMETERS
from surefoot.robot.params_file import ParamValue, find_params, read_params
from surefoot.robot.randomization import Ranges
from surefoot.task.commands import read_schedule, schedule_duration
from surefoot.task.config import TaskConfig
from surefoot.task.pushes import PushConfig
from surefoot.task.terrain import TerrainConfig
from surefoot.world.interface import WorldConfig
from surefoot.world.terrain import is_map

Actuator = Literal["dc", "constraint"]


@dataclass(frozen=True)
class Condition:
    """Changes to a policy's task for an evaluation. By default the robot is nominal and is not pushed."""

    name: str = ""
    meaning: str = ""
    """Description for tables and pages."""
    world: str = "mujoco"
    """Name of the world."""
    data_sheet: bool = False
    """Use the robot and motors of the data sheet, see `data_sheet_task`."""
    actuator: Actuator | None = None
    """Actuator of the motors; defaults to the task's."""
    params_file: Path | None = None
    """File of a robot's physical parameters (.toml), or the name of one that ships with the robot. Defaults to the
    task's parameters."""
    estimated_gains: bool = True
    """Use the file's servo gains even if an identification estimated them. Trainings do not: the robot receives the
    gains that the policy's contract states, so a training on estimated gains would apply their error twice."""
    params: Mapping[str, ParamValue] = field(default_factory=dict)
    """Physical parameters by name; they override the task's and the file's."""
    thermal_protection: bool = False
    """Switch off motors that overheat, even if the task does not."""
    randomize: Ranges = field(default_factory=dict)
    """Ranges from which every episode draws its physical parameters."""
    pushes: bool | PushConfig = False
    """Random pushes: True for the task's, or their settings."""
    push_force: tuple[float, float] | None = None
    """Minimum and maximum force of horizontal pushes [N]; setting it switches pushes on."""
    commands: Path | None = None
    """File of commands (CSV: time, forward, sideways, yaw_rate [s, m/s, rad/s]). Episodes are lengthened to its end if
    the task's are shorter. Defaults to random commands."""
    command_rows: tuple[tuple[float, float, float], ...] = ()
    """Constant commands [m/s, m/s, rad/s], one row per episode, instead of random ones."""
    terrain: str | None = "flat"
    """Terrain, see `TerrainConfig.ground`; None for the task's own."""
    duration: float | None = None
    """Length of an episode [s]. Defaults to the task's number of control steps."""
    same_duration: bool = False
    """Keep the training's episode length [s] even if the control step differs, so that returns can be compared."""
    curricula: bool = False
    """Keep the curricula of the task's ranges and commands, which make a robot's first episodes easier. Comparisons,
    test worlds and a training's table keep them, so that their numbers match the published ones."""

    def simulate(self, task: TaskConfig) -> TaskConfig:
        """Return a task with this condition's robot, motors and physical parameters.

        Raises:
            SurefootError: the task does not support the actuator, or the parameter file does not fit the task's robot
                and control step.
        """
        if self.data_sheet:
            task = data_sheet_task(task)
        if self.params_file is not None:
            task = _apply_file(task, self.params_file, self.estimated_gains)
        task = replace(task, actuator=self.actuator or task.actuator, params={**task.params, **self.params})
        WorldConfig(actuator=task.actuator, thermal_protection=task.thermal_protection)  # checked early
        return task

    def apply(self, task: TaskConfig, robot: RobotDescription) -> TaskConfig:
        """Return a policy's task under this condition.

        Args:
            task: the task of the training.
            robot: the task's robot.

        Raises:
            SurefootError: see `simulate`; the robot does not allow a value, the terrain does not exist, or commands are
                given and the task has none.
        """
        trained = task
        task = self.simulate(replace(task, thermal_protection=task.thermal_protection or self.thermal_protection))
        task.nominal(robot)  # raises for parameters that the robot does not allow
        commands = task.commands if self.curricula else replace(task.commands, ramp=0)
        if self.commands is not None:
            if not commands.enabled:
                raise SurefootError(f"--commands is given; task '{task.name}' has no commands to follow")
            commands = replace(commands, schedule=read_schedule(self.commands), each=())
        if self.command_rows:
            commands = replace(commands, each=self.command_rows, schedule=())
        pushes = self.pushes
        if not isinstance(pushes, PushConfig):
            pushes = task.pushes.for_evaluation(pushes, self.push_force)
        ramp = task.randomize_ramp if self.curricula else 0
        task = replace(
            task, randomize=self.randomize, randomize_ramp=ramp, pushes=pushes, commands=commands, physics_step=0.0
        )  # the data sheet's
        if self.terrain is not None:
            task = on_terrain(task, self.terrain)
        if self.duration is not None or self.same_duration:
            return with_duration(task, robot, episode_duration(trained) if self.duration is None else self.duration)
        lengthened = with_duration(task, robot, schedule_duration(commands.schedule))
        return lengthened if lengthened.max_steps > task.max_steps else task


def undisturbed_task(task: TaskConfig) -> TaskConfig:
    """Return the task without randomization, pushes and curricula, with its own actuator, latencies and parameters."""
    pushes, commands = replace(task.pushes, enabled=False), replace(task.commands, ramp=0)
    return replace(task, randomize={}, randomize_ramp=0, pushes=pushes, commands=commands)


def data_sheet_task(task: TaskConfig) -> TaskConfig:
    """Return the task on the robot as its data sheet describes it, whatever robot and motors the training had.

    Such a robot stands in for reality. Control step and gains, which the controller sets, are kept.
    """
    params = {name: value for name, value in task.params.items() if name in CONTROLLER_PARAMETERS}
    return replace(undisturbed_task(task), actuator="dc", params=params, params_source={})


def _apply_file(task: TaskConfig, path: Path, estimated_gains: bool) -> TaskConfig:
    """Return the task on the robot that a parameter file describes.

    The file replaces all of the task's parameters, so that a policy that was trained on one identified robot does not
    run on a mixture of two. Only the controller's parameters are kept: the control step, and the gains unless the file
    states them (estimated gains count only with `estimated_gains`).
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
    estimated = () if estimated_gains else file.tables.get("identified_by", ())
    values = {
        name: value for name, value in file.values.items() if name not in CONTROLLER_PARAMETERS or name not in estimated
    }
    own = {name: task.params[name] for name in CONTROLLER_PARAMETERS if name in task.params and name not in values}
    return replace(task, params={**values, **own}, params_source=file.source)


def on_terrain(task: TaskConfig, terrain: str) -> TaskConfig:
    """Return the task with the same terrain for all robots, see `TerrainConfig.ground`.

    Robots that follow commands start with random headings, so that they cross different parts of the terrain; on a map
    they head along x.

    Raises:
        SurefootError: no such terrain, or no robot can stand on the map.
    """
    ground = str(Path(terrain).resolve()) if is_map(terrain) else terrain
    every = task.commands.enabled and terrain != "flat" and not is_map(terrain)
    changed = TerrainConfig(ground=ground, heading=180.0 if every else 0.0, scan=task.terrain.scan)
    changed.build(0)  # raises if the terrain does not exist
    return replace(task, terrain=changed)


def with_duration(task: TaskConfig, robot: RobotDescription, duration: float) -> TaskConfig:
    """Return the task with another episode length [s]."""
    steps = round(duration / float(task.nominal(robot).control_step[0]))
    return replace(task, max_steps=max(steps, 1))


def episode_duration(task: TaskConfig) -> float:
    """Return the length of a task's episodes with nominal parameters [s]."""
    return task.max_steps * float(task.nominal(RobotDescription.load(task.robot)).control_step[0])
