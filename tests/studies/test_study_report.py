"""Tables and report of a study, from synthetic results with known answers."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from run_tables import sensitivity_table

pytest.importorskip("matplotlib")

from surefoot.evaluation.sensitivity import make_test_worlds
from surefoot.evaluation.statistics import proportion_interval
from surefoot.report.figures.learning import bin_curve, learning_curve
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.randomization import Ranges
from surefoot.studies.comparison import Comparison, late_gain, policy_row, study_tables
from surefoot.studies.study_config import GroupConfig, StudyConfig
from surefoot.studies.study_report import report_from_tables, report_text, write_report
from surefoot.task.trace import EpisodeTrace

MakeRun = Callable[..., EpisodeTrace]
RANGES: Ranges = {"leg_mass_ratio": (0.8, 1.2), "control_latency": (0.0, 0.04), "voltage": (14.0, 16.8)}
WORLDS = make_test_worlds(RANGES, PhysicalParams.nominal(RobotDescription.load("minitaur")), 5)
NOMINAL = {"control_latency": 0.0, "voltage": 16.0}


def sensitivity(random: np.random.Generator, level: float, droop: float) -> dict[str, object]:
    """Return results whose returns decrease from the nominal value to the ends of each row's range."""
    place = np.array([(value - RANGES[row][0]) / np.ptp(RANGES[row]) for row, value, _ in WORLDS])
    mean = level - droop * (2 * place - 1) ** 2 * np.array([1 + (row == "control_latency") for row, *_ in WORLDS])
    returns = mean[:, None] + 0.1 * random.standard_normal((len(WORLDS), 4))
    nominal = NOMINAL, np.full(4, level), np.zeros(4, np.bool_)
    return sensitivity_table("", WORLDS, returns, returns < level - droop, nominal).to_mapping()


def row(group: str, seed: int, level: float, droop: float, steps: int, kinds: tuple[str, ...]) -> dict[str, Any]:
    random = np.random.default_rng(seed + int(1000 * level))
    log = [
        {"steps": at, "return_mean": level * at / steps + 0.1 * seed, "speed_mean": 0.5, "falls": 1, "episodes": 8}
        for at in range(steps // 100, steps + 1, steps // 100)
    ]
    log[-1]["seconds"] = steps / 8000
    runs = {"return": [level + 0.1 * seed] * 5, "speed": [0.5 + 0.01 * seed] * 5, "fell": [False] * 5}
    results = {
        "nominal": {"runs": runs},
        "table1": {"runs": {**runs, "fell": [number < seed for number in range(5)]}},
        "sensitivity": sensitivity(random, level + 0.1 * seed, droop),
    }
    return policy_row(group, seed, log, {kind: results[kind] for kind in kinds})


def comparison(
    kinds: tuple[str, ...] = ("nominal", "table1", "sensitivity"), seeds: tuple[int, ...] = (0, 1, 2)
) -> Comparison:
    groups = (
        ("small_plain", "4-D", 2.0, 1.0, 1_500_000),
        ("small_randomized", "4-D, randomized", 1.8, 0.3, 3_000_000),
        ("large_plain", "12-D", 2.3, 1.8, 1_500_000),
        ("large_randomized", "12-D, randomized", 1.9, 0.5, 3_000_000),
    )
    config = StudyConfig(
        groups={name: GroupConfig(label) for name, label, *_ in groups},
        name="robustness",
        evaluate=kinds,
        compare=(("small_plain", "small_randomized"), ("large_plain", "large_randomized")),
    )
    rows = [row(name, seed, *numbers, kinds) for name, _, *numbers in groups for seed in seeds]
    return Comparison(config, pd.DataFrame(rows))


@pytest.fixture(scope="module")
def study() -> Comparison:
    return comparison()


def test_bins_are_means_over_the_episodes_that_end_in_them() -> None:
    columns = {"return": [1.0, 3.0, np.nan, 5.0, 7.0], "episodes": [3, 1, 0, 2, 2]}
    curve = pd.DataFrame({"steps": [10.0, 20.0, 30.0, 40.0, 50.0], **columns})
    # An update belongs to the bin in which its steps end, including the bin's upper end.
    np.testing.assert_array_equal(bin_curve(curve, "return", [0, 20, 30, 50]), [1.5, np.nan, 6.0])
    assert late_gain(curve) == 7.0 - 5.0


def test_curve_of_a_log_counts_falls_over_episodes() -> None:
    rows = [
        {"steps": 8, "return_mean": None, "speed_mean": None, "episodes": 0, "falls": 0},
        {"steps": 16, "return_mean": 1.5, "speed_mean": 0.5, "episodes": 4, "falls": 1},
    ]
    curve = learning_curve(rows)
    np.testing.assert_array_equal(curve.falls, [np.nan, 25.0])
    np.testing.assert_array_equal(curve["return"], [np.nan, 1.5])
    assert curve.episodes.tolist() == [0, 4]
    assert np.isnan(late_gain(curve[:1]))


def test_tables_have_the_numbers_of_the_groups(study: Comparison) -> None:
    tables = study_tables(study)
    assert {name: len(rows) for name, rows in tables.items()} == {
        "policies": 4 * 3,
        "groups": 4 * (8 + 1),
        "differences": 2 * 8,
        "episodes": 4 * 3 * (2 * 5 + 4 * (1 + len(WORLDS))),
        "sensitivity": 4 * 3 * len(WORLDS),
    }
    policy = tables["policies"].iloc[1]
    assert [policy[name] for name in ("group", "seed", "nominal_return", "table1_falls")] == [
        "small_plain",
        1,
        2.1,
        20.0,
    ]
    groups = tables["groups"].set_index(["group", "figure"])
    group = groups.loc["small_randomized", "nominal_return"]
    # Seeds differ by 0.1 and 0.1: mean 1.9, standard deviation 0.1, t(0.975, 2) / sqrt 3 = 2.484138.
    assert (group["label"], group["unit"], group["seeds"]) == ("4-D, randomized", "m", 3)
    assert (group["mean"], group["low"], group["high"]) == pytest.approx((1.9, 1.6515862, 2.1484138))
    change = tables["differences"].iloc[1]
    assert [change[name] for name in ("group", "against")] == ["small_randomized", "small_plain"]
    assert change["figure"] == "nominal_return"
    # Difference 0.2 m, standard error 0.1 sqrt(2/3), t(0.975, 4) = 2.776445: half width 0.2267.
    ends = (-0.2, -0.4266957, 0.0266957)
    assert (change["difference"], change["difference_low"], change["difference_high"]) == pytest.approx(ends, abs=1e-6)


def cells(text: str, heading: str, start: str) -> list[str]:
    """Return the cells of a section's first line that begins with a text."""
    section = text.split(f"## {heading}\n")[1].split("\n## ")[0]
    (line, *_) = [line for line in section.splitlines() if line.startswith(f"| {start} |")]
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_report_has_tables_and_figures(tmp_path: Path, study: Comparison) -> None:
    text = write_report(study, tmp_path, "surefoot study studies/robustness.yaml").read_text()
    assert "surefoot study studies/robustness.yaml" in text
    assert cells(text, "Trainings", "4-D, randomized")[3] == "3,000,000"
    assert cells(text, "Results", "4-D")[2] == "2.10 [1.85, 2.35]"
    assert cells(text, "Comparisons", "4-D, randomized")[1:4] == ["4-D", "-0.20 [-0.43, +0.03]", "0.070"]
    assert "the study's file declares: 2; with p < 0.05 after Holm's correction for 2: 1." in text
    # Significant after correction is bold.
    section = text.split("## Differences")[1]
    heads = next(line for line in section.splitlines() if "standard deviation" in line).split(" | ")
    place = heads.index("standard deviation of return over test worlds (m)")
    change = [line.split(" | ")[place] for line in section.splitlines() if line.startswith("| 4-D, randomized |")][1]
    interval = re.fullmatch(r"\*\*(\S+) \[(\S+), (\S+)\]\*\*", change)
    assert interval is not None
    assert float(interval[2]) < float(interval[1]) < float(interval[3]) < 0
    assert "Not complete" not in text
    for file in re.findall(r"\]\(([^)]+)\)", text):
        assert (tmp_path / file).stat().st_size > 100, file
    # The tables are sufficient for the same text.
    assert report_from_tables(study.study, tmp_path, "surefoot study studies/robustness.yaml") == text
    with (tmp_path / "sensitivity.csv").open() as table:
        assert len(list(csv.DictReader(table))) == 4 * 3 * len(WORLDS)


def test_main_effects_are_means_over_pairs(tmp_path: Path) -> None:
    plain = comparison(("nominal", "table1"))
    pairs = (("small_plain", "small_randomized"), ("large_plain", "large_randomized"))
    study = replace(plain, study=replace(plain.study, effects={"randomization": pairs}))
    table = study_tables(study)["effects"].set_index("figure")
    # Percentages are left out.
    assert table.index.tolist() == ["nominal_speed", "nominal_return", "table1_speed"]
    effect = table.loc["nominal_return"]
    # Differences -0.2 and -0.4 m; standard error 0.1 sqrt(4/3) / 2, 8 degrees of freedom, t(0.975, 8) = 2.306004.
    half = 2.306004 * 0.1 / np.sqrt(3)
    ends = (-0.3, -0.3 - half, -0.3 + half)
    assert (effect["difference"], effect["difference_low"], effect["difference_high"]) == pytest.approx(ends, abs=1e-6)
    text = write_report(study, tmp_path, "command").read_text()
    assert "mean over 4-D, randomized less 4-D and 12-D, randomized less 12-D" in text
    assert cells(text, "Main effects", "randomization")[2] == "-0.30 [-0.43, -0.17], p < 0.001"
    assert report_from_tables(study.study, tmp_path, "command") == text
    # Without the policies of a group there is no effect.
    few = replace(study, policies=study.policies[study.policies.group != "large_plain"])
    assert "effects" not in study_tables(few)


def test_trials_in_test_worlds_are_counted(study: Comparison) -> None:
    falls = next(metric for metric in study.metrics if metric.name == "sensitivity_falls")
    result = study.policies.results.iloc[0]["sensitivity"]
    assert falls.count_trials(result) == 4 * len(WORLDS)
    group, values = study.groups[0], []
    for results in study.select_group(study.groups[0]).results:
        values.append(np.mean(results["sensitivity"]["episodes"]["fell"][-4 * len(WORLDS) :]))
    known, interval = proportion_interval(values, 4 * len(WORLDS)).scale(100), study.interval(group, falls)
    assert (interval.mean, interval.low, interval.high) == pytest.approx((known.mean, known.low, known.high))


def test_the_report_of_one_seed_has_no_intervals(tmp_path: Path) -> None:
    study = replace(comparison(("nominal",), seeds=(0,)), missing=("small_plain seed 1",))
    text = write_report(study, tmp_path, "command").read_text()
    assert cells(text, "Results", "4-D")[2] == "2.00"
    assert "**" not in "".join(cells(text, "Differences", "4-D, randomized"))
    assert "small_plain seed 1" in text.split("## Trainings")[0]
    assert report_from_tables(study.study, tmp_path, "command") == text


@pytest.mark.parametrize("seeds", [(0,), (0, 1)])
def test_episodes_of_one_or_two_policies_give_no_interval_of_falls(seeds: tuple[int, ...]) -> None:
    study = comparison(("nominal", "table1"), seeds)
    falls = next(metric for metric in study.metrics if metric.name == "table1_falls")
    for name in ("small_plain", "large_plain"):
        study.select_group(name).results.iloc[0]["table1"]["runs"]["fell"][:] = [True] * 5
    one = study.interval("small_plain", falls)
    assert one.mean == pytest.approx({1: 100.0, 2: 60.0}[len(seeds)])
    change = study.difference("small_randomized", "small_plain", falls)
    assert change.mean < -30
    assert not one.is_finite
    assert not change.is_finite
    assert math.isnan(change.p)


def test_pairs_without_policies_count_in_the_correction() -> None:
    study = comparison(("nominal",))
    table = study_tables(study)["differences"].set_index(["group", "figure"])
    part = replace(study, policies=study.policies[study.policies.group.str.startswith("small")])
    alone = study_tables(part)["differences"].set_index(["group", "figure"])
    place = ("small_randomized", "nominal_return")
    assert len(alone) == len(table) / 2
    assert alone.p[place] == table.p[place]
    assert alone.p[place] < 0.3
    assert alone.p_holm[place] == pytest.approx(2 * alone.p[place])
    assert "Comparisons that the study's file declares: 2; with" in report_text(part, study_tables(part), "command")


def test_returns_of_other_rewards_have_no_unit() -> None:
    study = comparison(("nominal", "sensitivity"))
    assert (study.return_unit, study.primary.heading) == ("m", "return, nominal (m)")
    steered = replace(study, study=replace(study.study, task="steer"))
    assert (steered.return_unit, steered.primary.heading) == ("", "return, nominal")
    assert [one.unit for one in steered.metrics if one.name in ("nominal_speed", "sensitivity_std")] == ["m/s", ""]
    tables = study_tables(steered)
    groups = tables["groups"]
    assert set(groups[groups.figure.isin(["nominal_return", "late_gain"])].unit) == {""}
    text = report_text(steered, tables, "command")
    assert "late gain of return |" in text
    assert "(m)" not in text


def test_the_report_names_gaits_and_draws_one_of_each_group(tmp_path: Path, make_run: MakeRun) -> None:
    plain = comparison(("nominal",), seeds=(0, 1))
    gait = {"gait": "pace", "agree": 4, "pattern": "walking pace", "reason": "", "stride": 0.4, "duty": None}
    policies = []
    for number, policy in enumerate(plain.policies.to_dict("records")):
        file = tmp_path / "runs" / str(number) / "policy.onnx"
        make_run().save(file.parent / "evaluations/gait/mujoco/run_000.npz")
        figures = {"gait": "pace", "pattern": "walking pace", "gait_agree": 4.0}
        policies.append(policy | figures | {"results": policy["results"] | {"gait": gait}, "policy": file})
    study = replace(plain.study, evaluate=("gait",))
    text = write_report(Comparison(study, pd.DataFrame(policies)), tmp_path / "out", "command").read_text()
    section = text.split("## Gaits")[1].split("## Files")[0]
    assert section.count("| pace | 4 of 5 | walking pace |") == 4 * 2
    assert "0.40 | - |" in section
    with (tmp_path / "out" / "policies.csv").open() as table:
        gaits = [(row["gait"], row["pattern"], row["gait_agree"]) for row in csv.DictReader(table)]
    assert gaits == [("pace", "walking pace", "4")] * (4 * 2)
    assert report_from_tables(study, tmp_path / "out", "command") == text
    for group in plain.groups:
        assert (tmp_path / "out" / f"gait_{group}.png").stat().st_size > 1000
        assert f"![Footfalls: {plain.study.label(group)}, seed 0](gait_{group}.png)" in section


def test_the_report_on_gaps(tmp_path: Path, gap_comparison: Callable[..., Comparison]) -> None:
    comparison = gap_comparison()
    text = write_report(comparison, tmp_path, "surefoot study gaps.yaml").read_text()
    assert report_from_tables(comparison.study, tmp_path, "surefoot study gaps.yaml") == text
    for file in re.findall(r"\]\(([^)]+)\)", text):
        assert (tmp_path / file).exists(), file
    for file in ("gap_both.png", "gap_others.png", "learning_curves_both.png"):
        assert f"]({file})" in text
    # A finding on a set is reported even if one of its groups has no policies yet.
    assert "In the paper: all was well." in text
    assert "- second, against first: the second did better." in text.split("## Trainings")[0]
    # All policies first, then the best.
    every, best = text.split("## Reality gap")[1].split("## Results")[0].split("## The best 3 policies")
    assert ("gap_both.png" in every, "gap_both_top.png" in best) == (True, True)
    assert "Seeds: first 4, 3, 2; " in best
    rows = [[line.split(" | ") for line in part.splitlines() if line.startswith("| first |")] for part in (every, best)]
    assert [[row[1] for row in part] for part in rows] == 2 * [["mujoco", "bullet", "mujoco-described"]]
    assert re.fullmatch(r"1\.20 \[-?\d\.\d\d, \d\.\d\d\]", rows[0][1][3])
    assert re.fullmatch(r"1\.30 ± 0\.\d\d", rows[1][1][3])
    assert re.fullmatch(r"47 \[\d+, \d+\]", rows[0][1][4])
    assert any(line.startswith("| second | first |") and "-1.30 [" in line for line in best.splitlines())
