"""Table of `benchmarks/handcrafted.py`, from rows with known results."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
handcrafted = SimpleNamespace(**runpy.run_path(str(ROOT / "benchmarks" / "handcrafted.py")))

TUNED = [
    {"gait": "slow", "speed": 0.4, "power": 8.0, "falls": 0},
    {"gait": "fast", "speed": 1.2, "power": 40.0, "falls": 0},
    {"gait": "faster", "speed": 1.4, "power": 28.0, "falls": 0},
    {"gait": "falling", "speed": 0.8, "power": 1.0, "falls": 1},
]


@pytest.mark.parametrize(
    ("speed", "power", "names"),
    [(0.9, 18.0, "slow, faster"), (1.3, 26.0, "slow, faster"), (0.3, math.nan, ""), (1.5, math.nan, "")],
)
def test_tuned_power_is_the_minimum_on_lines_between_gaits_without_falls(speed, power, names):
    result = handcrafted.at_equal_speed(speed, TUNED)
    assert result[0] == pytest.approx(power, nan_ok=True)
    assert result[1] == names


def rows(*trainings):
    return [{"file": f"gait-seed_{n}", "speed": v, "power": p} for n, (v, p) in enumerate(trainings) for _ in range(2)]


def test_intervals_are_over_trainings_if_there_are_several():
    three = handcrafted.estimate(rows((0.9, 9.0), (0.9, 12.0), (0.9, 15.0)), "power")
    assert three.mean == pytest.approx(12.0)
    assert three.high - three.mean == pytest.approx(4.302653 * 3.0 / math.sqrt(3))
    assert handcrafted.estimate([{"file": "one", "power": value} for value in (1, 2, 3)], "power").is_finite


def test_less_power_compares_each_training_at_its_own_speed():
    result = handcrafted.comparison(rows((0.9, 9.0), (0.5, 10.0), (0.9, 18.0)), TUNED)
    assert result["less_power"] == pytest.approx((50 + 0 + 0) / 3)
    assert result["baseline"] == "slow, faster"
    assert result["tuned_power"] == pytest.approx((18 + 10 + 18) / 3)
    assert math.isnan(handcrafted.comparison(rows((0.9, 9.0), (1.5, 9.0)), TUNED)["less_power"])


@pytest.mark.parametrize(("hybrid", "tuned"), [("trot-hybrid", "trot-60"), ("gallop-hybrid", "gallop-120")])
def test_hybrids_learn_on_top_of_the_tuned_trajectories(hybrid, tuned):
    example = yaml.safe_load((ROOT / "examples" / f"{hybrid}.yaml").read_text())
    result = yaml.safe_load((ROOT / "results" / "handcrafted" / f"{tuned}.yaml").read_text())
    assert example["reference"] == result["reference"]
