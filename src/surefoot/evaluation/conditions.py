"""Conditions that policies are run under: what differs from the simulation that a policy was trained in."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.params import CONTROLLER
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
    """What differs from a policy's task; without any difference the robot is nominal, and nothing pushes it."""

    name: str = ""
    meaning: str = ""
    """The condition in words."""
    world: str = "mujoco"
    """Name of the world."""
    data_sheet: bool = False
    """Take the robot and the motors of the data sheet, as `data_sheet_task`."""
    actuator: Actuator | None = None
    """Actuator of the motors; defaults to the task's."""
    params_file: Path | None = None
    """File of a robot's parameters (.toml), or the name of one that ships with it, in place of the task's."""
    estimated_gains: bool = True
    """Take the file's servo gains also where an identification estimated them. A policy's contract states the gains of
    its training, and the robot gets these: a training on estimates would apply their error twice."""
    params: Mapping[str, ParamValue] = field(default_factory=dict)
    """Physical parameters by name, over those of task and file."""
    thermal_protection: bool = False
    """Switch off motors that overheat, also if the task does not."""
    randomize: Ranges = field(default_factory=dict)
    """Ranges of the parameters that every episode draws."""
    pushes: bool | PushConfig = False
    """Push the robot at random, as the task says, or as stated here."""
    push_force: tuple[float, float] | None = None
    """Least and greatest force of horizontal pushes [N]; the robot is pushed, if given."""
    commands: Path | None = None
    """File of commands (CSV: time, forward, sideways, yaw_rate [s, m/s, rad/s]), followed to its end, also where
    episodes of the task are shorter; defaults to drawn commands."""
    command_rows: tuple[tuple[float, float, float], ...] = ()
    """Commands [m/s, m/s, rad/s] that hold for a whole episode, a row an episode, in place of drawn ones."""
    terrain: str | None = "flat"
    """What robots stand on, see `TerrainConfig.ground`; the task's own terrain, if None."""
    duration: float | None = None
    """Length of an episode [s]; defaults to the number of control steps of the task."""
    same_duration: bool = False
    """Episodes last as long as in training [s], also with another control step: returns can be compared."""
    curricula: bool = False
    """Keep the curricula of the task's ranges and commands, which make a robot's first episodes easier.
    Comparisons, test worlds and the table of a training keep them, so that their numbers stay those published."""

    def simulate(self, task: TaskConfig) -> TaskConfig:
        """Return a task in this condition's simulator: robot, motors and physical parameters.

        Raises:
            SurefootError: an actuator that the task does not go with, or a file of parameters that does not fit the
                task's robot and control step.
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
            task: as the policy was trained.
            robot: the task's robot.

        Raises:
            SurefootError: as `simulate`, a value that the robot does not allow, no such terrain, or commands for a task
                that has none.
        """
        trained = task
        task = self.simulate(replace(task, thermal_protection=task.thermal_protection or self.thermal_protection))
        task.nominal(robot)  # refuses parameters that the robot does not allow
        commands = task.commands if self.curricula else replace(task.commands, ramp=0)
        if self.commands is not None:
            if not commands.enabled:
                raise SurefootError(f"--commands is given; task '{task.name}' has no commands to follow")
            commands = replace(commands, schedule=read_schedule(self.commands))
        if self.command_rows:
            commands = replace(commands, each=self.command_rows)
        pushes = self.pushes
        if not isinstance(pushes, PushConfig):
            pushes = task.pushes.for_evaluation(pushes, self.push_force)
        ramp = task.randomize_ramp if self.curricula else 0
        task = replace(task, randomize=self.randomize, randomize_ramp=ramp, pushes=pushes, commands=commands)
        if self.terrain is not None:
            task = on_terrain(task, self.terrain)
        if self.duration is not None or self.same_duration:
            return with_duration(task, robot, self.duration or episode_duration(trained))
        whole = with_duration(task, robot, schedule_duration(commands.schedule))
        return whole if whole.max_steps > task.max_steps else task


def undisturbed_task(task: TaskConfig) -> TaskConfig:
    """Return the task in the policy's own simulator, with its actuator and latencies; no randomization, no pushes."""
    return replace(task, randomize={}, pushes=replace(task.pushes, enabled=False))


def data_sheet_task(task: TaskConfig) -> TaskConfig:
    """Return the task on the robot of the data sheet, whatever it was trained with: a stand-in for reality.

    What the controller sets stays: control step and gains.
    """
    params = {name: value for name, value in task.params.items() if name in CONTROLLER}
    return replace(undisturbed_task(task), actuator="dc", params=params, params_source={})


def _apply_file(task: TaskConfig, path: Path, estimated_gains: bool) -> TaskConfig:
    """Return the task on the robot of a file of parameters.

    The file replaces all of the task's parameters, so that a policy that was trained on one identified robot does not
    run on a mixture of two. Only what the controller sets stays: the control step, and gains unless the file has them,
    as estimates only with `estimated_gains`.
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
    values = {name: value for name, value in file.values.items() if name not in CONTROLLER or name not in estimated}
    own = {name: task.params[name] for name in CONTROLLER if name in task.params and name not in values}
    return replace(task, params={**values, **own}, params_source=file.source)


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


def episode_duration(task: TaskConfig) -> float:
    """Return how long an episode of a task lasts in the nominal world [s]."""
    return task.max_steps * float(task.nominal(RobotDescription.load(task.robot)).control_step[0])
