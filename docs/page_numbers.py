"""Write measured numbers into the pages, from the files under results/ that commands wrote.

    python docs/page_numbers.py [PAGE...]         # rewrite what is stale
    python docs/page_numbers.py --check           # one line for each stale number or table; exit code 1

A marker names the source of the number right before it:

    It goes .66<!--= evaluations trot: speed_mean --> m/s, and 27 of 100<!--= evaluations trot/table1: falls --> fall.

It reads FILE ROW: COLUMN. FILE is a CSV or JSON file without its suffix, in results/ or from the root (policies/...).
ROW is a value of the first column, or COLUMN=VALUE,COLUMN=VALUE; a JSON file has none. COLUMN is a column, or keys of a
JSON file with dots between them; a factor may follow, as in `share x100`. Sign, leading zero and decimals stay as they
are printed. `N of M` is one column of another, as in `falls of runs`; the other one is `episodes`, if not named.

Several rows, `A; B; C`, give several numbers, `.66, .64, .69`; or one, if COLUMN begins with sum, mean, sd (with
n - 1), min or max.

A table is generated from the lines in the comment above it:

    <!-- table of: trot, solo8-trot = Solo 8
    | policy | speed [m/s] | table I drawn: falls |
    |---|---|---|
    | `{0}` | {evaluations {0}: speed_mean .2} | {evaluations {0}/table1: falls of episodes} |
    -->
    (lines that this script writes)
    <!-- end of table -->

A line with {0} stands there once for each item of the list; {1} is what follows an item's first ` = `. The list
`all of FILE` is the first column of a CSV file. Other braces hold what a marker holds, then the format: `.2`, `0.2`
(with a leading zero), `0` (an integer), `+.2` (with its sign); without one the file's text stands as it is.
"""

from __future__ import annotations

import argparse
import csv
import difflib
import re
import statistics
import sys
from pathlib import Path
from typing import Any

from surefoot.errors import SurefootError, prefix_errors
from surefoot.files import atomic_write
from surefoot.studies.paper import find_row, find_value

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "policies/README.md", "docs/*.md")
MARKER = re.compile(r"<!--=\s*(.+?)\s*-->", re.DOTALL)
TABLE = re.compile(r"(<!-- table of: *([^\n]+)\n(.+?)-->\n)(.*?)<!-- end of table -->", re.DOTALL)
CODE = re.compile(r"^```.*?^```|^    .*?$|`[^`\n]+`", re.DOTALL | re.MULTILINE)
FORM = re.compile(r"([+]?)(0?)(?:\.(\d))?")
TOKEN = r"(?:[+-]?(?:\d+(?:\.\d+)?|\.\d+)(?:\s+of\s+\d+)?|[A-Za-z][\w-]*)"
COMBINED = {"sum": sum, "mean": statistics.fmean, "sd": statistics.stdev, "min": min, "max": max}


def find_file(root: Path, name: str) -> Path:
    """Return the file of results of a name."""
    for path in (root / folder / f"{name}.{kind}" for folder in ("results", ".") for kind in ("csv", "json")):
        if path.is_file():
            return path
    raise SurefootError(f"results has no file {name}.csv or {name}.json")


def where(path: Path, selector: str) -> dict[str, str]:
    """Return the values of columns that a selector of a row names."""
    if "=" in selector:
        return dict(part.strip().split("=", 1) for part in selector.split(","))
    return {first_column(path)[0]: selector} if selector else {}


def first_column(path: Path) -> list[str]:
    """Return the first column of a CSV file, its name included."""
    with path.open(encoding="utf-8", newline="") as file:
        return [row[0] for row in csv.reader(file)]


def look_up(root: Path, source: str, form: str) -> list[str]:
    """Return the texts of a source, `FILE ROW: COLUMN`, with numbers in a format such as `.2`."""
    place, colon, column = " ".join(source.split()).rpartition(": ")
    if not colon:
        raise SurefootError(f"'{source}' is no source; it is FILE ROW: COLUMN")
    name, _, selectors = place.partition(" ")
    column, _, factor = column.partition(" x")
    word, _, rest = column.partition(" ")
    combine = COMBINED.get(word)
    path = find_file(root, name)
    with prefix_errors(path.relative_to(root)):
        rows = [find_row(path, where(path, one)) for one in selectors.split("; ")]
        parts = []
        for key in (rest if combine else column).split(" of "):
            values = [find_value(row, key) for row in rows]
            if any(value is None or (value == "" and form) for value in values):
                raise SurefootError(f"has no {key} in {selectors or 'its keys'}")
            values = [combine(map(float, values))] if combine else values
            parts.append([printed(value, form, float(factor or 1)) for value in values])
    return [" of ".join(texts) for texts in zip(*parts, strict=True)]


def printed(value: Any, form: str, factor: float) -> str:
    """Return a value in a format; without one as it is."""
    if not form:
        return value or "-" if isinstance(value, str) and factor == 1 else f"{float(value) * factor:.9g}"
    match = FORM.fullmatch(form)
    try:
        number = float(value) * factor
    except ValueError:
        raise SurefootError(f"is no number: {value}") from None
    digits = int(match[3] or 0)
    text = f"{round(number, digits) + 0.0:{match[1]}.{digits}f}"
    return text if match[2] else re.sub(r"^([+-]?)0\.", r"\1.", text)


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
            found = re.search(rf"{TOKEN}$", out)
            if found is None:
                raise SurefootError(f"no number stands before {match[0]}")
            of = " of episodes" if re.search(r"\sof\s", found[0]) and " of " not in match[1] else ""
            values = look_up(root, match[1] + of, form_of(found[0]))
            old = re.search(rf"{TOKEN}(?:,\s+{TOKEN}){{{len(values) - 1}}}$", out) or found
            if old[0].split() != (new := ", ".join(values)).split():
                out = out[: old.start()] + new
        out, end = out + match[0], match.end()
    return out + text[end:]


def write_table(root: Path, keys: str, lines: str) -> str:
    """Return the lines of a generated table."""
    whole = re.fullmatch(r"all of (\S+)", keys.strip())
    items = first_column(find_file(root, whole[1]))[1:] if whole else keys.strip().split(", ")
    table = []
    for line in lines.splitlines():
        for item in items if "{0}" in line else [""]:
            filled = line
            for number, part in enumerate(item.split(" = ")):
                filled = filled.replace(f"{{{number}}}", part)
            table.append(re.sub(r"\{([^{}]+)\}", lambda match: cell(root, match[1]), filled) + "\n")
    return "".join(table)


def cell(root: Path, content: str) -> str:
    """Return the text of a cell's source with its format."""
    source, _, form = content.rpartition(" ")
    return ", ".join(look_up(root, source, form) if FORM.fullmatch(form) else look_up(root, content, ""))


def write_page(root: Path, text: str) -> str:
    """Return a page with all numbers and tables as their sources have them.

    Raises:
        SurefootError: a marker or a table without a source; its line is named.
    """
    text = write_markers(root, text)
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
