"""Write measured numbers into the pages, from the files under results/ that commands wrote.

    python docs/page_numbers.py [PAGE...]         # rewrite what is stale
    python docs/page_numbers.py --check           # one line for each stale number or table; exit code 1

A marker names the source of the number right before it, as in docs/result_numbers.py:

    It goes .66<!--= evaluations trot: speed_mean --> m/s, and 27 of 100<!--= evaluations trot/table1: falls --> fall.

Sign, leading zero and decimals stay as they are printed. `N of M` is one column of another, as in `falls of runs`; the
other one is `episodes`, if not named.

A table is generated from the lines in the comment above it:

    <!-- table of: trot, solo8-trot = Solo 8
    | policy | speed [m/s] | table I drawn: falls |
    |---|---|---|
    | `{0}` | {evaluations {0}: speed_mean .2} | {evaluations {0}/table1: falls of episodes} |
    -->
    (lines that this script writes)
    <!-- end of table -->

A line with {0} stands there once for each item of the list; {1} is what follows an item's first ` = `. The list
`all of FILE` is the first column of a CSV file. Other braces hold what a marker holds, then the format.
A backslash at the end of a line continues it.

The claims of the paper that were not reproduced, or those that were, from docs/paper.yaml:

    <!-- claims: untried, no, partly -->
    (lines that this script writes)
    <!-- end of claims -->
"""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from pathlib import Path

from paper_page import claims_markdown
from result_numbers import fill, find_file, first_column, look_up, substitute

from surefoot.errors import SurefootError, prefix_errors
from surefoot.files import atomic_write

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("policies/README.md", "docs/*.md")
MARKER = re.compile(r"<!--=\s*(.+?)\s*-->", re.DOTALL)
TABLE = re.compile(r"(<!-- table of: *([^\n]+)\n(.+?)-->\n)(.*?)<!-- end of table -->", re.DOTALL)
CLAIMS = re.compile(r"(<!-- claims: *([^\n]+?) *-->\n)(.*?)(?=<!-- end of claims -->)", re.DOTALL)
TOKEN = r"(?:[+-]?(?:\d+(?:\.\d+)?|\.\d+)(?:\s+of\s+\d+)?|[A-Za-z][\w-]*)"


def form_of(text: str) -> str:
    """Return the format of a printed number; that of a word is empty."""
    match = re.match(r"([+]?)-?(0?)\d*(?:\.(\d+))?", text) if re.match(r"[+-]?\.?\d", text) else None
    return (
        "" if match is None else f"{match[1]}{match[2] if match[3] else '0'}{f'.{len(match[3])}' if match[3] else ''}"
    )


def write_markers(root: Path, text: str) -> str:
    """Return a page with the number before each marker as its source has it."""
    out, end = "", 0
    for match in MARKER.finditer(text):
        with prefix_errors(f"line {text.count(chr(10), 0, match.start()) + 1}"):
            out += text[end : match.start()]
            last = re.search(rf"{TOKEN}$", out)
            if last is None:
                raise SurefootError(f"no number stands before {match[0]}")
            of = " of episodes" if re.search(r"\sof\s", last[0]) and " of " not in match[1] else ""
            values = look_up(root, match[1] + of, form_of(last[0]))
            old = re.search(rf"{TOKEN}(?:,\s+{TOKEN}){{{len(values) - 1}}}$", out) or last
            if old[0].split() != (new := ", ".join(values)).split():
                out = out[: old.start()] + new
        out, end = out + match[0], match.end()
    return out + text[end:]


def write_table(root: Path, keys: str, lines: str) -> str:
    """Return the lines of a generated table."""
    whole = re.fullmatch(r"all of (\S+)", keys.strip())
    items = first_column(find_file(root, whole[1]))[1:] if whole else keys.strip().split(", ")
    table = []
    for line in re.sub(r"\\\n *", "", lines).splitlines():
        for item in items if "{0}" in line else [""]:
            table.append(fill(root, substitute(line, item)) + "\n")
    return "".join(table)


def write_page(root: Path, text: str) -> str:
    """Return a page with all numbers and tables as their sources have them.

    Raises:
        SurefootError: a marker or a table without a source; its line is named.
    """
    text = write_markers(root, text)
    text = CLAIMS.sub(lambda match: match[1] + claims_markdown(root, match[2].split(", ")), text)
    out, end = "", 0
    for match in TABLE.finditer(text):
        with prefix_errors(f"line {text.count(chr(10), 0, match.start()) + 1}"):
            out += text[end : match.start()] + match[1] + write_table(root, match[2], match[3])
        end = match.start() + len(match[0]) - len("<!-- end of table -->")
    return out + text[end:]


def changes(old: str, new: str) -> list[str]:
    """Return a line for each line of a page that is stale."""
    matcher = difflib.SequenceMatcher(None, first := old.splitlines(), second := new.splitlines(), autojunk=False)
    lines = []
    for kind, i, i_end, j, j_end in matcher.get_opcodes():
        if kind != "equal":
            lines.append(f"{i + 1}: has {' / '.join(first[i:i_end])!r}, the results {' / '.join(second[j:j_end])!r}")
    return lines


def main() -> int:
    """Rewrite or check the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", type=Path, help="all, if none is given")
    parser.add_argument("--check", action="store_true", help="change nothing; exit code 1, if anything is stale")
    arguments = parser.parse_args()
    pages = arguments.pages or [path for pattern in PAGES for path in sorted(ROOT.glob(pattern))]
    stale = 0
    for page in pages:
        text = page.read_text(encoding="utf-8")
        try:
            new = write_page(ROOT, text)
        except SurefootError as error:
            print(f"{page}: {error}")
            stale += 1
            continue
        for line in changes(text, new):
            print(f"{page}:{line}")
            stale += 1
        if new != text and not arguments.check:
            atomic_write(page, new)
    return int(stale > 0 and arguments.check)


if __name__ == "__main__":
    sys.exit(main())
