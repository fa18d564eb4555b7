"""Options of commands that simulate: another simulator, robot, parameters, pushes and commands than the task's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from surefoot.cli.helpers.options import PluginNames, Pushes, PushForce, RobotName, Seed, Settings, Terrain, World
from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import Actuator, Condition, change_simulator
from surefoot.robot import RobotDescription, parse_settings
from surefoot.robot.params_file import ParamValue
from surefoot.robot.randomization import Ranges
from surefoot.task.config import TaskConfig


@dataclass(frozen=True)
class Simulator:
    """Differences from the task's simulator."""

    actuator: Actuator | None = None
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

    def settings(self, settings: Mapping[str, ParamValue] | None = None) -> dict[str, ParamValue]:
        """Return the latencies and further physical parameters by name.

        Raises:
            SurefootError: a parameter given twice.
        """
        settings = settings or {}
        if twice := sorted(set(settings) & set(self.latencies)):
            option = twice[0].replace("_", "-")
            raise SurefootError(f"{twice[0]} is given twice, by --{option} and as a parameter; give it once")
        return {**self.latencies, **settings}

    def apply(self, task: TaskConfig, settings: Mapping[str, ParamValue] | None = None) -> TaskConfig:
        """Return the task in this simulator, with further physical parameters by name.

        Raises:
            SurefootError: a parameter given twice, an actuator that the task does not go with, or a file of parameters
                that does not fit the task's robot and control step.
        """
        return change_simulator(task, self.actuator, self.params, self.settings(settings))


SimulatorOptions = Annotated[Simulator, tyro.conf.OmitArgPrefixes]
"""The options as a field of a command."""


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
    terrain: Terrain = "flat"
    commands: Path | None = None
    """What steers a policy with commands: a file (CSV: time, forward, sideways, yaw_rate [s, m/s, rad/s]); commands are
    drawn as in its training, if not given. The run lasts until two seconds after its last row, or longer."""

    def condition(self, ranges: Ranges | None = None) -> Condition:
        """Return what the options change; parameters are drawn from `ranges`."""
        return Condition(
            world=self.world,
            actuator=self.simulator.actuator,
            params_file=self.simulator.params,
            params=self.simulator.settings(parse_settings([word for group in self.settings for word in group])),
            randomize=ranges or {},
            pushes=self.pushes,
            push_force=self.push_force,
            commands=self.commands,
            terrain=self.terrain,
        )

    def apply(self, task: TaskConfig, robot: RobotDescription, ranges: Ranges | None = None) -> TaskConfig:
        """Return a policy's task on its robot for this simulator, see `Condition.apply`."""
        return self.condition(ranges).apply(task, robot)


def describe_simulator(task: TaskConfig) -> dict[str, Any]:
    """Return actuator and physical parameters of a task, as JSON holds them."""
    return {"actuator": task.actuator, "params": task.params, "params_source": task.params_source}
