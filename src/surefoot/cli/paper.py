"""`surefoot paper`: the paper and surefoot's results on one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from surefoot.cli.options import check_suffix
from surefoot.cli.parsing import parse
from surefoot.errors import SurefootError


@dataclass(frozen=True)
class PaperCommand:
    """Write one page with every table, figure and number of the paper, each beside surefoot's.

    The page is one HTML file that loads nothing from elsewhere. It reads the results that a clone of surefoot holds.
    """

    root: Path = Path()
    """Folder that holds `results`, `policies` and `docs`: a clone of surefoot."""
    out: Path = Path("paper.html")
    """File of the page (.html)."""


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; returns the exit code."""
    command = parse(PaperCommand, argv, "surefoot paper")
    check_suffix("out", command.out, ".html")
    if not (command.root / "results").is_dir():
        raise SurefootError(f"root is {command.root}; it must be a clone of surefoot, with the folder results")
    from surefoot.report.paper import write_page

    missing = write_page(command.root, command.out)
    print(f"wrote {command.out}")
    for name in missing:
        print(f"not there: {name}")
    return 0
