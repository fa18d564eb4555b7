"""The paper on one page: each of its tables, figures and numbers beside surefoot's, read from files of results."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from surefoot.configuration import from_mapping, read_yaml
from surefoot.errors import SurefootError, accessible, located
from surefoot.evaluate.runs import Estimate
from surefoot.evaluate.statistics import Interval
from surefoot.files import check_readable, whole_file
from surefoot.report.html import page, picture, row

CONTENT = Path(__file__).with_name("paper.yaml")
NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Source:
    """Where a number of surefoot stands: in a row of a CSV file, or at a place in a JSON file."""

    file: str
    """Path from the root of the repository."""
    value: str
    """Column, or keys with dots between them."""
    where: dict[str, str] = field(default_factory=dict)
    """Columns that tell the row, and what they hold."""
    error: str = ""
    """Column or key of what stands behind a +-."""
    low: str = ""
    """Column or key of an interval's lower end."""
    high: str = ""
    """Column or key of its upper end."""
    scale: float = 1.0
    """Factor from the file's unit to the page's."""


@dataclass(frozen=True)
class Item:
    """One line of the comparison."""

    what: str
    """The quantity."""
    paper: float | str
    """The paper's number, or its words."""
    ours: Source | str
    """surefoot's number, or its words."""
    unit: str = ""
    digits: int = 2
    """Digits behind the point."""
    how: str = ""
    """How surefoot's was measured: episodes, seeds, what the interval is over."""


@dataclass(frozen=True)
class Picture:
    """A picture of surefoot beside a figure of the paper."""

    file: str
    """Path from the root of the repository."""
    caption: str


@dataclass(frozen=True)
class Section:
    """A table, figure or claim of the paper."""

    title: str
    paper: str
    """What the paper did and found."""
    ours: str = ""
    """What surefoot did otherwise and found."""
    commands: tuple[str, ...] = ()
    """Commands that make surefoot's numbers again."""
    items: tuple[Item, ...] = ()
    pictures: tuple[Picture, ...] = ()


@dataclass(frozen=True)
class Content:
    """Everything that the page says besides the numbers."""

    title: str
    about: str
    differences: tuple[str, ...]
    """The main differences between paper and surefoot."""
    sections: tuple[Section, ...]


def load_content() -> Content:
    """Return what the page says."""
    with located(CONTENT):
        return from_mapping(Content, read_yaml(CONTENT))


def write_page(root: Path, path: Path, note: str = "") -> list[str]:
    """Write the page; return the files that it wanted and that are not there.

    Args:
        root: folder with `results`, `docs` and `policies`.
        path: the page (.html).
        note: what holds for all results, told at the top.

    Raises:
        SurefootError: a file of results that can't be read, or has no such row or number.
    """
    content = load_content()
    missing: list[str] = []
    parts = [f"<h1>{escape(content.title)}</h1>", f"<p>{escape(content.about)}</p>", "<h2>Main differences</h2>"]
    if note:
        parts.insert(2, f"<p><b>{escape(note)}</b></p>")
    parts += ["<ul>", *(f"<li>{escape(text)}</li>" for text in content.differences), "</ul>"]
    parts += _all_differences(root)
    for section in content.sections:
        parts += [f"<h2>{escape(section.title)}</h2>", f"<p><b>Paper:</b> {escape(section.paper)}</p>"]
        if section.ours:
            parts.append(f"<p><b>surefoot:</b> {escape(section.ours)}</p>")
        if section.items:
            lines: list[tuple[str, ...]] = [("", "paper", "surefoot", "difference", "how measured")]
            lines += [_line(root, item, missing) for item in section.items]
            shown = [k for k in range(len(lines[0])) if any(line[k] for line in lines[1:])]
            kinds = "".join("tnntt"[k] for k in shown)
            rows = [row([line[k] for k in shown], kinds, "td" if i else "th") for i, line in enumerate(lines)]
            parts.append(f"<div class=wide><table>{''.join(rows)}</table></div>")
        for one in section.pictures:
            if (root / one.file).is_file():
                image = picture((root / one.file).read_bytes(), one.caption)
                parts.append(f"<figure>{image}<figcaption class=quiet>{escape(one.caption)}</figcaption></figure>")
            else:
                missing.append(one.file)
        parts += [f"<p><code>{escape(command)}</code></p>" for command in section.commands]
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        file.write(page(content.title, parts).encode())
    return missing


def _line(root: Path, item: Item, missing: list[str]) -> tuple[str, ...]:
    """Return the cells of an item's line."""
    number = None
    if isinstance(item.ours, str):
        text = item.ours
    elif not (root / item.ours.file).is_file():
        text = NOT_MEASURED
        missing.append(item.ours.file)
    else:
        number = find_number(root, item.ours)
        text = number.text(item.digits)
    paper = f"{item.paper:.{item.digits}f}" if isinstance(item.paper, float) else item.paper
    with_unit = (f"{one} {item.unit}".strip() if any(map(str.isdigit, one)) else one for one in (paper, text))
    return (item.what, *with_unit, difference(item.paper, number), item.how)


def find_number(root: Path, source: Source) -> Interval | Estimate:
    """Read a number of surefoot, with its error if the source names one, else with its interval if it names that.

    Raises:
        SurefootError: a file that can't be read, without such a row, or without a number there.
    """
    path = root / source.file
    with located(path):
        with accessible(path.name):
            check_readable(path)
            content = path.read_text(encoding="utf-8")
        data = _row(content, source.where) if path.suffix == ".csv" else _parsed(content)
        keys = (source.value, *filter(None, (source.error,) if source.error else (source.low, source.high)))
        numbers = [_at(data, key) * source.scale for key in keys]
    return Estimate(*numbers) if source.error else Interval(*numbers)


def _parsed(content: str) -> Any:
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        raise SurefootError("is not JSON") from None


def _row(content: str, where: dict[str, str]) -> dict[str, str]:
    rows = [one for one in csv.DictReader(content.splitlines()) if all(one.get(k) == v for k, v in where.items())]
    if len(rows) != 1:
        told = ", ".join(f"{key} {value}" for key, value in where.items())
        raise SurefootError(f"has {len(rows)} rows of {told}; there must be one")
    return rows[0]


def _at(data: Any, key: str) -> float:
    """Return a number: a column of a row, or at keys with dots between them."""
    for part in [key] if isinstance(data, dict) and key in data else key.split("."):
        data = data.get(part) if isinstance(data, dict) else None
    try:
        return float(data)
    except (TypeError, ValueError):
        raise SurefootError(f"has no number {key}") from None


def difference(paper: float | str, ours: Interval | Estimate | None) -> str:
    """Return the difference in words; nothing where there are not two numbers."""
    if ours is None or isinstance(paper, str):
        return ""
    if isinstance(ours, Interval) and ours.low <= paper <= ours.high:
        return "the interval holds the paper's"
    change = ours.mean / paper - 1 if paper else 0.0
    if abs(change) < 0.005:
        return "the same"
    return f"{abs(change):.0%} {'more' if change > 0 else 'less'}" if change < 2 else f"{1 + change:.1f} times as much"


def _all_differences(root: Path) -> list[str]:
    """Return the table of `docs/paper.md`, folded up."""
    path = root / "docs" / "paper.md"
    if not path.is_file():
        return []
    lines = [line.strip("|").split("|") for line in path.read_text(encoding="utf-8").splitlines() if line[:2] == "| "]
    cells = [[_inline(cell.strip()) for cell in line] for line in lines]
    rows = row(cells[0], "hhhh", "th") + "".join(row(line, "hhhh") for line in cells[1:] if len(line) == 4)
    return [f"<details><summary>Every difference</summary><table>{rows}</table></details>"]


def _inline(markdown: str) -> str:
    """Turn the bold type and code of a cell into HTML."""
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", escape(markdown))
    return re.sub(r"`(.+?)`", r"<code>\1</code>", text)
