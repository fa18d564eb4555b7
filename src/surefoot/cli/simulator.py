"""`--actuator`, `--control-latency`, `--servo-latency`: another simulator than the one that a task asks for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal

import tyro

from surefoot.cli.parsing import parse
from surefoot.errors import SurefootError, choices
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.task.config import TaskConfig
from surefoot.world.interface import WorldConfig

HELP = """--actuator dc|constraint   dc: servo and DC motor; constraint: the position motor of physics engines
--control-latency SECONDS  age of what the policy sees; 0: none
--servo-latency SECONDS    age of what the servos see; 0: none"""


@dataclass(frozen=True)
class Simulator:
    """What differs from the simulator that the task asks for."""

    actuator: Literal["dc", "constraint"] | None = None
    """dc: servo and DC motor; constraint: the position motor of physics engines. The task's, if not given."""
    control_latency: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Age of what the policy sees [s]; the task's, if not given."""
    servo_latency: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Age of what the servos see [s]; the task's, if not given."""

    @property
    def params(self) -> dict[str, float]:
        """Physical parameters that are given, by name."""
        given = {"control_latency": self.control_latency, "servo_latency": self.servo_latency}
        return {name: value for name, value in given.items() if value is not None}

    def of(self, task: TaskConfig, settings: Mapping[str, float] | None = None) -> TaskConfig:
        """The task in this simulator.

        Args:
            task: what is run.
            settings: further physical parameters, by name.

        Raises:
            SurefootError: a parameter given twice, or an actuator that the task does not go with.
        """
        settings = settings or {}
        if twice := sorted(set(settings) & set(self.params)):
            option = twice[0].replace("_", "-")
            raise SurefootError(f"{twice[0]} is given twice, by --{option} and by --set; give one of them")
        params = {**task.params, **self.params, **settings}
        task = replace(task, actuator=self.actuator or task.actuator, params=params)
        # The world says what goes together; it is asked here because nothing has been simulated yet.
        WorldConfig(actuator=task.actuator, thermal_protection=task.thermal_protection)
        return task


SimulatorOptions = Annotated[Simulator, tyro.conf.OmitArgPrefixes]
"""The options as a field of a command."""


def check_params(task: TaskConfig, robot: RobotDescription) -> None:
    """Refuse physical parameters that a robot does not allow.

    Raises:
        SurefootError: no such parameter, or a value out of its bounds.
    """
    PhysicalParams.nominal(robot).with_values(robot, **task.params)


def simulator_help(indent: str = "  ") -> str:
    """What the options do."""
    return "\n".join(indent + line for line in HELP.splitlines())


def take_simulator(words: list[str], prog: str) -> tuple[list[str], Simulator]:
    """Take the options out of a command's words, for one whose own options are those of a whole configuration.

    Args:
        words: what stands behind the command.
        prog: the command, for errors.

    Returns:
        the other words, and the simulator.

    Raises:
        SurefootError: an option that does not fit.
    """
    names = {f"--{item.name.replace('_', '-')}" for item in fields(Simulator)}
    rest: list[str] = []
    taken: list[str] = []
    queue = list(words)
    while queue:
        word = queue.pop(0)
        name, equals, _ = word.partition("=")
        name = name.replace("_", "-")
        if name not in names:
            rest.append(word)
            continue
        if not equals and (not queue or queue[0].startswith("--")):
            raise SurefootError(f"{name} has no value; it takes {_values(name)}")
        taken += [word] if equals else [word, queue.pop(0)]
    return rest, parse(Simulator, taken, prog)


def _values(option: str) -> str:
    return choices(("dc", "constraint")) if option == "--actuator" else "a time in seconds"
