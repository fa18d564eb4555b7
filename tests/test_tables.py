"""Tables as CSV."""

from __future__ import annotations

from pathlib import Path

from surefoot.tables import read_csv, write_csv


def test_a_table_is_read_as_it_was_written(tmp_path: Path):
    path = tmp_path / "new" / "table.csv"
    rows = [{"name": "trot, slow", "speed": 1 / 3, "falls": 2, "idle": True}, {"name": "gallop", "speed": None}]
    assert write_csv(path, rows) == path
    assert read_csv(path) == [
        {"name": "trot, slow", "speed": "0.333333333", "falls": "2", "idle": "1"},
        {"name": "gallop", "speed": "", "falls": "", "idle": ""},
    ]


def test_a_missing_table_has_no_rows(tmp_path: Path):
    assert read_csv(tmp_path / "nothing.csv") == []
