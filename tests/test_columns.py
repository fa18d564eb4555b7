"""Declared columns: their shapes, invalid values, and rows of numbers."""

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
    """A record with two columns."""

    time: Array = column("T", "s", "time")
    force: Array = column("T, L, 3", "N", "force of the ground", "world", required=False)
    name: str = ""


def test_declared_columns_have_unit_frame_and_shape():
    assert list(columns_of(Pair)) == ["time", "force"]
    force = columns_of(Pair)["force"]
    assert (force.unit, force.frame, force.required) == ("N", "world", False)
    assert force.shape_for({"T": 7, "L": 4}) == (7, 4, 3)
    assert Pair().time.size == 0


@pytest.mark.parametrize("record", [EpisodeTrace, Recording])
def test_every_column_of_a_record_is_described(record: type):
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
def test_other_shapes_and_types_are_rejected(value: Any, message: str):
    with pytest.raises(SurefootError, match=message):
        columns_of(Pair)["force"].validate("force", value, {"T": 3, "L": 2})


def test_an_omitted_optional_column_is_nan():
    force = columns_of(Pair)["force"]
    assert np.isnan(force.validate("force", [], {"T": 3, "L": 2}, may_be_nan=True)).all()
    whole = force.validate("force", [[[1, 2, 3]]], {"T": 1, "L": 1})
    assert whole.dtype == np.float64
    assert not whole.flags.writeable


def test_rows_contain_columns_in_layout_order():
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
