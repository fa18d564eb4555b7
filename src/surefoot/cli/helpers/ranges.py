"""The options `--randomize TABLE` and `--randomize.NAME LOW HIGH`."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path

from surefoot.errors import SurefootError, choices
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.robot.randomization import (
    ParamRange,
    Ranges,
    RelativeRange,
    check_ranges,
    load_ranges,
    mean_interval,
    range_names,
)

_RANGES_HELP = """--randomize TABLE           ranges of the parameters that are randomized: {names}, or a YAML file
--randomize.NAME LOW HIGH   range of one parameter; scale LOW HIGH: factors of its nominal value; add LOW HIGH:
                            offsets from it; none: the parameter is not randomized. Names and ranges of table1:"""
_WORDS = {"none": 1, "scale": 3, "add": 3}
"""Number of words of a range, by its first word; 2 for a range that starts with a number."""


def ranges_help() -> str:
    """Return the help of `--randomize`, with the ranges of the paper's table I."""
    table, nominal = load_ranges("table1"), PhysicalParams.nominal(RobotDescription.load(DEFAULT_ROBOT))
    intervals = {name: mean_interval(interval, getattr(nominal, name)) for name, interval in table.items()}
    lines = _RANGES_HELP.format(names=choices(range_names())).splitlines()
    lines += [f"    {name:<20}{low:g} to {high:g}" for name, (low, high) in intervals.items()]
    others = f"other names: {choices(name for name in PARAMETERS if name not in table)}"
    lines += textwrap.wrap(others, 100, initial_indent="    ", subsequent_indent="    ")
    return textwrap.indent("\n".join(lines), "  ")


@dataclass(frozen=True)
class RangeOptions:
    """The options `--randomize` of a command line."""

    table: str | None
    """Name or path of a table of ranges."""
    ranges: dict[str, ParamRange | None]
    """Ranges of single parameters, which override the table; None removes one."""

    def apply(self, robot: str | Path, base: Ranges | None = None) -> Ranges:
        """Return the ranges for a robot (name or folder); parameters without options keep their range in `base`."""
        below = (base or {}) if self.table is None else load_ranges(self.table, robot=robot)
        ranges = {name: interval for name, interval in {**below, **self.ranges}.items() if interval is not None}
        check_ranges(ranges, RobotDescription.load(robot))
        return ranges


def take_ranges(words: list[str]) -> tuple[list[str], RangeOptions]:
    """Extract the options `--randomize` from a command's arguments; return the other arguments, and the options."""
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
            while queue and not queue[0].startswith("--") and len(values) < _WORDS.get("".join(values[:1]).lower(), 2):
                values.append(queue.pop(0))
            ranges[parameter] = _read_range(name, values)
        else:
            rest.append(word)
    return rest, RangeOptions(table, ranges)


def _read_range(option: str, words: list[str]) -> ParamRange | None:
    kind = "".join(words[:1]).lower()
    if kind == "none":
        return None
    try:
        low, high = (float(word) for word in words[kind in _WORDS :])
    except ValueError:
        message = " ".join(words) or "nothing"
        raise SurefootError(
            f"{option} is {message}; it takes LOW HIGH, scale LOW HIGH, add LOW HIGH, or none"
        ) from None
    if kind == "scale":
        return RelativeRange(scale=(low, high))
    return RelativeRange(add=(low, high)) if kind == "add" else (low, high)
