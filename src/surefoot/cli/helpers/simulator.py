"""Options of commands that simulate: another simulator, robot, parameters, pushes and commands than the task's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from surefoot.api.simulator import change_simulator, evaluation_task
from surefoot.cli.helpers.options import PluginNames, Pushes, PushForce, RobotName, Seed, Settings, Terrain, World
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription, parse_settings
from surefoot.robot.params_file import ParamValue
from surefoot.robot.randomization import Ranges
from surefoot.task.config import TaskConfig


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
        return change_simulator(task, self.actuator, self.params, {**self.latencies, **settings})


SimulatorOptions = Annotated[Simulator, tyro.conf.OmitArgPrefixes]
"""The options as a field of a command."""


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """Options of commands that simulate one policy in one world."""

    settings: Settings = ()
    """Physical parameters that differ from the task's, such as motor_strength=0.8."""
    plugin: PluginNames = ()
    world: World = "mujoco"
    simulator: SimulatorOptions = Simulator()
    """Another simulator than the policy's own."""
    robot: RobotName = None
    terrain: Terrain = "flat"

    def in_simulator(self, task: TaskConfig) -> TaskConfig:
        """Return a policy's task in this simulator.

        Raises:
            SurefootError: no such parameter, a value that the robot does not allow, or what does not go together.
        """
        return self.simulator.apply(task, parse_settings([word for group in self.settings for word in group]))


@dataclass(frozen=True, kw_only=True)
class RunOptions(SimulationOptions):
    """Options of commands that run episodes of one policy in one world."""

    pushes: Pushes = False
    push_force: PushForce = None
    """Push the robot with forces from LOW to HIGH [N] in horizontal directions, as often as its task says."""
    seed: Seed = 1
    commands: Path | None = None
    """What steers a policy with commands: a file (CSV: time, forward, sideways, yaw_rate [s, m/s, rad/s]); commands are
    drawn as in its training, if not given. The run lasts until two seconds after its last row, or longer."""

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
            SurefootError: as `in_simulator`.
        """
        task = replace(task, thermal_protection=task.thermal_protection or thermal_protection)
        task = self.in_simulator(task)
        return evaluation_task(task, robot, ranges or {}, self.pushes, self.push_force, self.commands, self.terrain)


def describe_simulator(task: TaskConfig) -> dict[str, Any]:
    """Return actuator and physical parameters of a task, as JSON holds them."""
    return {"actuator": task.actuator, "params": task.params, "params_source": task.params_source}
