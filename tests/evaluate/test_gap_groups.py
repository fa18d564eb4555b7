"""Reality gaps of groups, from runs made up so that the right answer is known."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from surefoot.evaluate.comparison import Comparison
from surefoot.evaluate.gap_group_tables import gap_summary
from surefoot.evaluate.gap_groups import gap_difference, gap_groups
from surefoot.evaluate.tables import write_tables

MakeComparison = Callable[..., Comparison]


def test_the_top_policies_are_those_with_the_highest_return_at_home(gap_comparison: MakeComparison) -> None:
    best, every = gap_groups(gap_comparison(), 3), gap_groups(gap_comparison())
    assert best["a"].seeds == (4, 3, 2)
    assert every["a"].seeds == (0, 1, 2, 3, 4)
    assert len(best["a"].away) == 9
    assert len(every["a"].home) == 15
    # They are chosen by the episodes that the gap is not told by.
    first = gap_comparison().groups[0]
    results = {**first.seeds[0].results, "nominal": {"returns": [9.0], "speed": [1.0], "fell": [False]}}
    lucky = replace(first, seeds=(replace(first.seeds[0], results=results), *first.seeds[1:]))
    assert gap_groups(replace(gap_comparison(), groups=(lucky,)), 2)["a"].seeds == (0, 4)


def test_a_gap_has_an_error_over_runs_and_an_interval_over_policies_and_robots(
    gap_comparison: MakeComparison,
) -> None:
    group = gap_groups(gap_comparison(), 3)["a"]
    # Policies' gaps are 1.4, 1.3, 1.2 m and robots' 1.6, 1.3, 1.0 m: variances of the means are .01 / 3 and .09 / 3.
    np.testing.assert_allclose(group.gaps.mean(axis=1), [1.4, 1.3, 1.2])
    np.testing.assert_allclose(group.gaps.mean(axis=0), [1.6, 1.3, 1.0])
    assert group.interval.mean == pytest.approx(1.3)
    freedom = 1 / ((0.01 / 0.1) ** 2 / 2 + (0.09 / 0.1) ** 2 / 2)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(0.1 / 3)
    assert group.interval.high - 1.3 == pytest.approx(half, rel=1e-6)
    home = [level + d for level in (2.8, 2.6, 2.4) for d in (-0.1, 0.0, 0.1)]
    away = [level + d for level in (1.4, 1.3, 1.2) for d in (-0.3, 0.0, 0.3)]
    # With the robot as described, half of that is lost already.
    assert group.described.estimate("returns").mean == pytest.approx(2.6 - 0.65)
    assert group.gap.mean == pytest.approx(1.3)
    assert group.gap.error == pytest.approx(math.sqrt(np.var(home, ddof=1) / 9 + np.var(away, ddof=1) / 9))


def test_differences_of_gaps_join_the_errors_of_four_means(gap_comparison: MakeComparison) -> None:
    groups = gap_groups(gap_comparison(), 3)
    change = gap_difference(groups["a"], groups["b"])
    assert change.runs.mean == pytest.approx(-1.3)
    assert change.runs.error == pytest.approx(math.hypot(groups["a"].gap.error, groups["b"].gap.error))
    # The policies of b agree, and robots do what they do to both: all that varies are the three of a.
    assert change.crossed.mean == pytest.approx(-1.3)
    columns = groups["b"].gaps.mean(axis=0) - groups["a"].gaps.mean(axis=0)
    parts = [0.01 / 3, np.var(columns, ddof=1) / 3]
    freedom = sum(parts) ** 2 / sum(part**2 / 2 for part in parts)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(sum(parts))
    assert change.crossed.high + 1.3 == pytest.approx(half, rel=1e-6)


def test_tables_hold_groups_pairs_and_every_run(tmp_path: Path, gap_comparison: MakeComparison) -> None:
    write_tables(gap_comparison(), tmp_path)

    def rows(name: str) -> list[dict[str, str]]:
        with (tmp_path / name).open() as file:
            return list(csv.DictReader(file))

    groups = rows("gap_groups.csv")
    assert [(row["group"], row["policies"], row["seeds"], row["runs"]) for row in groups[:2]] == [
        ("a", "top", "4 3 2", "9"),
        ("a", "all", "0 1 2 3 4", "15"),
    ]
    assert float(groups[0]["gap"]) == pytest.approx(1.3)
    assert (groups[0]["home_balanced"], groups[0]["away_balanced"], groups[0]["away_far"]) == ("9", "5", "0")
    assert float(groups[0]["away_least_distance"]) == pytest.approx(1.4)
    made = rows("gap_runs.csv")
    # Three groups, five policies, three parts, three runs.
    assert len(made) == 3 * 5 * 3 * 3
    last = next(row for row in made if (row["group"], row["seed"], row["part"], row["run"]) == ("a", "0", "away", "2"))
    assert (last["top"], last["world"], last["steps"], last["balanced"], last["far"]) == (
        "0",
        "bullet",
        "250",
        "0",
        "0",
    )
    assert float(last["return"]) == pytest.approx(1.3)
    differences = rows("gap_differences.csv")
    assert [(row["policies"], row["group"], row["against"]) for row in differences] == [
        (which, other, "a") for which in ("top", "all") for other in ("b", "c")
    ]
    assert float(differences[0]["difference"]) == pytest.approx(-1.3)
    # Episodes of the kind "gap" are in its own tables, its figures are beside the others.
    assert {row["kind"] for row in rows("episodes.csv")} == {"nominal"}
    assert float(rows("runs.csv")[0]["gap"]) == pytest.approx(1.0)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["gap"]["top"]["groups"]["a"]["gap"]["mean"] == pytest.approx(1.3)
    assert len(summary["gap"]["all"]["differences"]) == 2


def test_one_policy_has_no_interval(gap_comparison: MakeComparison) -> None:
    study = gap_comparison(seeds=1)
    group = gap_groups(study, 3)["a"]
    assert not group.interval.known
    assert math.isfinite(group.gap.error)
    told = gap_summary(study)["top"]
    assert told["groups"]["a"]["gap_interval"] == {"mean": pytest.approx(1.0), "low": None, "high": None}
    json.dumps(told, allow_nan=False)
