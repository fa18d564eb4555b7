"""Report of a search, from synthetic trials with known results."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from result_numbers import fill
from run_tables import runs_table

pytest.importorskip("matplotlib")

from paper_page import load_content

from surefoot.studies.search import make_config
from surefoot.studies.search_report import write_report
from surefoot.studies.search_result import SearchResult
from surefoot.task.trace import EpisodeTrace

BULLET = runs_table("bullet", 0.5, 0.7)


def trial(folder: Path, number: int, state: str, value: float, gait: str) -> dict[str, Any]:
    share = 1.0 if state == "complete" else 0.4
    curve = [(100_000 * n, value * n / 10) for n in range(1, round(10 * share) + 1)]
    params = {"ppo.learning_rate": 10.0 ** -(2 + number % 3), "ppo.value_hidden": "16 16" if number % 2 else "32 32"}
    row = {"trial": number, "state": state, "return": value, "steps": curve[-1][0], "seconds": 36.0 * share}
    row |= {"gait": gait, "pattern": f"running {gait}", "seed": 7 + number, **params, "why": "", "curve": curve}
    result = {"gait": gait, "pattern": f"running {gait}", "reason": "", "stride": 0.4, "duty": 0.4, "agree": 5}
    row |= {"policy": folder / f"trials/{number}/policy.onnx", "result": result}
    if state == "fail":
        empty = dict.fromkeys(("gait", "pattern", "seed", *params, "policy", "result"))
        row |= {**empty, "return": math.nan, "steps": 0, "seconds": 0.0, "why": "it broke", "curve": []}
    return row


@pytest.fixture
def result(tmp_path: Path, make_run: Callable[..., EpisodeTrace]) -> SearchResult:
    gaits = ["gallop", "trot", "trot", "bound", "trot", "gallop"]
    states = ["complete", "complete", "pruned", "complete", "fail", "complete"]
    rows = [
        trial(tmp_path, number, state, 1.0 + 0.5 * number, gait)
        for number, (state, gait) in enumerate(zip(states, gaits, strict=True))
    ]
    for row in rows:
        if row["policy"] is not None:
            make_run().save(row["policy"].parent / "evaluations/gait/mujoco/run_000.npz")
    fresh = [
        pd.concat([runs_table("mujoco", *[rows[number]["return"] - d for d in (0.1, 0.2, 0.3)]), BULLET]).assign(
            trial=number
        )
        for number in (5, 3, 1)
    ]
    config = make_config("gallop", None, 5, 1_000_000)
    space = {name: config.space[name] for name in ("ppo.learning_rate", "ppo.value_hidden")}
    importance = {"ppo.value_hidden": 0.75, "ppo.learning_rate": 0.25}
    return SearchResult(replace(config, space=space), pd.DataFrame(rows), pd.concat(fresh), importance)


def test_selection_bias_is_claimed_minus_fresh_return(result: SearchResult) -> None:
    biases = result.selection_bias()
    assert list(biases) == [5, 3, 1]
    # Returns 0.1, 0.2 and 0.3 m lower: mean 0.2, half width t(0.975, 2) = 4.303 times 0.1 / sqrt(3).
    for _, bias in biases.values():
        assert bias.mean == pytest.approx(0.2)
        assert bias.low == pytest.approx(0.2 - 4.303 * 0.1 / math.sqrt(3), abs=1e-4)
        assert bias.high == pytest.approx(0.2 + 4.303 * 0.1 / math.sqrt(3), abs=1e-4)


def test_the_report_has_all_sections(result: SearchResult, tmp_path: Path) -> None:
    (tmp_path / "gait_pace.png").touch()
    report = write_report(result, tmp_path, "surefoot study search gallop").read_text()
    assert not (tmp_path / "gait_pace.png").exists()
    assert "6 trials (4 complete, 1 pruned, 1 fail) of 1,000,000 control steps" in report
    assert "Claimed minus fresh, mean of these 3: +0.200 [+0.200, +0.200] m." in report
    assert "| `ppo.value_hidden` | 0.75 |" in report
    assert "| trot | 2 | 1 | 2 running trot | 2.00 | 2 |" in report
    for name in ("search", "parameters", "gait_gallop", "gait_trot", "gait_bound"):
        assert f"({name}.png)" in report
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
    rows: list[dict[str, Any]] = list(csv.DictReader((tmp_path / "trials.csv").open()))
    assert [row["state"] for row in rows] == ["complete", "complete", "pruned", "complete", "fail", "complete"]
    assert rows[4] | {"return": "", "seed": "", "why": "it broke", "ppo.learning_rate": ""} == rows[4]
    assert len((tmp_path / "best.csv").read_text().splitlines()) == 1 + 3 * (3 + 2)


def test_the_table_of_best_trials_has_each_and_their_mean(result: SearchResult, tmp_path: Path) -> None:
    write_report(result, tmp_path, "surefoot study search gallop")
    rows: list[dict[str, Any]] = list(csv.DictReader((tmp_path / "top.csv").open()))
    assert [(row["rank"], row["trial"]) for row in rows] == [("1", "5"), ("2", "3"), ("3", "1"), ("all", "")]
    # Returns of 3.5, 2.5 and 1.5 m, and 0.2 m less in fresh episodes: intervals over policies have equal widths.
    assert [float(row["claimed"]) for row in rows] == [3.5, 2.5, 1.5, 2.5]
    assert [float(row["fresh"]) for row in rows] == pytest.approx([3.3, 2.3, 1.3, 2.3])
    assert float(rows[3]["fresh_high"]) == pytest.approx(2.3 + 4.303 / math.sqrt(3), abs=1e-3)
    assert [float(rows[3][name]) for name in ("selection_bias", "selection_bias_low")] == pytest.approx([0.2, 0.2])
    assert [row["mujoco_runs"] for row in rows] == ["3", "3", "3", "9"]
    assert [row["bullet_runs"] for row in rows] == ["2", "2", "2", "6"]
    assert {row["bullet_return_mean"] for row in rows} == {"0.6"}


def test_the_page_of_the_paper_finds_its_numbers_in_the_report(result: SearchResult, tmp_path: Path) -> None:
    write_report(result, tmp_path / "results/search", "surefoot study search gallop")
    lines = [line for section in load_content().sections for item in section.items for line in item.lines()]
    read = [line.surefoot for line in lines if "{search/" in line.surefoot]
    assert len(read) > 10
    for text in read:
        assert fill(tmp_path, text)


def test_without_bullet_the_table_of_best_trials_has_no_bullet_columns(result: SearchResult, tmp_path: Path) -> None:
    home = result.fresh[result.fresh.world == "mujoco"]
    write_report(replace(result, fresh=home), tmp_path, "surefoot study search gallop")
    rows: list[dict[str, Any]] = list(csv.DictReader((tmp_path / "top.csv").open()))
    assert len(rows) == 4
    assert not [name for name in rows[0] if "bullet" in name]
