"""`surefoot evaluate POLICY POLICY ...`: comparison of policies."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from processes import surefoot

pytest.importorskip("mujoco")
pytest.importorskip("pandas")

from surefoot.evaluation.policy_table import COLUMNS

SHORT = ("--episodes", 2, "--duration", 1.2, "--threads", 1)


def test_each_policy_has_a_row_for_each_condition(tmp_path: Path):
    policies, conditions = ("go2-steer", "go2-terrain"), ("nominal", "latency")
    words = ("evaluate", *policies, *SHORT, "--conditions", *conditions)
    done = surefoot(*words, "--json", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    rows = result["policies"]
    assert [(row["policy"], row["condition"]) for row in rows] == [(a, b) for a in policies for b in conditions]
    assert {*COLUMNS, "episodes", "success", "hottest_motor", "world"} < set(rows[0])
    # The same commands on the same robots: only the latency differs.
    assert rows[0]["rmse_forward"] != rows[1]["rmse_forward"]
    assert [Path(file).name for file in result["files"]] == ["policies.csv", "policies.html"]
    with (tmp_path / "policies.csv").open() as file:
        assert [float(row["power"]) for row in csv.DictReader(file)] == pytest.approx([row["power"] for row in rows])
    text = surefoot(*words).stdout
    assert "nominal: nominal robot, mujoco" in text
    assert "latency: readings 20 ms old, mujoco" in text
    assert text.count("0 of 2") == 4


def test_a_single_policy_is_measured_under_selected_conditions():
    done = surefoot("evaluate", "go2-steer", "--conditions", "feet", *SHORT, "--json")
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(done.stdout)["policies"]
    assert (row["policy"], row["condition"], row["episodes"]) == ("go2-steer", "feet", 2)
