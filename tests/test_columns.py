"""Declared columns: their shapes, what is refused, and rows of numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from surefoot.arrays import Array
from surefoot.columns import RowLayout, as_column, check_values, column, columns_of
from surefoot.errors import SurefootError
from surefoot.identify.recording import Recording
from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A record of two columns."""

    time: Array = column("s", ("rows",), "time")
    force: Array = column("N", ("rows", "feet", 3), "force of the ground", "world", known=False)
    name: str = ""


def test_columns_are_the_declared_fields_with_sizes_of_a_record():
    assert list(columns_of(Pair)) == ["time", "force"]
    force = columns_of(Pair)["force"]
    assert (force.unit, force.frame, force.known) == ("N", "world", False)
    assert force.sized({"rows": 7, "feet": 4}) == (7, 4, 3)
    assert Pair().time.size == 0


@pytest.mark.parametrize("record", [EpisodeTrace, Recording])
def test_every_column_of_a_record_says_what_it_is(record: type):
    for name, one in columns_of(record).items():
        assert one.meaning, name
        for frame in ("world", "base"):
            assert (one.frame == frame) or not name.endswith(f"_{frame}"), name


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((3, 1)), r"force has shape \(3, 1\), but must have \(3, 2\)"),
        (["a"], "force holds <U1, but must hold numbers"),
        ([], r"force has shape \(0,\)"),
    ],
)
def test_other_shapes_and_values_are_refused(value: Any, message: str):
    with pytest.raises(SurefootError, match=message):
        as_column("force", value, (3, 2))


def test_a_column_that_is_left_out_is_nan_where_it_may_be():
    assert np.isnan(as_column("force", [], (3, 2), may_be_nan=True)).all()
    whole = as_column("force", [[1, 2]], (1, 2))
    assert whole.dtype == np.float64
    assert not whole.flags.writeable


def test_values_out_of_their_bounds_are_refused_with_their_row():
    with pytest.raises(SurefootError, match=r"force row 2 holds nan, but must be finite$"):
        check_values("force", np.array([0.0, 1.0, np.nan]), False, False)
    with pytest.raises(SurefootError, match="force row 1 holds inf, but must be finite or NaN"):
        check_values("force", np.array([np.nan, np.inf]), True, False)
    with pytest.raises(SurefootError, match="0 to 1"):
        check_values("force", np.array([np.nan, 1.1]), True, True)
    check_values("force", np.array([np.nan, 1.0]), True, True)


def test_rows_hold_columns_in_their_order():
    layout = RowLayout({"time": 1, "force": 6})
    force = np.arange(12.0).reshape(2, 2, 3)
    rows = layout.rows({"force": force, "time": np.array([0.1, 0.2])})
    assert rows.tolist() == [[0.1, *range(6)], [0.2, *range(6, 12)]]
    columns = layout.columns(rows)
    assert columns["time"].tolist() == [0.1, 0.2]
    assert columns["force"].shape == (2, 6)
    columns["force"][0] = 9.0
    assert rows[0, 1:].tolist() == [9.0] * 6  # views
    assert (layout.width, RowLayout({}).width) == (7, 0)
