"""Tables (lists of rows or data frames) written as CSV or Markdown, or printed to a terminal."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surefoot.files import atomic_write

if TYPE_CHECKING:
    import pandas as pd

Rows = Sequence[Mapping[str, object]]
"""Rows of a table; all have the same columns as the first."""


def with_unit(text: str, unit: str) -> str:
    """Return a heading with its unit, such as `speed (m/s)`; only the text if `unit` is empty."""
    return f"{text} ({unit})" if unit else text


def plain_value(value: object) -> object:
    """Return a value for JSON: None for a number that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def plain_rows(table: Rows | pd.DataFrame) -> list[dict[str, object]]:
    """Return the rows of a table for JSON, see `plain_value`."""
    rows: Rows = table if isinstance(table, Sequence) else table.to_dict("records")
    return [{name: plain_value(value) for name, value in row.items()} for row in rows]


def write_csv(path: str | Path, table: Rows | pd.DataFrame) -> Path:
    """Write a table as CSV atomically; its folder is created if necessary. Return the path.

    Numbers have nine significant digits, booleans are 0 or 1, and missing values (None or NaN) are empty.
    """
    import pandas as pd

    frame = pd.DataFrame(table).convert_dtypes()
    frame = frame.astype(dict.fromkeys(frame.select_dtypes("boolean"), "Int8"))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, frame.to_csv(index=False, float_format="%.9g", lineterminator="\n"))
    return path


def read_csv(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a CSV file, all values as text; empty if the file is missing."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def markdown(rows: Rows) -> str:
    """Return rows as a Markdown table; all columns except the first are right-aligned."""
    header = list(rows[0])
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *([str(row[name]) for name in header] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def print_table(rows: Rows, title: str = "", text_columns: int = 1) -> None:
    """Print rows (at least one) to standard output, with numbers right-aligned; lines are not wrapped in a file.

    The first `text_columns` columns contain text, which may be wrapped on a terminal.
    """
    from rich import box
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table

    console = Console()
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for number, column in enumerate(rows[0]):
        if number < text_columns:
            table.add_column(column, overflow="fold")
        else:
            table.add_column(column.replace(" (", "\n("), justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*map(str, row.values()))
    if not console.is_terminal:
        console.width = max(console.width, Measurement.get(console, console.options.update(width=1000), table).maximum)
    console.print(table)


def print_files(files: Sequence[Path], folder: Path) -> None:
    """Print one line with the names of written files, relative to a folder."""
    from rich.console import Console

    message = f"wrote {folder}: {', '.join(str(file.relative_to(folder)) for file in files)}"
    Console().print(message, highlight=False, markup=False, soft_wrap=True)
