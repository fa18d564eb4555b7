"""Tables of the reality gap."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from surefoot.evaluate.gap import Estimate, PolicyGap, Runs, plus_minus
from surefoot.evaluate.gap_tables import summary, write_csv, write_runs_csv

NAN = math.nan


def runs(world: str, returns: list[float], fell: list[bool]) -> Runs:
    gained, flags = np.array(returns), np.array(fell)
    return Runs(
        world, gained, gained + 1, gained / 2, np.full(len(gained), 20.0), np.full(len(gained), 9.0), flags, ~flags
    )


POLICY = PolicyGap(
    "trot",
    runs("mujoco", [3.0, 5.0], [False, False]),
    (runs("bullet", [1.0, 3.0], [True, False]), runs("robot", [NAN], [False])),
)


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_a_line_for_each_policy_and_world(tmp_path: Path):
    home, bullet, robot = read(write_csv(tmp_path / "deep" / "gap.csv", [POLICY]))
    assert (home["policy"], home["world"], home["side"], home["runs"]) == ("trot", "mujoco", "home", "2")
    assert [float(home[key]) for key in ("return_mean", "return_error", "speed_mean", "power_mean")] == [4, 1, 2, 20]
    assert (float(home["distance_mean"]), home["gap"], home["gap_error"]) == (5, "", "")
    assert (bullet["side"], bullet["falls"], float(bullet["success_rate"])) == ("away", "1", 0.5)
    assert float(bullet["gap"]) == 2
    assert float(bullet["gap_error"]) == pytest.approx(math.sqrt(2), abs=1e-6)
    assert (robot["return_mean"], robot["speed_mean"], robot["gap"], float(robot["power_mean"])) == ("", "", "", 20)


def test_a_line_for_each_run(tmp_path: Path):
    files = {
        ("trot", "mujoco"): [Path("a.npz"), Path("b.npz")],
        ("trot", "bullet"): [Path("c.npz"), Path("d.npz")],
        ("trot", "robot"): [Path("e.npz")],
    }
    lines = read(write_runs_csv(tmp_path / "runs.csv", [POLICY], files))
    assert [line["trace"] for line in lines] == ["a.npz", "b.npz", "c.npz", "d.npz", "e.npz"]
    assert [line["run"] for line in lines] == ["0", "1", "0", "1", "0"]
    assert [line["fell"] for line in lines] == ["0", "0", "1", "0", "0"]
    assert [line["balanced"] for line in lines] == ["1", "1", "0", "1", "1"]
    assert (float(lines[1]["return"]), lines[4]["return"]) == (5, "")
    assert {line["steps"] for line in lines} == {"9"}


def test_a_summary_holds_no_nan():
    rows = [summary(POLICY, part) for part in (POLICY.home, *POLICY.away)]
    assert "gap" not in rows[0]
    assert rows[1]["gap"] == 2
    assert (rows[2]["gap"], rows[2]["gap_error"], rows[2]["return_mean"], rows[2]["runs"]) == (None, None, None, 1)


@pytest.mark.parametrize(
    ("estimate", "options", "text"),
    [
        (Estimate(1.2, 0.05), {}, "1.20 ± 0.05"),
        (Estimate(1.2, NAN), {}, "1.20"),
        (Estimate(NAN, NAN), {}, "-"),
        (Estimate(1.2, 0.05), {"sign": True, "digits": 1}, "+1.2 ± 0.1"),
        (Estimate(-1.2, 0.0), {"sign": True}, "-1.20 ± 0.00"),
        (Estimate(-0.001, 0.05), {"sign": True}, "0.00 ± 0.05"),
    ],
)
def test_estimates_as_text(estimate: Estimate, options: dict, text: str):
    assert plus_minus(estimate, **options) == text
