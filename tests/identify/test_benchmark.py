"""The summary of `benchmarks/identification.py`."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "identification.py"


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


def test_summary_counts_unidentifiable_values_apart():
    pytest.importorskip("mujoco")
    spec = importlib.util.spec_from_file_location("identification_benchmark", SCRIPT)
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    open_draw = draw(901, False, math.nan)
    text = benchmark.summary([draw(1, True, 1.14, 1.1, 1.3), open_draw])
    assert "nan" not in text
    (row,) = (line.split() for line in text.splitlines() if line.startswith("contact_friction"))
    assert row == ["contact_friction", "contact", "2", "1", "1", "0.060000", "5.00%", "0.060000"]
    assert "hidden values within their 95 % intervals: 1 of 1, 100.0 %; 1 not identifiable" in text
    text = benchmark.summary([open_draw])
    assert "nan" not in text
    assert "hidden values within their 95 % intervals: 0 of 0; 1 not identifiable" in text
