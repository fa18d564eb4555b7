"""Declared columns: their shapes, what is refused, and rows of numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from surefoot.arrays import Array
from surefoot.columns import RowLayout, column, columns_of
from surefoot.errors import SurefootError
from surefoot.identify.recording import Recording
from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A record of two columns."""

    time: Array = column("T", "s", "time")
    force: Array = column("T, L, 3", "N", "force of the ground", "world", known=False)
    name: str = ""


def test_columns_are_the_declared_fields_with_sizes_of_a_record():
    assert list(columns_of(Pair)) == ["time", "force"]
    force = columns_of(Pair)["force"]
    assert (force.unit, force.frame, force.known) == ("N", "world", False)
    assert force.shape_for({"T": 7, "L": 4}) == (7, 4, 3)
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
        (np.zeros((3, 1, 3)), r"force has shape \(3, 1, 3\), but must have \(3, 2, 3\)"),
        (["a"], "force holds <U1, but must hold numbers"),
        ([], r"force has shape \(0,\)"),
    ],
)
def test_other_shapes_and_values_are_refused(value: Any, message: str):
    with pytest.raises(SurefootError, match=message):
        columns_of(Pair)["force"].checked("force", value, {"T": 3, "L": 2})


def test_a_column_that_is_left_out_is_nan_where_it_may_be():
    force = columns_of(Pair)["force"]
    assert np.isnan(force.checked("force", [], {"T": 3, "L": 2}, may_be_nan=True)).all()
    whole = force.checked("force", [[[1, 2, 3]]], {"T": 1, "L": 1})
    assert whole.dtype == np.float64
    assert not whole.flags.writeable


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
