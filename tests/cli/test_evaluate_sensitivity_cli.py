"""`surefoot evaluate sensitivity` with released policies."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path

import pytest
from processes import surefoot

pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")

from surefoot.api.policies import distinct_names, find_policy

SHORT = ("--values", "2", "--episodes", "1", "--duration", "0.12", "--threads", "1")
TABLES = ("policies.csv", "breaks.csv", "sensitivity.csv", "episodes.csv")
ROWS = ["base_mass_ratio", "leg_mass_ratio", "motor_friction", "base_inertia_ratio", "leg_inertia_ratio"]
ROWS += ["motor_strength", "control_step", "control_latency", "voltage", "contact_friction", "imu_bias", "imu_noise"]


def test_tables_and_figures(tmp_path: Path):
    done = surefoot("evaluate", "sensitivity", "trot", "gallop", *SHORT, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    out = tmp_path / "sensitivity"
    files = {*TABLES, "aggregate.png", *(f"{row}.png" for row in ROWS)}
    assert {file.name for file in out.iterdir()} == files
    with (out / "sensitivity.csv").open() as file:
        worlds = list(csv.DictReader(file))
    assert [(world["policy"], world["row"]) for world in worlds] == [
        (policy, row) for policy in ("trot", "gallop") for row in ROWS for _ in range(2)
    ]
    assert [float(world["value"]) for world in worlds if world["row"] == "control_latency"] == [0.0, 0.04, 0.0, 0.04]
    for row in ROWS:
        assert f" {row} " in done.stdout
    assert re.search(r"^ trot .* 24 +0 of 24 *$", done.stdout, re.MULTILINE)
    assert f"wrote sensitivity: {', '.join(TABLES)}, aggregate.png, base_mass_ratio.png" in done.stdout
    with (out / "policies.csv").open() as file:
        policies = [(one["policy"], one["test_worlds"], one["falls"], one["episodes"]) for one in csv.DictReader(file)]
    assert policies == [("trot", "24", "0", "24"), ("gallop", "24", "0", "24")]


def test_json_is_one_object_with_the_ranges_of_a_file(tmp_path: Path):
    (tmp_path / "mine.yaml").write_text("voltage: [12.0, 16.0]\nresistance: [0.15, 0.25]\n")
    words = ("gallop", *SHORT, "--values", "3", "--ranges", "mine.yaml", "--json", "--seed", "4", "--out", "a/b")
    done = surefoot("evaluate", "sensitivity", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    result = json.loads(done.stdout)
    assert result["ranges"] == {"voltage": [12.0, 16.0], "resistance": [0.15, 0.25]}
    assert (result["values"], result["episodes"], result["duration"], result["seed"]) == (3, 1, 0.12, 4)
    (policy,) = result["policies"]
    assert (policy["policy"], policy["test_worlds"], policy["fall_rate"]) == ("gallop", 6, 0.0)
    assert sorted(result["files"]) == sorted(
        f"a/b/{name}" for name in (*TABLES, "aggregate.png", "voltage.png", "resistance.png")
    )
    with (tmp_path / "a/b/sensitivity.csv").open() as file:
        means = [float(world["return_mean"]) for world in csv.DictReader(file)]
    assert policy["return_mean"] == pytest.approx(sum(means) / 6, abs=1e-6)


def test_the_force_of_pushes_is_a_parameter(tmp_path: Path):
    (tmp_path / "r.yaml").write_text("base_mass_ratio: [0.9, 1.0]\n")
    words = ("trot", "--ranges", "r.yaml", "--push-force", "0", "400", "--values", "2", "--episodes", "2", "--json")
    done = surefoot("evaluate", "sensitivity", *words, "--duration", "2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["push_force"] == [0.0, 400.0]
    assert "sensitivity/push_force.png" in result["files"]
    with (tmp_path / "sensitivity/sensitivity.csv").open() as file:
        worlds = {(world["row"], float(world["value"])): world for world in csv.DictReader(file)}
    assert {world["unit"] for (row, _), world in worlds.items() if row == "push_force"} == {"N"}
    # A force of zero and the nominal mass equal the nominal world; only the test worlds of the force are pushed.
    assert worlds["push_force", 0.0]["return_mean"] == worlds["base_mass_ratio", 1.0]["return_mean"]
    assert [int(world["falls"]) for world in worlds.values()] == [0, 0, 0, 2]


def test_policies_with_the_same_name_get_distinct_names(tmp_path: Path):
    for folder, name in (("a", "mine"), ("b", "mine"), ("b", "other")):
        (tmp_path / folder).mkdir(exist_ok=True)
        shutil.copy(find_policy("trot"), tmp_path / folder / f"{name}.onnx")
    words = (
        "evaluate",
        "sensitivity",
        "a/mine.onnx",
        "b/mine.onnx",
        "b/other.onnx",
        *SHORT,
        "--ranges",
        "r.yaml",
        "--json",
    )
    (tmp_path / "r.yaml").write_text("base_mass_ratio: [0.8, 1.2]\n")
    done = surefoot(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    policies = json.loads(done.stdout)["policies"]
    assert [policy["policy"] for policy in policies] == ["mine-1", "mine-2", "other"]
    # The results are the same, whatever the name.
    assert len({policy["return_mean"] for policy in policies}) == 1


def test_names():
    assert distinct_names(["trot", "gallop"], ["a", "b"]) == ["trot", "gallop"]
    assert distinct_names(["trot", "trot", "gallop"], ["a", "b", "c"]) == ["a", "b", "gallop"]
    assert distinct_names(["trot", "trot"], ["policy", "policy"]) == ["policy-1", "policy-2"]
    assert distinct_names(["p", "p", "p-1"], ["p", "p", "q"]) == ["p-2", "p-3", "p-1"]
