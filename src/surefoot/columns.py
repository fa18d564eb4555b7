"""Columns of records, each declared once, where the record has it.

    motor_angle: Array = column("T, M", "rad", "angle that the encoder measured")

Checks, rows of numbers that are written one by one, and the page of the docs are made from the declarations.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError


@dataclass(frozen=True)
class Column:
    """Declaration of a column of a record."""

    shape: str
    """Its sizes, that of the rows first: numbers, and letters for sizes that differ between records, such as "T, M"."""
    unit: str
    """Unit; 1 for ratios and counts, empty for columns of mixed units."""
    meaning: str
    """What it is."""
    frame: str = ""
    """Frame of vectors: base, heading or world; empty for columns without a frame."""
    known: bool = True
    """Whether every record has the column; other columns may hold NaN, and are all NaN where they are left out."""
    always_in_file: bool = True
    """Whether a file has the column even if all of it is NaN."""
    is_fraction: bool = False
    """Whether values lie between 0 and 1."""

    def shape_for(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Return the shape for sizes by letter."""
        return tuple(int(size) if size.isdigit() else sizes[size] for size in self.shape.split(", "))

    def checked(self, name: str, value: ArrayLike, sizes: Mapping[str, int], may_be_nan: bool = False) -> Array:
        """Return a read-only copy in double precision; all NaN for a value that is left out, if it may be.

        Raises:
            SurefootError: values that are no numbers, or another shape.
        """
        array, shape = np.asarray(value), self.shape_for(sizes)
        if array.dtype.kind not in "biuf":
            raise SurefootError(f"{name} holds {array.dtype}, but must hold numbers")
        if may_be_nan and not array.size:
            array = np.full(shape, np.nan)
        if array.shape != shape:
            raise SurefootError(f"{name} has shape {array.shape}, but must have {shape}")
        array = array.astype(np.float64)
        array.setflags(write=False)
        return array


def column(shape: str, unit: str, meaning: str, frame: str = "", **options: bool) -> Any:
    """Declare a field of a record as a column, which is empty where it is left out; see `Column`."""
    declared = Column(shape, unit, meaning, frame, **options)
    return field(default_factory=lambda: np.empty(0), metadata={"column": declared})


@functools.cache
def columns_of(record: type) -> dict[str, Column]:
    """Return the declared columns of a record's class, by name."""
    return {item.name: item.metadata["column"] for item in fields(record) if "column" in item.metadata}


@dataclass(frozen=True)
class RowLayout:
    """Columns beside each other in rows of numbers."""

    widths: dict[str, int]
    """Numbers of each column in a row, by name and in the row's order."""

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return sum(self.widths.values())

    def columns(self, rows: Array) -> dict[str, Array]:
        """Return rows (T, width) as views by name, (T,) or (T, n)."""
        parts = np.split(rows, np.cumsum(list(self.widths.values()))[:-1], axis=1)
        return {
            name: part[:, 0] if width == 1 else part
            for (name, width), part in zip(self.widths.items(), parts, strict=True)
        }

    def rows(self, columns: Mapping[str, Any]) -> Array:
        """Return columns (N, ...) by name as rows (N, width)."""
        rows = np.empty((len(next(iter(columns.values()))), self.width))
        for name, part in self.columns(rows).items():
            part[:] = np.reshape(columns[name], part.shape)
        return rows
