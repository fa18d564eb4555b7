"""Numbers of results by name, for text: `evaluations trot/table1: falls of episodes` in results/evaluations.csv.

A source has the form FILE ROW: COLUMN. FILE is a CSV, JSON or TOML file without its suffix, in results/ or relative to
the root (policies/...). ROW is a value of the first column, or COLUMN=VALUE,COLUMN=VALUE, only for CSV files. COLUMN is
a column, or dotted keys of a JSON or TOML file, where list elements are numbered from 0. A factor may follow, as in
`share x100`. `N of M` combines two columns. `mean [low, high]` and `mean ± error` are several columns; brackets and ±
are left out if they are empty, as for a single policy.

Several rows, `A; B; C`, give several numbers; or one, if COLUMN begins with sum, mean, sd (with n - 1), min or max.
`all COLUMN=VALUE,COLUMN=VALUE` selects all rows with these values; without `all` there must be exactly one. `count` is
the number of rows, and `count COLUMN` the number of rows with each value in a column, such as `3 trot, 1 pace`.

In the braces of a text, a format follows: `.2` (two decimals), `0` (an integer), `+.2` (with sign). Without a format,
the file's text is printed unchanged, or - if it is empty.
"""

from __future__ import annotations

import csv
import json
import re
import statistics
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.files import check_readable

FORM = re.compile(r"([+]?)0?(?:\.(\d))?")
BRACES = re.compile(r"\{([^{}]+)\}")
COMBINED: dict[str, Callable[[Iterable[float]], float]] = {
    **{"sum": sum, "mean": statistics.fmean, "sd": statistics.stdev},
    **{"min": min, "max": max},
}
_SPREAD = re.compile(r"(.+?)(?: (?:\[(\S+), (\S+)\]|± (\S+)))?")


class NotMeasured(SurefootError):
    """A result file or row is missing, or a value is empty."""


def fill(root: Path, text: str) -> str:
    """Return a text with the sources in its braces filled in, such as `{evaluations trot: speed_mean .2} m/s`.

    Raises:
        SurefootError: a file is missing, or lacks the row or number.
    """
    return BRACES.sub(lambda match: cell(root, match[1]), text)


def substitute(text: str, item: str) -> str:
    """Return a text with {0}, {1}, ... replaced by the parts of an item, which ` = ` separates."""
    for number, part in enumerate(item.split(" = ")):
        text = text.replace(f"{{{number}}}", part)
    return text


def cell(root: Path, content: str) -> str:
    """Return the text of a source followed by its format."""
    source, _, form = content.rpartition(" ")
    return ", ".join(look_up(root, source, form) if FORM.fullmatch(form) else look_up(root, content, ""))


def look_up(root: Path, source: str, form: str) -> list[str]:
    """Return the texts of a source, one per row, with numbers in a format such as `.2`."""
    place, colon, column = " ".join(source.split()).rpartition(": ")
    if not colon:
        raise SurefootError(f"'{source}' is not a source of the form FILE ROW: COLUMN")
    name, _, selectors = place.partition(" ")
    counts = re.match(r"count\b", column)
    path = find_file(root, name, ("csv", "json") if selectors or counts else ("json", "toml", "csv"))
    with prefix_errors(path.relative_to(root)):
        if counts:
            return [count(read_rows(path, where(path, selectors)), column[6:])]
        column, _, factor = column.partition(" x")
        word, _, rest = column.partition(" ")
        # A column may itself be called mean, and have a spread.
        combine = COMBINED.get(word) if rest and rest[0] not in "[±" else None
        rows = [row for one in selectors.split("; ") for row in select_rows(path, one)]

        def texts(key: str) -> list[str]:
            """Return the text of a column in each row, which may be empty."""
            values = [find_value(row, key) for row in rows]
            if None in values:
                raise SurefootError(f"has no {key} in {selectors or 'its keys'}")
            if combine:
                if "" in values:
                    raise NotMeasured(f"has no {key} in a row of {selectors}")
                values = [combine(map(float, values))]
            empty = "" if form else "-"
            return [empty if value == "" else printed(value, form, float(factor or 1)) for value in values]

        match = _SPREAD.fullmatch(rest if combine else column)
        assert match is not None
        parts = [texts(key) for key in match[1].split(" of ")]
        if any("" in part for part in parts):
            raise NotMeasured(f"has no {match[1]} in {selectors or 'its keys'}")
        means = [" of ".join(one) for one in zip(*parts, strict=True)]
        if not (ends := [texts(key) for key in match.groups()[1:] if key]):
            return means
        spreads = [f" ± {one[0]}" if len(one) == 1 else f" [{', '.join(one)}]" for one in zip(*ends, strict=True)]
        empty = ["" in one for one in zip(*ends, strict=True)]
        return [mean if none else mean + spread for mean, spread, none in zip(means, spreads, empty, strict=True)]


def count(rows: list[dict[str, str]], column: str) -> str:
    """Return the number of rows, or the number of rows with each value in a column, the most frequent first."""
    if not column:
        return str(len(rows))
    if not rows or column not in rows[0]:
        raise SurefootError(f"has no column {column} in these rows")
    values = Counter(filter(None, (row[column] for row in rows)))
    return ", ".join(f"{number} {value}" for value, number in values.most_common())


def printed(value: Any, form: str, factor: float) -> str:
    """Return a value in a format, or unchanged without one."""
    if not form:
        return str(value) if isinstance(value, str) and factor == 1 else f"{float(value) * factor:.9g}"
    match = FORM.fullmatch(form)
    assert match is not None
    try:
        number = float(value) * factor
    except ValueError:
        raise SurefootError(f"is not a number: {value}") from None
    digits = int(match[2] or 0)
    return f"{round(number, digits) + 0.0:{match[1]}.{digits}f}"


def find_file(root: Path, name: str, kinds: Iterable[str] = ("csv", "json")) -> Path:
    """Return the result file with a name, of the first of the kinds that exists."""
    for path in (root / folder / f"{name}.{kind}" for folder in ("results", ".") for kind in kinds):
        if path.is_file():
            return path
    raise NotMeasured("results has no file " + " or ".join(f"{name}.{kind}" for kind in sorted(kinds)))


def where(path: Path, selector: str) -> dict[str, str]:
    """Return the column values that a row selector requires."""
    if "=" in selector:
        return dict(part.strip().split("=", 1) for part in selector.split(","))
    return {first_column(path)[0]: selector} if selector else {}


def first_column(path: Path) -> list[str]:
    """Return the first column of a CSV file, including its name."""
    return [row[0] for row in csv.reader(_read(path).splitlines())]


def select_rows(path: Path, selector: str) -> list[Any]:
    """Return the single row of a selector, or all rows for `all COLUMN=VALUE`."""
    one = selector.removeprefix("all ")
    if one == selector or "=" not in one:
        return [find_row(path, where(path, selector))]
    if not (rows := read_rows(path, where(path, one))):
        raise NotMeasured(f"has no rows of {one}")
    return rows


def find_row(path: Path, columns: dict[str, str]) -> Any:
    """Return the single row of a CSV file with given column values; the whole content of a JSON or TOML file.

    Raises:
        SurefootError: the file can't be read, or has no or several such rows.
    """
    if path.suffix == ".csv":
        rows = read_rows(path, columns)
        if len(rows) != 1:
            described = ", ".join(f"{key} {value}" for key, value in columns.items()) or "any kind"
            error = SurefootError if rows else NotMeasured
            raise error(f"has {len(rows)} rows of {described}; there must be one")
        return rows[0]
    loads = tomllib.loads if path.suffix == ".toml" else json.loads
    try:
        return loads(_read(path))
    except (ValueError, RecursionError):
        raise SurefootError(f"is not {path.suffix[1:].upper()}") from None


def read_rows(path: Path, columns: dict[str, str]) -> list[dict[str, str]]:
    """Return the rows of a CSV file with given column values."""
    rows = csv.DictReader(_read(path).splitlines())
    return [row for row in rows if all(row.get(column) == value for column, value in columns.items())]


def find_value(data: Any, key: str) -> Any:
    """Return the value in a column of a row, or at dotted keys; None if there is none."""
    for part in [key] if isinstance(data, dict) and key in data else key.split("."):
        if isinstance(data, list) and part.isdecimal() and int(part) < len(data):
            data = data[int(part)]
        else:
            data = data.get(part) if isinstance(data, dict) else None
    return data


def _read(path: Path) -> str:
    with describe_os_errors(path.name):
        check_readable(path)
        return path.read_text(encoding="utf-8")
