"""Another simulator and other ranges than the task's.

`--params`, `--actuator`, `--control-latency`, `--servo-latency`; `--randomize TABLE`, `--randomize.NAME LOW HIGH`.
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
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.robot.params_file import ParamValue, find_params, read_params
from surefoot.robot.randomization import (
    ParamRange,
    Ranges,
    RelativeRange,
    check_ranges,
    load_ranges,
    mean_interval,
    range_names,
)
from surefoot.task.config import TaskConfig
from surefoot.world.interface import WorldConfig

_RANGES_HELP = """--randomize TABLE           ranges that an episode draws its parameters from: {names}, or a YAML file
--randomize.NAME LOW HIGH   another range for one parameter; scale LOW HIGH: factors of its nominal value;
                            add LOW HIGH: added to it; none: it is not drawn. Names and ranges of table1:"""
_RELATIVE = ("scale", "add")


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
    """Return the help of `--randomize`, with the ranges of the paper's table."""
    table, nominal = load_ranges("table1"), PhysicalParams.nominal(RobotDescription.load(DEFAULT_ROBOT))
    intervals = {name: mean_interval(given, getattr(nominal, name)) for name, given in table.items()}
    lines = _RANGES_HELP.format(names=choices(range_names())).splitlines()
    lines += [f"    {name:<20}{low:g} to {high:g}" for name, (low, high) in intervals.items()]
    others = f"and, not in table1: {choices(name for name in PARAMETERS if name not in table)}"
    lines += textwrap.wrap(others, 100, initial_indent="    ", subsequent_indent="    ")
    return textwrap.indent("\n".join(lines), "  ")


@dataclass(frozen=True)
class RangeOptions:
    """The options `--randomize` of a command line."""

    table: str | None
    """Name or path of a table of ranges."""
    ranges: dict[str, ParamRange | None]
    """Ranges in place of the table's; None drops one."""

    def apply(self, robot: str | Path, base: Ranges | None = None) -> Ranges:
        """Return the ranges for a robot, by name or folder; parameters without options are as in `base`."""
        ranges = dict(base or {}) if self.table is None else load_ranges(self.table, robot=robot)
        return {name: given for name, given in {**ranges, **self.ranges}.items() if given is not None}


def take_ranges(words: list[str]) -> tuple[list[str], RangeOptions]:
    """Take the options `--randomize` out of a command's words; return the other words, and the options."""
    rest: list[str] = []
    table: str | None = None
    ranges: dict[str, ParamRange | None] = {}
    queue = list(words)
    while queue:
        word = queue.pop(0)
        name, equals, value = word.partition("=")
        if name == "--randomize":
            if not equals and (not queue or queue[0].startswith("--")):
                raise SurefootError(f"--randomize has no value; choices: {choices(range_names())}, or a YAML file")
            table = value if equals else queue.pop(0)
        elif name.startswith("--randomize."):
            parameter = name.removeprefix("--randomize.").replace("-", "_")
            check_ranges({parameter: (0.0, 0.0)})
            values = [value] if equals else []
            while queue and not queue[0].startswith("--") and len(values) < _count(values):
                values.append(queue.pop(0))
            ranges[parameter] = _read_range(name, values)
        else:
            rest.append(word)
    return rest, RangeOptions(table, ranges)


def _count(values: list[str]) -> int:
    """Return how many words a range has that begins with some words."""
    first = values[0].lower() if values else ""
    return {"none": 1, "scale": 3, "add": 3}.get(first, 2)


def _read_range(option: str, words: list[str]) -> ParamRange | None:
    kind = words[0].lower() if words else ""
    if kind == "none":
        return None
    try:
        low, high = (float(word) for word in words[kind in _RELATIVE :])
    except ValueError:
        message = " ".join(words) or "nothing"
        raise SurefootError(
            f"{option} is {message}; it takes LOW HIGH, scale LOW HIGH, add LOW HIGH, or none"
        ) from None
    if kind == "scale":
        return RelativeRange(scale=(low, high))
    return RelativeRange(add=(low, high)) if kind == "add" else (low, high)
