"""`surefoot evaluate POLICY POLICY ...`: policies side by side, and former names of commands."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from processes import refused, surefoot

pytest.importorskip("mujoco")
pytest.importorskip("pandas")

from surefoot.evaluation.policy_table import COLUMNS

SHORT = ("--episodes", 2, "--duration", 1.2, "--threads", 1)


def test_several_policies_have_a_row_under_each_condition(tmp_path: Path):
    policies, conditions = ("go2-steer", "go2-terrain"), ("nominal", "latency")
    words = ("evaluate", *policies, *SHORT, "--conditions", *conditions)
    done = surefoot(*words, "--json", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    rows = result["policies"]
    assert [(row["policy"], row["condition"]) for row in rows] == [(a, b) for a in policies for b in conditions]
    assert {*COLUMNS, "episodes", "success", "hottest_motor", "world"} < set(rows[0])
    # The same commands on the same robots: only the readings' age differs.
    assert rows[0]["rmse_forward"] != rows[1]["rmse_forward"]
    assert [Path(file).name for file in result["files"]] == ["policies.csv", "policies.html"]
    with (tmp_path / "policies.csv").open() as file:
        assert [float(row["power"]) for row in csv.DictReader(file)] == pytest.approx([row["power"] for row in rows])
    text = surefoot(*words).stdout
    assert "nominal: nominal robot, mujoco" in text
    assert "latency: readings 20 ms old, mujoco" in text
    assert text.count("0 of 2") == 4


def test_one_policy_is_measured_under_conditions_that_are_named():
    done = surefoot("evaluate", "go2-steer", "--conditions", "feet", *SHORT, "--json")
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(done.stdout)["policies"]
    assert (row["policy"], row["condition"], row["episodes"]) == ("go2-steer", "feet", 2)


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("go2-steer trot", "policies that are compared must be for the same robot"),
        ("trot gallop", "policy 'trot' follows no commands; policies that are compared must"),
        ("go2-steer go2-terrain --conditions ice", "--conditions are ice; give some of nominal, bullet, table1"),
        ("go2-steer go2-terrain --conditions feet feet", "--conditions are feet, feet; give some of"),
        ("go2-steer --conditions", "--conditions has no value"),
        ("go2-steer go2-terrain --terrain stairs:0.1", "--terrain is not an option"),
    ],
)
def test_comparisons_refuse_what_does_not_fit(line: str, part: str):
    refused(surefoot("evaluate", *line.split()), part)


@pytest.mark.parametrize(
    ("former", "now"),
    [("compare", "surefoot evaluate POLICY POLICY"), ("sensitivity", "surefoot evaluate sensitivity POLICY")],
)
def test_a_former_name_answers_with_the_new_one(former: str, now: str):
    refused(surefoot(former, "go2-steer", "--episodes", "2"), f"'{former}' is no command any more; type {now}")
