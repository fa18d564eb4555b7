"""Options of commands that simulate: another simulator, robot, parameters, pushes and commands than the task's."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from surefoot.cli.helpers.options import PluginNames, Pushes, PushForce, RobotName, Seed, Settings, World
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription, parse_settings
from surefoot.robot.params_file import ParamValue, find_params, read_params
from surefoot.robot.randomization import Ranges
from surefoot.task.commands import read_schedule
from surefoot.task.config import TaskConfig
from surefoot.world.interface import WorldConfig


@dataclass(frozen=True)
class Simulator:
    """Differences from the task's simulator."""

    actuator: Literal["dc", "constraint"] | None = None
    """dc: servo and DC motor; constraint: the position motor of physics engines. The task's, if not given."""
    control_latency: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Age of what the policy sees [s]; the task's, if not given."""
    servo_latency: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Age of what the servos see [s]; the task's, if not given."""
    params: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of a robot's physical parameters (.toml), or the name of one that ships with it, in place of the task's.
    What it does not name is as on the data sheet; the control step stays."""

    @property
    def latencies(self) -> dict[str, float]:
        """Latencies that are given [s], by name."""
        names = ("control_latency", "servo_latency")
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def apply(self, task: TaskConfig, settings: Mapping[str, ParamValue] | None = None) -> TaskConfig:
        """Return the task in this simulator, with further physical parameters by name.

        Raises:
            SurefootError: a parameter given twice, an actuator that the task does not go with, or a file of parameters
                that does not fit the task's robot and control step.
        """
        settings = settings or {}
        if twice := sorted(set(settings) & set(self.latencies)):
            option = twice[0].replace("_", "-")
            raise SurefootError(f"{twice[0]} is given twice, by --{option} and as a parameter; give it once")
        if self.params is not None:
            task = _apply_file(task, self.params)
        params = {**task.params, **self.latencies, **settings}
        task = replace(task, actuator=self.actuator or task.actuator, params=params)
        WorldConfig(actuator=task.actuator, thermal_protection=task.thermal_protection)  # checked early
        return task


SimulatorOptions = Annotated[Simulator, tyro.conf.OmitArgPrefixes]
"""The options as a field of a command."""


def _apply_file(task: TaskConfig, path: Path) -> TaskConfig:
    """Return the task on the robot of a file of parameters.

    The file replaces all of the task's parameters, so that a policy that was trained on one identified robot does not
    run on a mixture of two. Only the control step stays: it belongs to the policy and to no robot.
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
    own = {name: value for name, value in task.params.items() if name == "control_step"}
    return replace(task, params={**file.values, **own}, params_source=file.source)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of commands that run one policy in one world."""

    pushes: Pushes = False
    push_force: PushForce = None
    """Push the robot with forces from LOW to HIGH [N] in horizontal directions, as often as its task says."""
    settings: Settings = ()
    """Physical parameters that differ from the task's, such as motor_strength=0.8."""
    plugin: PluginNames = ()
    seed: Seed = 1
    world: World = "mujoco"
    simulator: SimulatorOptions = Simulator()
    """Another simulator than the policy's own."""
    robot: RobotName = None
    commands: Path | None = None
    """What steers a policy with commands: a file (CSV: time, forward, sideways, yaw_rate [s, m/s, rad/s]); commands are
    drawn as in its training, if not given."""

    def apply(
        self, task: TaskConfig, robot: RobotDescription, ranges: Ranges | None = None, thermal_protection: bool = False
    ) -> TaskConfig:
        """Return a policy's task for this simulator: randomized and pushed only if options request it.

        Args:
            task: as the policy was trained.
            robot: the task's robot.
            ranges: ranges of the parameters that every episode draws.
            thermal_protection: switch off motors that overheat, also if the task does not.

        Raises:
            SurefootError: no such parameter, a value that the robot does not allow, or what does not go together.
        """
        settings = parse_settings([word for group in self.settings for word in group])
        task = replace(task, thermal_protection=task.thermal_protection or thermal_protection)
        task = self.simulator.apply(task, settings)
        task.nominal(robot)  # refuses parameters that the robot does not allow
        commands = replace(task.commands, ramp=0)
        if self.commands is not None:
            if not task.commands.enabled:
                raise SurefootError(f"--commands is given; task '{task.name}' has no commands to follow")
            commands = replace(commands, schedule=read_schedule(self.commands))
        pushes = task.pushes.for_evaluation(self.pushes, self.push_force)
        return replace(task, randomize=ranges or {}, pushes=pushes, commands=commands)


def with_duration(task: TaskConfig, robot: RobotDescription, duration: float) -> TaskConfig:
    """Return the task with episodes of a duration [s]."""
    steps = round(duration / float(task.nominal(robot).control_step[0]))
    return replace(task, max_steps=max(steps, 1))


def describe_simulator(task: TaskConfig) -> dict[str, Any]:
    """Return actuator and physical parameters of a task, as JSON holds them."""
    return {"actuator": task.actuator, "params": task.params, "params_source": task.params_source}
