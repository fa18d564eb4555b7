"""Another simulator and other ranges than the task's.

`--params`, `--actuator`, `--control-latency`, `--servo-latency`; `--randomize NAME`, `--randomize.ROW LOW HIGH`.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from surefoot.cli.helpers.options import Pushes, PushForce, RobotName, Seed, Settings, World
from surefoot.errors import SurefootError, choices
from surefoot.robot import RobotDescription
from surefoot.robot.params_file import ParamValue, find_params, read_params
from surefoot.robot.randomization import ROWS, RandomizeConfig, load_ranges, range_names
from surefoot.task.config import TaskConfig
from surefoot.world.interface import WorldConfig

_RANGES_HELP = """--randomize NAME           ranges that an episode draws its parameters from: {names}, or a YAML file
--randomize.ROW LOW HIGH   another range for one row; --randomize.ROW none drops it. Rows and ranges of table1:"""


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
        given = {"control_latency": self.control_latency, "servo_latency": self.servo_latency}
        return {name: value for name, value in given.items() if value is not None}

    def of(self, task: TaskConfig, settings: Mapping[str, ParamValue] | None = None) -> TaskConfig:
        """Return the task in this simulator, with further physical parameters, by name.

        Raises:
            SurefootError: a parameter given twice, an actuator that the task does not go with, or a file of parameters
                that can't be read or does not fit the task's robot and control step.
        """
        settings = settings or {}
        if twice := sorted(set(settings) & set(self.latencies)):
            option = twice[0].replace("_", "-")
            raise SurefootError(f"{twice[0]} is given twice, by --{option} and as a parameter; give it once")
        if self.params is not None:
            task = _with_file(task, self.params)
        params = {**task.params, **self.latencies, **settings}
        task = replace(task, actuator=self.actuator or task.actuator, params=params)
        # The world says what goes together; it is asked here because nothing has been simulated yet.
        WorldConfig(actuator=task.actuator, thermal_protection=task.thermal_protection)
        return task


SimulatorOptions = Annotated[Simulator, tyro.conf.OmitArgPrefixes]
"""The options as a field of a command."""


def _with_file(task: TaskConfig, path: Path) -> TaskConfig:
    """Return the task on the robot of a file of parameters.

    None of the task's own parameters stays beside the file's, so that a policy that was trained on one identified
    robot is not run on a mixture of two; only the control step does, which belongs to the policy and to no robot.
    """
    robot = RobotDescription.load(task.robot)
    path = find_params(path, robot)
    found, expected = read_params(path, robot), float(task.nominal(robot).control_step[0])
    step = float(found.params.control_step[0])
    if "control_step" in found.given and not math.isclose(step, expected, rel_tol=1e-9):
        raise SurefootError(
            f"{path}: control_step is {step:g}, and the task's is {expected:g}; "
            "it belongs to the policy, not to the robot: leave it out of the file"
        )
    kept = {name: value for name, value in task.params.items() if name == "control_step"}
    return replace(task, params={**found.values, **kept}, params_source=found.source)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of commands that run one policy in one world."""

    pushes: Pushes = False
    push_force: PushForce = None
    """Push the robot with forces from LOW to HIGH [N] in horizontal directions, as often as its task says."""
    settings: Settings = ()
    """Physical parameters that differ from the task's, such as motor_strength=0.8."""
    seed: Seed = 1
    world: World = "mujoco"
    simulator: SimulatorOptions = Simulator()
    """Another simulator than the policy's own."""
    robot: RobotName = None
    commands: Path | None = None
    """What steers a policy with commands: a file (CSV: time, forward, sideways, yaw_rate [s, m/s, rad/s]); commands are
    drawn as in its training, if not given."""


def ranges_help() -> str:
    """Return the help of `--randomize`, with the rows of the paper's table."""
    drawn = load_ranges("table1").ranges
    lines = _RANGES_HELP.format(names=choices(range_names())).splitlines()
    lines += [f"    {row:<17}{low:g} to {high:g}" for row, (low, high) in drawn.items()]
    others = f"and, not in table1: {choices(row for row in ROWS if row not in drawn)}"
    lines += textwrap.wrap(others, 100, initial_indent="    ", subsequent_indent="    ")
    return textwrap.indent("\n".join(lines), "  ")


@dataclass(frozen=True)
class GivenRanges:
    """What `--randomize` says on a command line."""

    table: str | None
    """Name or path of a table of ranges."""
    rows: dict[str, tuple[float, float] | None]
    """Rows with other ranges, or without."""

    def of(self, robot: str | Path, base: RandomizeConfig | None = None) -> RandomizeConfig:
        """Return the ranges for a robot, by name or folder; what is not given is as in `base`, or not drawn."""
        config = base or RandomizeConfig()
        if self.table is not None:
            config = load_ranges(self.table, robot=robot)
        return replace(config, **self.rows)


def take_ranges(words: list[str]) -> tuple[list[str], GivenRanges]:
    """Take `--randomize` out of a command's words; return the other words, and what it says."""
    rest: list[str] = []
    table: str | None = None
    rows: dict[str, tuple[float, float] | None] = {}
    queue = list(words)
    while queue:
        word = queue.pop(0)
        name, equals, value = word.partition("=")
        if name == "--randomize":
            if not equals and (not queue or queue[0].startswith("--")):
                raise SurefootError(f"--randomize has no value; choices: {choices(range_names())}, or a YAML file")
            table = value if equals else queue.pop(0)
        elif name.startswith("--randomize."):
            row = name.removeprefix("--randomize.").replace("-", "_")
            if row not in ROWS:
                raise SurefootError(f"{name} is not a row that can be drawn; choices: {choices(ROWS)}")
            given = [value or (queue.pop(0) if queue and not queue[0].startswith("--") else "")]
            dropped = given[0].lower() == "none"
            if given[0] and not dropped and queue and not queue[0].startswith("--"):
                given.append(queue.pop(0))
            rows[row] = None if dropped else _range(name, given)
        else:
            rest.append(word)
    return rest, GivenRanges(table, rows)


def _range(option: str, given: list[str]) -> tuple[float, float]:
    try:
        low, high = (float(word) for word in given)
    except ValueError:
        said = " ".join(given) or "nothing"
        raise SurefootError(f"{option} is {said}; it takes two numbers, LOW HIGH, or none") from None
    return low, high
