"""`surefoot study paper`: the paper and surefoot's results on one page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from surefoot.cli.helpers.options import Ray, Workers, check_folder, check_suffix
from surefoot.cli.helpers.paper_runs import PAGE, QUICK_NOTE, PaperRuns, make_all, run_script
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError


@dataclass(frozen=True)
class PaperCommand:
    """Write one page with every table, figure and number of the paper, each beside surefoot's.

    The page is one HTML file that loads nothing from elsewhere. A clone's docs/paper_page.py writes it, of the results
    in the clone.
    With --quick or --full it makes results anew, in a folder of their own: every training, search and evaluation.
    Ctrl-C stops; the same command goes on.
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
    if not (command.root / PAGE).is_file():
        raise SurefootError(f"root is {command.root}; it must be a clone of surefoot, with {PAGE}")
    if command.quick and command.full:
        raise SurefootError("--quick and --full are given; give one of them, or neither")
    root, page, note = command.root, command.out or Path("paper.html"), ""
    if command.quick or command.full:
        from surefoot.studies.workers import check_address

        check_address(command.ray)
        root = (command.out or Path("paper-quick" if command.quick else "paper-full")).resolve()
        check_folder(root)
        page = root / "paper.html"
        runs = PaperRuns(command.root.resolve(), root, command.quick, command.workers, command.ray)
        if not make_all(runs):
            runs.console.print(f"Stopped. To go on:\n  {shlex.join(['surefoot', 'study', 'paper', *argv])}")
            return 130
        note = QUICK_NOTE if command.quick else ""
    elif command.workers or command.ray:
        raise SurefootError("--workers and --ray go with --quick or --full, and neither is given")
    print(run_script(command.root / PAGE, "--root", root, "--out", page, "--note", note), end="")
    return 0
