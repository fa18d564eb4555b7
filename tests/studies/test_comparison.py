"""Reality gaps of groups, compared with hand-computed values."""

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

from surefoot.evaluation.statistics import crossed_interval
from surefoot.studies.comparison import Comparison, study_tables, write_tables

MakeComparison = Callable[..., Comparison]


def test_the_top_policies_have_the_highest_return_in_the_training_simulator(gap_comparison: MakeComparison) -> None:
    study = gap_comparison()
    best = study.best()
    assert best.select_group("a").seed.tolist() == [4, 3, 2]
    assert study.select_group("a").seed.tolist() == [0, 1, 2, 3, 4]
    assert (len(best.gap("a").in_world("bullet")), len(study.gap("a").home)) == (9, 15)
    # The episodes that select them are not those that measure the gap.
    lucky = study.policies.assign(nominal_return=[9.0, *study.policies.nominal_return[1:]])
    assert replace(study, policies=lucky).best().select_group("a").seed.tolist() == [0, 4, 3]


def test_a_gap_has_an_error_over_runs_and_an_interval_over_policies_and_robots(
    gap_comparison: MakeComparison,
) -> None:
    gap = gap_comparison().best().gap("a")
    # Gaps are 1.4, 1.3, 1.2 m by policy and 1.6, 1.3, 1.0 m by robot: variances of the means are 0.01 / 3 and 0.09 / 3.
    np.testing.assert_allclose(gap.gaps("bullet").mean(axis=1), [1.4, 1.3, 1.2])
    np.testing.assert_allclose(gap.gaps("bullet").mean(axis=0), [1.6, 1.3, 1.0])
    interval = crossed_interval(gap.gaps("bullet"))
    assert interval.mean == pytest.approx(1.3)
    freedom = 1 / ((0.01 / 0.1) ** 2 / 2 + (0.09 / 0.1) ** 2 / 2)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(0.1 / 3)
    assert interval.high - 1.3 == pytest.approx(half, rel=1e-6)
    home = [level + d for level in (2.8, 2.6, 2.4) for d in (-0.1, 0.0, 0.1)]
    away = [level + d for level in (1.4, 1.3, 1.2) for d in (-0.3, 0.0, 0.3)]
    # Half of the gap is already lost with the robot as described.
    assert gap.in_world("mujoco-described")["return"].mean() == pytest.approx(2.6 - 0.65)
    over_runs = gap.gap_over_runs("bullet")
    assert over_runs.mean == pytest.approx(1.3)
    assert over_runs.error == pytest.approx(math.sqrt(np.var(home, ddof=1) / 9 + np.var(away, ddof=1) / 9))


def test_differences_of_gaps_combine_the_errors_of_four_means(gap_comparison: MakeComparison) -> None:
    best = gap_comparison().best()
    a, b = best.gap("a"), best.gap("b")
    crossed = best.difference("b", "a", next(metric for metric in best.metrics if metric.name == "gap"))
    # The policies of b are equal and robot effects cancel: only the three policies of a vary.
    assert crossed.mean == pytest.approx(-1.3)
    columns = b.gaps("bullet").mean(axis=0) - a.gaps("bullet").mean(axis=0)
    parts = [0.01 / 3, np.var(columns, ddof=1) / 3]
    freedom = sum(parts) ** 2 / sum(part**2 / 2 for part in parts)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(sum(parts))
    assert crossed.high + 1.3 == pytest.approx(half, rel=1e-6)


def test_tables_have_groups_pairs_and_every_run(tmp_path: Path, gap_comparison: MakeComparison) -> None:
    study = gap_comparison()
    write_tables(study, study_tables(study), tmp_path)

    def rows(name: str) -> list[dict[str, str]]:
        with (tmp_path / name).open() as file:
            return list(csv.DictReader(file))

    groups = rows("gap_groups.csv")
    assert len(groups) == 3 * 2 * 3
    worlds = ["mujoco", "bullet", "mujoco-described"]
    assert [[row[name] for name in ("group", "policies", "seeds", "runs", "world")] for row in groups[:4]] == [
        *(["a", "all", "0 1 2 3 4", "15", world] for world in worlds),
        ["a", "top", "4 3 2", "9", "mujoco"],
    ]
    assert (groups[3]["gap"], float(groups[4]["gap"])) == ("", pytest.approx(1.3))
    assert (groups[3]["balanced"], groups[4]["balanced"], groups[4]["far"]) == ("9", "5", "0")
    assert float(groups[4]["least_distance"]) == pytest.approx(1.4)
    # Robot 0 never fell, robot 2 always: 7 of 15 runs were balanced, and the spread over robots leaves few trials.
    assert float(groups[1]["balanced_share"]) == pytest.approx(7 / 15)
    assert float(groups[1]["balanced_share_low"]) < 0.1
    episodes = rows("episodes.csv")
    # Three groups, five policies: twenty nominal episodes, and three in each of three worlds.
    assert len(episodes) == 3 * 5 * (20 + 3 * 3)
    (last,) = [
        row
        for row in episodes
        if [row[name] for name in ("group", "seed", "evaluation", "world", "run")] == ["a", "0", "gap", "bullet", "2"]
    ]
    assert float(last["return"]) == pytest.approx(1.3)
    assert (last["steps"], last["fell"], last["balanced"]) == ("250", "1", "0")
    differences = {(row["group"], row["figure"]): row for row in rows("top_differences.csv")}
    assert {row["against"] for row in differences.values()} == {"a"}
    assert float(differences["b", "gap"]["difference"]) == pytest.approx(-1.3)
    # Two comparisons: the smaller p value is doubled.
    p, corrected = ([float(differences[group, "gap"][name]) for group in "bc"] for name in ("p", "p_holm"))
    assert min(corrected) == pytest.approx(2 * min(p))
    everything = {(row["group"], row["figure"]): row for row in rows("differences.csv")}
    assert float(everything["b", "gap_away"]["difference"]) == pytest.approx(3.2 - 1.2)
    assert float(rows("policies.csv")[0]["gap"]) == pytest.approx(1.0)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["gap_groups"][4]["gap"] == pytest.approx(1.3)
    assert len(summary["top_differences"]) == 2 * 8


def test_one_policy_has_no_interval(gap_comparison: MakeComparison) -> None:
    row = study_tables(gap_comparison(seeds=1))["gap_groups"].iloc[1]
    assert row["gap"] == pytest.approx(1.0)
    assert math.isfinite(row["gap_error"])
    assert math.isnan(row["gap_low"])
    assert math.isnan(row["gap_high"])
