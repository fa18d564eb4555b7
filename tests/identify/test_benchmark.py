"""The tables of `benchmarks/identification.py`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def draw(seed: int, identifiable: bool, estimate: float, low: float = 0.05, high: float = 3.0) -> dict[str, Any]:
    row = {
        "name": "contact_friction",
        "experiment": "contact",
        "index": None,
        "true": 1.2,
        "identifiable": identifiable,
    }
    return {
        "world": "mujoco", "seed": seed, "times": {"contact": (30.0, 5.0)},
        "values": [{**row, "estimate": estimate, "low": low, "high": high}],
    }  # fmt: skip


def test_values_that_are_not_identifiable_count_as_neither(monkeypatch):
    pytest.importorskip("mujoco")
    monkeypatch.syspath_prepend(BENCHMARKS)
    from identification import accuracy, estimates

    draws = [draw(1, True, 1.14, 1.1, 1.3), draw(2, True, 1.32, 1.25, 1.4), draw(901, False, math.nan)]
    table = {row["parameter"]: row for row in accuracy(estimates(draws), draws)}
    friction = table["contact_friction/contact"]
    assert [friction[key] for key in ("values", "identifiable", "inside")] == [3, 2, 1]
    assert friction["median"] == pytest.approx(0.09)
    assert friction["worst_percent"] == pytest.approx(10.0)
    assert [table["hidden"][key] for key in ("values", "identifiable", "inside")] == [3, 2, 1]
    assert table["fit_seconds"]["worst"] == 5.0
    assert "median" not in accuracy(estimates(draws[2:]), draws)[0]
