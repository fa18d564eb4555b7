"""Options of commands that simulate: changes of a task's simulator, robot, parameters, pushes and commands."""

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
    """Actuator model; dc: servo and DC motor; constraint: the engine's position motor. Defaults to the task's."""
    control_latency: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Age of the readings that the policy observes [s]. Defaults to the task's value."""
    servo_latency: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Age of the readings that the servos use [s]. Defaults to the task's value."""
    params: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="FILE",
            help="File of the robot's physical parameters (.toml), or the name of one released with the robot. Other "
            "parameters are as in the data sheet; the control step stays the task's. Defaults to the task's "
            "parameters.",
        ),
    ] = None

    @property
    def latencies(self) -> dict[str, float]:
        """Latencies set by options [s], by name."""
        names = ("control_latency", "servo_latency")
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def condition(self, settings: Iterable[Iterable[str]] = (), **changes: Any) -> Condition:
        """Return the condition of this simulator with physical parameters in the format of `--set`, and other changes.

        Raises:
            SurefootError: an unknown parameter, or one that is given twice.
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
    """Physical parameters to change, such as motor_strength=0.8."""
    plugin: PluginNames = ()
    world: World = "mujoco"
    simulator: SimulatorOptions = Simulator()
    """Differences from the policy's own simulator."""
    robot: RobotName = None
    terrain: Terrain = "flat"

    def in_simulator(self, task: TaskConfig) -> TaskConfig:
        """Return a policy's task in this simulator.

        Raises:
            SurefootError: an unknown parameter, a value out of the robot's bounds, or incompatible options.
        """
        return self.simulator.condition(self.settings).simulate(task)


@dataclass(frozen=True, kw_only=True)
class RunOptions(SimulationOptions):
    """Options of commands that run episodes of one policy in one world."""

    pushes: Pushes = False
    push_force: PushForce = None
    """Push the robot in random horizontal directions with forces from LOW to HIGH [N], as often as its task does."""
    seed: Seed = 1
    commands: Annotated[
        Path | None,
        tyro.conf.arg(
            help="File of velocity commands (CSV: time, forward, sideways, yaw_rate [s, m/s, m/s, rad/s]); the run "
            "lasts at least until two seconds after its last row. By default commands are random, as in the training.",
        ),
    ] = None

    def condition(self, ranges: Ranges | None = None, **changes: Any) -> Condition:
        """Return the condition given by the options, with parameters randomized within `ranges`."""
        names = ("world", "pushes", "push_force", "commands", "terrain")
        changes |= {name: getattr(self, name) for name in names} | {"randomize": ranges or {}}
        return self.simulator.condition(self.settings, **changes)

    def apply(self, task: TaskConfig, robot: RobotDescription, ranges: Ranges | None = None) -> TaskConfig:
        """Return a policy's task on its robot under this condition, see `Condition.apply`."""
        return self.condition(ranges).apply(task, robot)


def describe_simulator(task: TaskConfig) -> dict[str, Any]:
    """Return the actuator and the physical parameters of a task for JSON."""
    return {"actuator": task.actuator, "params": task.params, "params_source": task.params_source}
