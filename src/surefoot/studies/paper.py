"""The paper on one page: each of its tables, figures and numbers beside surefoot's, read from files of results."""

from __future__ import annotations

import csv
import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from surefoot.configuration import from_mapping, read_yaml
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.evaluation.statistics import Interval, MeanEstimate
from surefoot.files import atomic_write, check_readable
from surefoot.report.pages.html import page, picture, row

CONTENT = Path(__file__).with_name("paper.yaml")
NOT_MEASURED = "not measured"
_MAX_NUMBER = 30
"""Characters of a cell beside numbers; a longer one is folded as text."""


@dataclass(frozen=True)
class NumberSource:
    """Place of a number of surefoot: in a row of a CSV file, or at keys of a JSON file."""

    file: str
    """Path from the root of the repository."""
    value: str
    """Column, or keys with dots between them."""
    where: dict[str, str] = field(default_factory=dict)
    """Values of the columns that identify the row."""
    error: str = ""
    """Column or key of the standard error."""
    low: str = ""
    """Column or key of an interval's lower end."""
    high: str = ""
    """Column or key of its upper end."""
    scale: float = 1.0
    """Factor from the file's unit to the page's."""


@dataclass(frozen=True)
class ValueCounts:
    """How often each value stands in a column of a CSV file; empty cells do not count."""

    file: str
    """Path from the root of the repository."""
    count: str
    where: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class PaperItem:
    """One line of the comparison."""

    what: str
    paper: float | str
    """The paper's number, or its words."""
    surefoot: NumberSource | ValueCounts | str
    """surefoot's number, counts or words."""
    unit: str = ""
    digits: int = 2
    how: str = ""
    """How surefoot's was measured: episodes, seeds, what the interval is over."""


@dataclass(frozen=True)
class PaperPicture:
    """A picture of surefoot beside a figure of the paper."""

    file: str
    """Path from the root of the repository; with a * in it, a picture for each file that matches."""
    caption: str
    """Caption; a * is replaced by the text that matches that of the path."""

    def find_files(self, root: Path) -> list[tuple[Path, str]]:
        """Return the files that are there, each with its caption."""
        start, _, end = self.file.partition("*")
        paths = [path for path in sorted(root.glob(self.file)) if path.is_file()]
        names = [path.relative_to(root).as_posix().removeprefix(start).removesuffix(end) for path in paths]
        return [(path, self.caption.replace("*", name)) for path, name in zip(paths, names, strict=True)]


@dataclass(frozen=True)
class PaperSection:
    """A table, figure or claim of the paper."""

    title: str
    paper: str
    """Method and result of the paper."""
    surefoot: str = ""
    """Differences in surefoot's method, and its result."""
    commands: tuple[str, ...] = ()
    """Commands that reproduce surefoot's numbers."""
    items: tuple[PaperItem, ...] = ()
    pictures: tuple[PaperPicture, ...] = ()


@dataclass(frozen=True)
class PaperContent:
    """All text of the page."""

    title: str
    about: str
    differences: tuple[str, ...]
    """The main differences between paper and surefoot."""
    sections: tuple[PaperSection, ...]


def load_content() -> PaperContent:
    """Return the text of the page."""
    with prefix_errors(CONTENT):
        return from_mapping(PaperContent, read_yaml(CONTENT))


def write_page(root: Path, path: Path, note: str = "") -> list[str]:
    """Write the page; return the files of results that are missing.

    Args:
        root: folder with `results`, `docs` and `policies`.
        path: the page (.html).
        note: remark on all results, at the top.

    Raises:
        SurefootError: a file of results that can't be read, or has no such row or number.
    """
    content = load_content()
    missing: list[str] = []
    parts = [
        f"<h1>{escape(content.title)}</h1>",
        f"<p>{escape(content.about)}</p>",
    ]
    parts.append(_contents([section.title for section in content.sections]))
    parts.append("<h2>Main differences</h2>")
    if note:
        parts.insert(2, f"<p><b>{escape(note)}</b></p>")
    parts += ["<ul>", *(f"<li>{escape(text)}</li>" for text in content.differences), "</ul>"]
    parts += _all_differences(root)
    for number, section in enumerate(content.sections, start=1):
        parts += [f'<h2 id="s{number}">{escape(section.title)}</h2>', f"<p><b>Paper:</b> {escape(section.paper)}</p>"]
        if section.surefoot:
            parts.append(f"<p><b>surefoot:</b> {escape(section.surefoot)}</p>")
        if section.items:
            lines: list[tuple[str, ...]] = [("", "paper", "surefoot", "difference", "how measured")]
            lines += [_line(root, item, missing) for item in section.items]
            columns = [k for k in range(len(lines[0])) if any(line[k] for line in lines[1:])]
            cells = [[line[k] for k in columns] for line in lines]
            kinds = [
                "".join("n" if k in (1, 2) and len(line[k]) < _MAX_NUMBER else "t" for k in columns) for line in lines
            ]
            rows = [row(*both, "td" if i else "th") for i, both in enumerate(zip(cells, kinds, strict=True))]
            parts.append(f"<div class=wide><table>{''.join(rows)}</table></div>")
        for one in section.pictures:
            files = one.find_files(root)
            for source, caption in files:
                image = picture(source.read_bytes(), caption)
                parts.append(f"<figure>{image}<figcaption class=quiet>{escape(caption)}</figcaption></figure>")
            if not files:
                missing.append(one.file)
        parts += [f"<p><code>{escape(command)}</code></p>" for command in section.commands]
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, page(content.title, parts))
    return list(dict.fromkeys(missing))


def _contents(titles: Sequence[str]) -> str:
    """Return the list of contents: links to the sections."""
    links = (f'<li><a href="#s{number}">{escape(title)}</a></li>' for number, title in enumerate(titles, start=1))
    return f"<nav aria-label=Contents><ul>{''.join(links)}</ul></nav>"


def _line(root: Path, item: PaperItem, missing: list[str]) -> tuple[str, ...]:
    """Return the cells of an item's line."""
    number = None
    if isinstance(item.surefoot, str):
        text = item.surefoot
    elif not (root / item.surefoot.file).is_file():
        text = NOT_MEASURED
        missing.append(item.surefoot.file)
    elif isinstance(item.surefoot, ValueCounts):
        text = find_counts(root, item.surefoot)
    else:
        number = find_number(root, item.surefoot)
        text = number.text(item.digits)
    paper = f"{item.paper:.{item.digits}f}" if isinstance(item.paper, float) else item.paper
    with_unit = (f"{one} {item.unit}".strip() if any(map(str.isdigit, one)) else one for one in (paper, text))
    return (item.what, *with_unit, difference(item.paper, number), item.how)


def find_number(root: Path, source: NumberSource) -> Interval | MeanEstimate:
    """Read a number of surefoot, with its error if the source names one, else with its interval if it names that.

    Error and ends of an interval may be empty, as they are for a single policy.

    Raises:
        SurefootError: a file that can't be read, without such a row, or without a number there.
    """
    path = root / source.file
    with prefix_errors(path):
        data = find_row(path, source.where)
        keys = filter(None, (source.error,) if source.error else (source.low, source.high))
        ends = [math.nan if isinstance(data, dict) and data.get(key) == "" else _number(data, key) for key in keys]
        mean, *spread = (number * source.scale for number in (_number(data, source.value), *ends))
    if source.error:
        return MeanEstimate(mean, *spread)
    low, high = spread or (math.nan, math.nan)
    return Interval(mean, low, high)


def find_counts(root: Path, counts: ValueCounts) -> str:
    """Return how often each value is there, the most frequent first, such as `3 trot, 1 pace`.

    Raises:
        SurefootError: a file that can't be read, or without such a column in such rows.
    """
    path = root / counts.file
    with prefix_errors(path):
        rows = _read_rows(path, counts.where)
        if not rows or rows[0].get(counts.count) is None:
            raise SurefootError(f"has no column {counts.count} in rows of {_describe(counts.where)}")
    values = Counter(filter(None, (row[counts.count] for row in rows)))
    return ", ".join(f"{number} {value}" for value, number in values.most_common())


def find_row(path: Path, where: dict[str, str]) -> Any:
    """Return the one row of a CSV file with these values of columns; all of a JSON file.

    Raises:
        SurefootError: a file that can't be read, or not just one such row.
    """
    if path.suffix == ".csv":
        rows = _read_rows(path, where)
        if len(rows) != 1:
            raise SurefootError(f"has {len(rows)} rows of {_describe(where)}; there must be one")
        return rows[0]
    try:
        return json.loads(_read(path))
    except (ValueError, RecursionError):
        raise SurefootError("is not JSON") from None


def find_value(data: Any, key: str) -> Any:
    """Return what is in a column of a row, or at keys with dots between them; None without such a key."""
    for part in [key] if isinstance(data, dict) and key in data else key.split("."):
        data = data.get(part) if isinstance(data, dict) else None
    return data


def _read(path: Path) -> str:
    with describe_os_errors(path.name):
        check_readable(path)
        return path.read_text(encoding="utf-8")


def _read_rows(path: Path, where: dict[str, str]) -> list[dict[str, str]]:
    """Return the rows of a CSV file with these values of columns."""
    rows = csv.DictReader(_read(path).splitlines())
    return [row for row in rows if all(row.get(column) == value for column, value in where.items())]


def _describe(where: dict[str, str]) -> str:
    return ", ".join(f"{key} {value}" for key, value in where.items()) or "any kind"


def _number(data: Any, key: str) -> float:
    """Return the number in a column of a row, or at keys with dots between them."""
    try:
        return float(find_value(data, key))
    except (TypeError, ValueError):
        raise SurefootError(f"has no number {key}") from None


def difference(paper: float | str, reproduced: Interval | MeanEstimate | None) -> str:
    """Return the difference in words; nothing where there are not two numbers."""
    if reproduced is None or isinstance(paper, str):
        return ""
    if isinstance(reproduced, Interval) and reproduced.low <= paper <= reproduced.high:
        return "the interval holds the paper's"
    change = reproduced.mean / paper - 1 if paper else 0.0
    if abs(change) < 0.005:
        return "the same"
    return f"{abs(change):.0%} {'more' if change > 0 else 'less'}" if change < 2 else f"{1 + change:.1f} times as much"


def _all_differences(root: Path) -> list[str]:
    """Return the table of `docs/paper.md`, collapsed."""
    path = root / "docs" / "paper.md"
    if not path.is_file():
        return []
    heads: list[str] = []

    def join(match: re.Match[str]) -> str:
        heads.append(match[2])
        return f"| **{match[1]}** | | | |\n"

    # Every section's table has a head of its own; here the sections are rows of one table.
    text = re.sub(r"^## (.+)\n\n(\| .*)\n", join, path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    lines = [line.strip("|").split("|") for line in [*heads[:1], *text.splitlines()] if line[:2] == "| "]
    cells = [[_inline(cell.strip()) for cell in line] for line in lines]
    rows = row(cells[0], "hhhh", "th") + "".join(row(line, "hhhh") for line in cells[1:] if len(line) == 4)
    return [f"<details><summary>Every difference</summary><table>{rows}</table></details>"]


def _inline(markdown: str) -> str:
    """Convert bold type and code of a cell to HTML."""
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", escape(markdown))
    return re.sub(r"`(.+?)`", r"<code>\1</code>", text)
