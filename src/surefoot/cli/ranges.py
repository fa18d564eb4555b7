"""`--randomize NAME` and `--randomize.ROW LOW HIGH`: ranges of the command line over those of a task."""

from __future__ import annotations

import textwrap
from dataclasses import replace

from surefoot.errors import SurefootError, choices
from surefoot.task.randomize import ROWS, RandomizeConfig, load_ranges, range_names

HELP = """--randomize NAME           ranges that an episode draws its parameters from: {names}, or a YAML file
--randomize.ROW LOW HIGH   another range for one row; --randomize.ROW none drops it. Rows and ranges of table1:"""


def ranges_help(indent: str = "  ") -> str:
    """Return the help of the options, with the rows of the paper's table."""
    drawn = load_ranges("table1").ranges
    lines = HELP.format(names=choices(range_names())).splitlines()
    lines += [f"    {row:<17}{low:g} to {high:g}" for row, (low, high) in drawn.items()]
    others = f"and, not in table1: {choices(row for row in ROWS if row not in drawn)}"
    lines += textwrap.wrap(others, 100, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(indent + line for line in lines)


def take_ranges(words: list[str], base: RandomizeConfig) -> tuple[list[str], RandomizeConfig]:
    """Take the options out of a command's words; return the other words, and the ranges.

    Args:
        words: what stands behind the command.
        base: ranges where the words say nothing.

    Raises:
        SurefootError: an option that does not fit.
    """
    rest: list[str] = []
    rows: dict[str, tuple[float, float] | None] = {}
    queue = list(words)
    while queue:
        word = queue.pop(0)
        name, equals, value = word.partition("=")
        if name == "--randomize":
            if not equals and (not queue or queue[0].startswith("--")):
                raise SurefootError(f"--randomize has no value; choices: {choices(range_names())}, or a YAML file")
            base = load_ranges(value if equals else queue.pop(0))
        elif name.startswith("--randomize."):
            row = name.removeprefix("--randomize.").replace("-", "_")
            if row not in ROWS:
                raise SurefootError(f"{name} is not a row that can be drawn; choices: {choices(ROWS)}")
            given = [value] if value else []
            while queue and not queue[0].startswith("--") and len(given) < 2 and not _drops(given):
                given.append(queue.pop(0))
            rows[row] = _range(name, given)
        else:
            rest.append(word)
    return rest, replace(base, **rows)


def _drops(given: list[str]) -> bool:
    return len(given) == 1 and given[0].lower() == "none"


def _range(option: str, given: list[str]) -> tuple[float, float] | None:
    if _drops(given):
        return None
    try:
        low, high = (float(word) for word in given)
    except ValueError:
        said = " ".join(given) or "nothing"
        raise SurefootError(f"{option} is {said}; it takes two numbers, LOW HIGH, or none") from None
    return low, high
