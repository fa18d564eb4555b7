"""`surefoot study paper`: write a page that compares the paper (Tan et al. 2018) with surefoot's results."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.cli.helpers.options import Ray, Workers, check_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError

RUNS = Path("tools/paper_runs.py")
"""Module of a clone that produces the results and writes the page."""


@dataclass(frozen=True)
class PaperCommand:
    """Write a page with every table, figure and number of the paper next to surefoot's result.

    The page is one self-contained HTML file, made from the results in a clone of surefoot by its tools/paper_runs.py.
    With --quick or --full all results are produced again first, in a separate folder: every training, search and
    evaluation. Ctrl-C stops; the same command continues.
    """

    root: Path = Path()
    """Clone of surefoot: the folder with `results`, `policies` and `docs`."""
    out: Annotated[
        Path | None,
        tyro.conf.arg(
            help="File of the page (.html). Defaults to paper.html. With --quick or --full: folder for all results and "
            "the page paper.html. Defaults to paper-quick or paper-full.",
        ),
    ] = None
    quick: bool = False
    """Produce a small version of all results first, which takes about twenty minutes on two cores."""
    full: bool = False
    """Produce all results first, which takes days on two cores, or less on a cluster."""
    workers: Workers = 0
    ray: Ray = None


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(PaperCommand, argv, "surefoot study paper")
    if not (command.quick or command.full):
        check_suffix("out", command.out, ".html")
        if command.workers or command.ray:
            raise SurefootError("--workers and --ray require --quick or --full; neither is given")
    if not (command.root / RUNS).is_file():
        raise SurefootError(f"root is {command.root}; it must be a clone of surefoot, with {RUNS}")
    if command.quick and command.full:
        raise SurefootError("--quick and --full are given; give one of them, or neither")
    sys.path.insert(0, str((command.root / RUNS).resolve().parent))
    code: int = import_module(RUNS.stem).main(command, shlex.join(["surefoot", "study", "paper", *argv]))
    return code
