"""Figures and report of a study, from results made up so that the right answer is known."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
from PIL import Image

from surefoot.errors import SurefootError
from surefoot.evaluate.comparison import Comparison, Curve, GroupResult, SeedResult
from surefoot.evaluate.sensitivity import make_test_worlds
from surefoot.evaluate.tables import write_tables
from surefoot.report.study_figures import (
    group_figure,
    learning_curves,
    parameter_figure,
    parameters_figure,
)
from surefoot.report.study_report import report_text, write_report
from surefoot.task.randomize import load_ranges

RANGES = load_ranges("table1")
WORLDS = make_test_worlds(RANGES, 10)
NOMINAL = {"latency": 0.0, "voltage": 16.0, "mass": 1.0, "control_step": 0.006, "contact_friction": 1.0}


def sensitivity(random: np.random.Generator, level: float, droop: float) -> dict[str, object]:
    """Returns that fall from the nominal value to the ends of each row's range."""
    place = np.array([(w.value - RANGES.ranges[w.row][0]) / np.ptp(RANGES.ranges[w.row]) for w in WORLDS])
    mean = level - droop * (2 * place - 1) ** 2 * np.array([1 + (w.row == "latency") for w in WORLDS])
    returns = mean[:, None] + 0.1 * random.standard_normal((len(WORLDS), 4))
    return {
        "worlds": [[w.row, w.value] for w in WORLDS],
        "returns": returns.tolist(),
        "fell": (returns < level - droop).tolist(),
        "speed": (returns / 6).tolist(),
        "nominal": {"values": NOMINAL, "returns": [level] * 4, "fell": [False] * 4, "speed": [level / 6] * 4},
    }


def seed_result(seed: int, level: float, droop: float, steps: int, kinds: tuple[str, ...]) -> SeedResult:
    random = np.random.default_rng(seed + int(1000 * level))
    at = np.arange(8192, steps + 8192, 8192, dtype=float)
    progress = 1 - np.exp(-3 * at / steps)
    curve = Curve(
        at,
        level * progress + 0.12 * random.standard_normal(len(at)) + 0.1 * seed,
        0.5 * progress + 0.02 * random.standard_normal(len(at)),
        60 * (1 - progress) + 3 * random.uniform(size=len(at)),
        np.full(len(at), 8.0),
    )
    episodes = {"returns": [level + 0.1 * seed] * 5, "speed": [0.5 + 0.01 * seed] * 5, "fell": [False] * 5}
    drawn = {**episodes, "fell": [number < seed for number in range(5)]}
    made = {
        "nominal": episodes,
        "table1": drawn,
        "sensitivity": sensitivity(random, level + 0.1 * seed, droop),
    }
    return SeedResult(seed, steps, steps / 8000, curve, {kind: made[kind] for kind in kinds})


def comparison(
    kinds: tuple[str, ...] = ("nominal", "table1", "sensitivity"), seeds: tuple[int, ...] = (0, 1, 2)
) -> Comparison:
    groups = (
        ("small_plain", "4-D", 2.0, 1.0, 1_500_000),
        ("small_randomized", "4-D, randomized", 1.8, 0.3, 3_000_000),
        ("large_plain", "12-D", 2.3, 1.8, 1_500_000),
        ("large_randomized", "12-D, randomized", 1.9, 0.5, 3_000_000),
    )
    return Comparison(
        "robustness",
        kinds,
        tuple(
            GroupResult(name, label, tuple(seed_result(seed, level, droop, steps, kinds) for seed in seeds))
            for name, label, level, droop, steps in groups
        ),
        (("small_plain", "small_randomized"), ("large_plain", "large_randomized")),
    )


@pytest.fixture(scope="module")
def study() -> Comparison:
    return comparison()


def is_picture(path: Path, width: int) -> bool:
    with Image.open(path) as image:
        image.load()
        colors = len(image.convert("RGB").getcolors(1 << 24))
        return image.width > width and colors > 20


def test_figures_are_written_for_one_seed_too(tmp_path: Path) -> None:
    study = comparison(seeds=(4,))
    for draw in (learning_curves, group_figure, parameters_figure):
        assert is_picture(draw(study, tmp_path / f"{draw.__name__}.png"), 1000)
    assert is_picture(parameter_figure(study, "latency", tmp_path / "latency.png"), 1000)


def test_a_group_that_is_not_far_yet_is_drawn_beside_the_others(tmp_path: Path, study: Comparison) -> None:
    one = study.groups[0].seeds[0]
    first = slice(0, 1)
    nothing = np.array([np.nan])
    curve = Curve(one.curve.steps[first], nothing, nothing, nothing, np.zeros(1))
    young = replace(study.groups[0], seeds=(replace(one, curve=curve),))
    assert is_picture(learning_curves(replace(study, groups=(young, *study.groups[1:])), tmp_path / "a.png"), 1000)
    assert "too few episodes ended" in report_text(replace(study, groups=(young,)), "command")


def test_figures_of_what_was_not_evaluated_are_refused(tmp_path: Path) -> None:
    study = comparison(("nominal",))
    with pytest.raises(SurefootError, match="no test worlds"):
        parameters_figure(study, tmp_path / "a.png")
    with pytest.raises(SurefootError, match="none of the figures"):
        group_figure(study, tmp_path / "a.png", ["table1_falls"])
    with pytest.raises(SurefootError, match="row 'torque_constant'"):
        parameter_figure(comparison(seeds=(0,)), "torque_constant", tmp_path / "a.png")


def test_a_comparison_of_nothing_is_refused(study: Comparison) -> None:
    for groups in ((), (replace(study.groups[0], seeds=()),)):
        with pytest.raises(SurefootError, match="nothing to compare"):
            replace(study, groups=groups)


def test_bins_are_means_over_the_episodes_that_end_in_them() -> None:
    steps, returns = np.array([10.0, 20.0, 30.0, 40.0, 50.0]), np.array([1.0, 3.0, np.nan, 5.0, 7.0])
    curve = Curve(steps, returns, np.zeros(5), np.zeros(5), np.array([3.0, 1.0, 0.0, 2.0, 2.0]))
    # An update belongs to the bin that its steps end in, at its upper end too.
    np.testing.assert_array_equal(curve.binned("returns", [0, 20, 30, 50]), [1.5, np.nan, 6.0])
    assert curve.late_gain == 7.0 - 5.0
    assert np.isnan(Curve(*[np.zeros(0)] * 5).late_gain)


def test_curve_of_a_log_counts_falls_over_episodes() -> None:
    rows = [
        {"steps": 8, "return_mean": None, "speed_mean": None, "episodes": 0, "falls": 0},
        {"steps": 16, "return_mean": 1.5, "speed_mean": 0.5, "episodes": 4, "falls": 1},
    ]
    curve = Curve.of_rows(rows)
    np.testing.assert_array_equal(curve.falls, [np.nan, 25.0])
    np.testing.assert_array_equal(curve.returns, [np.nan, 1.5])
    np.testing.assert_array_equal(curve.episodes, [0, 4])


def test_tables_hold_the_numbers_of_the_groups(tmp_path: Path, study: Comparison) -> None:
    write_tables(study, tmp_path)
    lines = (tmp_path / "runs.csv").read_text().splitlines()
    assert len(lines) == 1 + 4 * 3
    header = lines[0].split(",")
    assert header[:4] == ["group", "seed", "steps", "training_seconds"]
    row = dict(zip(header, lines[2].split(","), strict=True))
    assert (row["group"], row["seed"], row["nominal_return"]) == ("small_plain", "1", "2.100000")
    assert float(row["table1_falls"]) == 20
    # Seeds differ by 0.1 and 0.1: mean 2.1, standard deviation 0.1, t(0.975, 2) / sqrt 3 = 2.484138.
    groups = (tmp_path / "groups.csv").read_text()
    assert "small_plain,4-D,nominal_return,m,3,2.100000,1.851586,2.348414" in groups
    assert '"4-D, randomized"' in groups
    differences = (tmp_path / "differences.csv").read_text().splitlines()
    assert len(differences) == 1 + 2 * 8
    assert differences[2].startswith("small_randomized,small_plain,nominal_return,m,-0.200000,")
    assert len((tmp_path / "episodes.csv").read_text().splitlines()) == 1 + 4 * 3 * 2 * 5
    assert len((tmp_path / "sensitivity.csv").read_text().splitlines()) == 1 + 4 * 3 * len(WORLDS)


def test_report_says_what_the_numbers_say(tmp_path: Path, study: Comparison) -> None:
    write_tables(study, tmp_path)
    text = write_report(study, tmp_path, "surefoot study studies/robustness.yaml").read_text()
    # 0.2 m less, standard error 0.1 sqrt(2/3), t(0.975, 4) = 2.776445: 0.2267 to either side.
    assert "return, nominal: -0.20 [-0.43, +0.03] m; the interval includes zero." in text
    change = re.search(r"spread of return over test worlds: (\S+) \[(\S+), (\S+)\] m; the interval does not", text)
    assert change is not None
    assert float(change[2]) < float(change[1]) < float(change[3]) < 0
    assert "surefoot study studies/robustness.yaml" in text
    assert "| 3,000,000 |" in text
    assert "Not complete" not in text
    for file in re.findall(r"\]\(([^)]+)\)", text):
        assert (tmp_path / file).exists(), file


def test_report_of_one_seed_claims_no_interval() -> None:
    study = replace(comparison(seeds=(0,)), missing=("small_plain seed 1",))
    text = report_text(study, "command")
    assert "too few seeds for an interval" in text
    assert "includes zero" not in text
    assert "**Not complete.** Runs of the study that are not in this report: small_plain seed 1." in text
