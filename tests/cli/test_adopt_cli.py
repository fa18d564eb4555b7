"""`surefoot adopt`, `export`, `evaluate` of several policies, and `doctor` without a robot."""

from __future__ import annotations

import csv
import json
from typing import get_args, get_type_hints

import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")

from third_party_policies import MJLAB_PROPERTIES, perceptron

from surefoot.adopt.adoption import FORMATS
from surefoot.adopt.exporting import EXPORTERS
from surefoot.cli.adopt import AdoptCommand
from surefoot.cli.export import ExportCommand
from surefoot.cli.main import main
from surefoot.policy.runtime import PolicyRuntime


@pytest.fixture
def network(tmp_path):
    path = tmp_path / "theirs.onnx"
    path.write_bytes(perceptron(45, properties=MJLAB_PROPERTIES))
    return path


@pytest.fixture
def adopted(network, tmp_path):
    path = tmp_path / "mine.onnx"
    assert main(["adopt", str(network), "--from", "mjlab", "--robot", "go2", "--out", str(path)]) == 0
    return path


def test_all_formats_are_choices_of_the_option():
    assert set(get_args(get_type_hints(AdoptCommand)["format"])) == set(FORMATS)
    assert set(get_args(get_type_hints(ExportCommand)["to"])) == set(EXPORTERS)


def test_adopt_writes_a_policy_and_prints_its_assumptions(network, tmp_path, capsys):
    path = tmp_path / "new" / "mine.onnx"
    words = ["adopt", str(network), "--from", "mjlab", "--robot", "go2", "--out", str(path), "--forward", "-0.3", "0.7"]
    assert main(words) == 0
    output = capsys.readouterr().out
    assert "note: control step: mjlab does not write it, 20 ms is assumed" in output
    assert "commands" not in output  # they were stated
    assert output.endswith(f"wrote {path}\n")
    contract = PolicyRuntime.load(path).contract
    assert contract.name == "mine"
    assert contract.commands.forward == (-0.3, 0.7)
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["policy"] == "mine"


def test_an_adopted_policy_works_with_other_commands(adopted, tmp_path, capsys):
    assert main(["evaluate", str(adopted), "--episodes", "2", "--duration", "0.4", "--out", str(tmp_path / "out")]) == 0
    assert "falls" in capsys.readouterr().out
    assert main(["show", str(tmp_path / "out" / "episode_000.npz"), "--out", str(tmp_path / "show.html")]) == 0


def test_a_policy_that_observes_the_velocity_is_adopted_and_examined_with_the_estimate(tmp_path, monkeypatch, capsys):
    network, path = tmp_path / "theirs.onnx", tmp_path / "mine.onnx"
    names = f"base_lin_vel,{MJLAB_PROPERTIES['observation_names']}"
    network.write_bytes(perceptron(48, properties={**MJLAB_PROPERTIES, "observation_names": names}))
    words = ["adopt", str(network), "--from", "mjlab", "--robot", "go2", "--out", str(path)]
    assert main(words) == 2
    assert "give --base-velocity estimate to adopt the policy" in capsys.readouterr().err
    assert not path.exists()
    assert main([*words, "--base-velocity", "estimate"]) == 0
    assert "note: speed of the base: estimated from the IMU and the legs" in capsys.readouterr().out
    assert main(["evaluate", str(path), "--episodes", "2", "--duration", "0.4", "--out", str(tmp_path / "out")]) == 0
    monkeypatch.setattr("surefoot.adopt.mistakes._CORRECTION_KINDS", ())
    for module in ("examination", "diagnosis"):
        monkeypatch.setattr(f"surefoot.adopt.{module}.EPISODE_DURATION", 0.5)
    monkeypatch.setattr("surefoot.adopt.diagnosis.SCREENING_DURATION", 0.2)
    capsys.readouterr()
    main(["doctor", str(path), "--threads", "1", "--out", str(tmp_path / "page"), "--json"])
    result = json.loads(capsys.readouterr().out)
    (check,) = [check for check in result["checks"] if check["name"] == "base velocity"]
    assert "of 16 robots fell" in check["message"]
    assert "with the true speed of the base" in (tmp_path / "page" / "examination.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--interface eth0", "--interface is given; it is for a robot: give --port, or --link dds"),
        ("--lockstep", "--lockstep is given; it is for a robot"),
        ("--pings 20", "--pings is given; it is for a robot"),
    ],
)
def test_options_of_a_robot_are_not_ignored_without_one(adopted, words, message, capsys):
    assert main(["doctor", str(adopted), *words.split()]) == 2
    assert message in capsys.readouterr().err


def test_doctor_lists_the_changes_tried(adopted, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("surefoot.adopt.mistakes._CORRECTION_KINDS", ())
    for module in ("examination", "diagnosis"):
        monkeypatch.setattr(f"surefoot.adopt.{module}.EPISODE_DURATION", 1.0)
    monkeypatch.setattr("surefoot.adopt.diagnosis.SCREENING_DURATION", 0.2)
    assert main(["doctor", str(adopted), "--threads", "1", "--out", str(tmp_path / "page"), "--json"]) == 3
    result = json.loads(capsys.readouterr().out)
    assert [check["name"] for check in result["checks"]][:2] == ["stand", "forward"]
    assert result["checks"][-1]["name"] == "specification"
    page = (tmp_path / "page" / "examination.html").read_text()
    assert "<video" in page
    assert "does it follow commands?" in page
    assert 'src="http' not in page


def test_export_and_compare(adopted, tmp_path):
    assert main(["export", str(adopted), "--to", "rl_sar", "--out", str(tmp_path / "theirs")]) == 0
    assert sorted(path.name for path in (tmp_path / "theirs").iterdir()) == ["base.yaml", "config.yaml", "policy.onnx"]
    words = ["evaluate", "go2-steer", str(adopted), "--conditions", "nominal", "pushes", "--episodes", "2"]
    assert main([*words, "--duration", "1.4", "--threads", "1", "--out", str(tmp_path / "table")]) == 0
    with (tmp_path / "table" / "policies.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["policy"], row["condition"]) for row in rows] == [
        *(("go2-steer", "nominal"), ("go2-steer", "pushes")),
        *(("mine", "nominal"), ("mine", "pushes")),
    ]
    page = (tmp_path / "table" / "policies.html").read_text()
    assert "adopted from mjlab" in page
    assert "trained with surefoot" in page
