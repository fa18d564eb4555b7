"""`surefoot identify`: experiments on a robot, and how well the simulator repeats them."""

from __future__ import annotations

import sys
from importlib import import_module

from surefoot.cli.main import table_lines
from surefoot.errors import SurefootError, choices
from surefoot.identify.registry import EXPERIMENTS

FROM_TRACE = "--from-trace"
FIGURE = "motor-figure"
_USAGE = """usage: surefoot identify EXPERIMENT --port PORT ...
       surefoot identify EXPERIMENT --recording FOLDER ...
       surefoot identify --from-trace FOLDER ...

Find a robot's physical parameters by experiments, and write them to a file for surefoot train --params FILE.

experiments on a robot, in this order, each with --params FILE of what is known already:
{experiments}

without an experiment:
{others}

surefoot identify EXPERIMENT --help tells what it takes."""


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; returns the exit code."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if argv else sys.stderr)
        return 0 if argv else 2
    word = argv[0]
    if word == FIGURE:
        code: int = import_module("surefoot.cli.identify_motor_figure").main(argv[1:])
    elif word.partition("=")[0] == FROM_TRACE:
        code = import_module("surefoot.cli.identify_experiment").from_trace(argv)
    elif word in EXPERIMENTS:
        code = import_module("surefoot.cli.identify_experiment").main(word, argv[1:])
    else:
        named = choices([*EXPERIMENTS, FIGURE])
        raise SurefootError(f"'{word}' is no experiment; choices: {named}, or {FROM_TRACE} FOLDER")
    return code


def _usage() -> str:
    experiments = {name: f"{one.what} (on {'rack' if one.rack else 'ground'})" for name, one in EXPERIMENTS.items()}
    others = {
        f"{FROM_TRACE} FOLDER": "motors and delays, from traces of runs",
        FIGURE: "one motor follows a sine: servo and DC motor, constraint motor, and a recording",
    }
    width = max(map(len, [*experiments, *others]))
    return _USAGE.format(experiments=table_lines(experiments, width), others=table_lines(others, width))
