"""Options of commands that simulate: another simulator, robot, parameters, pushes and commands than the task's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from surefoot.cli.helpers.options import (
    PluginNames,
    Pushes,
    PushForce,
    RobotName,
    Seed,
    Settings,
    Terrain,
    World,
)
from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import Actuator, Condition
from surefoot.robot import RobotDescription, parse_settings
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

    def condition(self, settings: Iterable[Iterable[str]] = (), **changes: Any) -> Condition:
        """Return the condition of this simulator, of physical parameters as `--set` takes them, and of other changes.

        Raises:
            SurefootError: no such parameter, or one that is given twice.
        """
        params = parse_settings([word for group in settings for word in group])
        if twice := sorted(set(params) & set(self.latencies)):
            option = twice[0].replace("_", "-")
            raise SurefootError(f"{twice[0]} is given twice, by --{option} and as a parameter; give it once")
        params = {**self.latencies, **params}
        return Condition(actuator=self.actuator, params_file=self.params, params=params, **changes)


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
        return self.simulator.condition(self.settings).simulate(task)


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

    def condition(self, ranges: Ranges | None = None, **changes: Any) -> Condition:
        """Return what the options change; parameters are drawn from `ranges`."""
        names = ("world", "pushes", "push_force", "commands", "terrain")
        given = {name: getattr(self, name) for name in names} | {"randomize": ranges or {}}
        return self.simulator.condition(self.settings, **given, **changes)

    def apply(self, task: TaskConfig, robot: RobotDescription, ranges: Ranges | None = None) -> TaskConfig:
        """Return a policy's task on its robot for this simulator, see `Condition.apply`."""
        return self.condition(ranges).apply(task, robot)


def describe_simulator(task: TaskConfig) -> dict[str, Any]:
    """Return actuator and physical parameters of a task, as JSON holds them."""
    return {"actuator": task.actuator, "params": task.params, "params_source": task.params_source}
