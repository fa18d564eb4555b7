"""Columns of recorded data (traces, recordings), each declared once as a field of the record's dataclass.

    motor_angle: Array = column("T, M", "rad", "angle that the encoder measured")

Validation, the layout of rows that are written one at a time, and the table in the documentation use the declarations.
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
    """Sizes of its axes, rows first: numbers, or letters for sizes that differ between records, such as "T, M"."""
    unit: str
    """Unit; "1" for ratios and counts, empty for columns of mixed units."""
    meaning: str
    """Description of the quantity, for the documentation."""
    frame: str = ""
    """Frame of vectors: base, heading or world; empty for columns without a frame."""
    required: bool = True
    """Whether every record must have the column; other columns may contain NaN, and are all NaN if they are omitted."""
    always_in_file: bool = True
    """Whether the column is written to files even if it is all NaN."""
    is_fraction: bool = False
    """Whether values must be between 0 and 1."""

    def shape_for(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Return the shape for given sizes, by letter."""
        return tuple(int(size) if size.isdigit() else sizes[size] for size in self.shape.split(", "))

    def validate(self, name: str, value: ArrayLike, sizes: Mapping[str, int], may_be_nan: bool = False) -> Array:
        """Return a read-only copy in double precision; all NaN for an empty value if `may_be_nan`.

        Raises:
            SurefootError: the values are not numeric, or have another shape.
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
    """Declare a field of a record as a column, an empty array by default; for the arguments see `Column`."""
    declaration = Column(shape, unit, meaning, frame, **options)
    return field(default_factory=lambda: np.empty(0), metadata={"column": declaration})


@functools.cache
def columns_of(record: type) -> dict[str, Column]:
    """Return the declared columns of a record class, by name."""
    return {item.name: item.metadata["column"] for item in fields(record) if "column" in item.metadata}


@dataclass(frozen=True)
class RowLayout:
    """Layout of several columns side by side in the rows of one array."""

    widths: dict[str, int]
    """Width of each column (numbers per row), by name, in order."""

    @property
    def width(self) -> int:
        """Total numbers per row."""
        return sum(self.widths.values())

    def columns(self, rows: Array) -> dict[str, Array]:
        """Split rows (T, width) into views by column name, (T,) or (T, n)."""
        parts = np.split(rows, np.cumsum(list(self.widths.values()))[:-1], axis=1)
        return {
            name: part[:, 0] if width == 1 else part
            for (name, width), part in zip(self.widths.items(), parts, strict=True)
        }

    def rows(self, columns: Mapping[str, Any]) -> Array:
        """Join columns (N, ...) by name into rows (N, width)."""
        rows = np.empty((len(next(iter(columns.values()))), self.width))
        for name, part in self.columns(rows).items():
            part[:] = np.reshape(columns[name], part.shape)
        return rows
