"""`surefoot study paper`: the paper and surefoot's results on one page."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from surefoot.cli.helpers.options import Ray, Workers, check_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError

RUNS = Path("tools/paper_runs.py")
"""Module of a clone that writes the page and makes what it shows."""


@dataclass(frozen=True)
class PaperCommand:
    """Write one page with every table, figure and number of the paper, each beside surefoot's.

    The page is one HTML file that loads nothing from elsewhere. It reads the results that a clone of surefoot holds,
    by the clone's own tools/paper_runs.py. With --quick or --full results are made anew, in a folder of their own:
    every training, search and evaluation. Ctrl-C stops; the same command goes on.
    """

    root: Path = Path()
    """Folder that holds `results`, `policies` and `docs`: a clone of surefoot."""
    out: Path | None = None
    """File of the page (.html); paper.html, if not given. With --quick or --full: folder for all that is made, and the
    page paper.html in it; paper-quick or paper-full, if not given."""
    quick: bool = False
    """Make a small version of everything first: some twenty minutes on two cores."""
    full: bool = False
    """Make everything first: days on two cores, fewer on a cluster."""
    workers: Workers = 0
    ray: Ray = None


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(PaperCommand, argv, "surefoot study paper")
    if not (command.quick or command.full):
        check_suffix("out", command.out, ".html")
        if command.workers or command.ray:
            raise SurefootError("--workers and --ray go with --quick or --full, and neither is given")
    if not (command.root / RUNS).is_file():
        raise SurefootError(f"root is {command.root}; it must be a clone of surefoot, with {RUNS}")
    if command.quick and command.full:
        raise SurefootError("--quick and --full are given; give one of them, or neither")
    sys.path.insert(0, str((command.root / RUNS).resolve().parent))
    code: int = import_module(RUNS.stem).main(command, shlex.join(["surefoot", "study", "paper", *argv]))
    return code
