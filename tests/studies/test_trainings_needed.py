"""Power analysis of the studies: the committed tables follow from the committed studies."""

from __future__ import annotations

import csv
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("pandas")

ROOT = Path(__file__).resolve().parents[2]
needed = SimpleNamespace(**runpy.run_path(str(ROOT / "benchmarks" / "trainings_needed.py")))


def test_power_grows_with_the_trainings_and_matches_published_tables():
    powers = [needed.welch_power(1.0, (1.0, 2.0), trainings, 0.05) for trainings in (2, 10, 40)]
    assert powers == sorted(powers)
    assert powers[-1] > 0.9
    # Only the tail in the direction of the difference counts.
    assert needed.welch_power(0.0, (1.0, 1.0), 5, 0.05) == pytest.approx(0.025)
    # Student's t with 17 per group has a power of 0.8 for a difference of one standard deviation (Cohen 1988).
    assert needed.welch_power(1.0, (1.0, 1.0), 17, 0.05) == pytest.approx(0.807, abs=0.002)


def test_the_committed_tables_follow_from_the_studies():
    with (ROOT / "results/paper/trainings_needed.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == list(needed.DIFFERENCES)
    for row in rows:
        made = needed.difference_row(row["name"])
        assert float(row["difference"]) == pytest.approx(made["difference"])
        assert [int(row[name]) for name in ("comparisons", "trainings", "needed")] == [
            made[name] for name in ("comparisons", "trainings", "needed")
        ]


@pytest.mark.parametrize("share", [0.6, 2 / 3, 0.9])
def test_a_majority_near_one_half_needs_more_trials(share: float):
    assert needed.majority(share) > needed.majority(share + 0.05)
