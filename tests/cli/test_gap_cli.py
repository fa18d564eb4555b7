"""`surefoot gap` as a user runs it, with policies with short episodes."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import assert_rejected, surefoot
from shipped_variants import modified_policy

pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")

from surefoot.cli.gap import make_labels, parse_side
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

pytest.importorskip("onnx")

ONE = ("--threads", "1")
RUNS = ["run_000.npz", "run_001.npz", "run_002.npz"]


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with trot.onnx and gallop.onnx with episodes of 60 control steps; the trot has constraint motors."""
    folder = tmp_path_factory.mktemp("policies")
    modified_policy(folder / "gallop.onnx", lambda contract: contract["task"].update(max_steps=60))
    latencies = {"control_latency": 0.0, "servo_latency": 0.0}

    def make_ideal(contract: dict[str, Any]) -> None:
        contract["task"].update(max_steps=60, actuator="constraint")
        contract.update(latencies)

    modified_policy(folder / "trot.onnx", make_ideal, "trot")
    return folder


@pytest.fixture
def here(tmp_path: Path, policies: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working folder that contains the policies."""
    for file in policies.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def result(words: list[str]) -> dict[str, Any]:
    done = surefoot("gap", *words, *ONE, "--json")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    output: dict[str, Any] = json.loads(done.stdout)
    return output


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_tables_figure_and_traces(here: Path):
    done = surefoot("gap", "trot.onnx", "gallop.onnx", "--to", "mujoco", "--to-set", "motor_strength=0.7", *ONE)
    assert (done.returncode, done.stderr) == (0, "")
    for part in ("trot", "gallop", "all policies", "mujoco-away", "0 of 6", "100 %"):
        assert part in done.stdout
    figures = "trot/runs.png, gallop/runs.png"
    assert f"wrote gap: gap.csv, episodes.csv, gap.png, {figures}" in " ".join(done.stdout.split())
    assert Path("gap/trot/runs.png").read_bytes().startswith(b"\x89PNG")
    files = ["episodes.csv", "gallop", "gap.csv", "gap.png", "trot"]
    assert sorted(path.name for path in Path("gap").iterdir()) == files
    lines, runs = read(Path("gap/gap.csv")), read(Path("gap/episodes.csv"))
    names = ("trot", "gallop", "all policies")
    assert [(line["policy"], line["world"]) for line in lines] == [
        (name, world) for name in names for world in ("mujoco", "mujoco-away")
    ]
    assert len(runs) == 2 * 2 * 3
    for line in lines[:4]:
        folder = Path("gap") / line["policy"] / line["world"]
        assert sorted(path.name for path in folder.iterdir()) == RUNS
        gained = [
            float(run["return"]) for run in runs if (run["policy"], run["world"]) == (line["policy"], line["world"])
        ]
        assert float(line["return_mean"]) == pytest.approx(np.mean(gained), abs=2e-6)
        assert float(line["return_error"]) == pytest.approx(np.std(gained, ddof=1) / np.sqrt(3), abs=2e-6)
    for home, away in zip(lines[::2], lines[1::2], strict=True):
        assert float(away["gap"]) == pytest.approx(float(home["return_mean"]) - float(away["return_mean"]), abs=2e-6)


def test_home_is_the_training_simulator_and_targets_have_the_data_sheets_robot(here: Path):
    words = ["trot.onnx", "--to", "mujoco", "--episodes", "2", "--set", "voltage=15"]
    output = result([*words, "--from-set", "base_mass_ratio=1.1", "--to-set", "base_mass_ratio=0.9", "voltage=14"])
    (policy,) = output["policies"]
    at_home = {"control_latency": 0.0, "servo_latency": 0.0, "voltage": 15.0, "base_mass_ratio": 1.1}
    assert policy["home"] == {"actuator": "constraint", "params": at_home, "params_source": {}}
    elsewhere = {"voltage": 14.0, "base_mass_ratio": 0.9}
    assert policy["away"] == {"actuator": "dc", "params": elsewhere, "params_source": {}}
    assert (output["robot"], output["from"], output["to"], output["runs"]) == ("minitaur", "mujoco", ["mujoco"], 2)
    assert output["pooled"] is None
    home, away = (EpisodeTrace.load(here / "gap/trot" / world / "run_001.npz") for world in ("mujoco", "mujoco-away"))
    nominal = RobotDescription.load("minitaur").nominal_params()
    for name, value in at_home.items():
        assert home.meta["params"][name] == pytest.approx(value)
    assert away.meta["params"]["control_latency"] == nominal["control_latency"]
    assert away.meta["params"]["servo_latency"] == nominal["servo_latency"]
    assert (home.meta["actuator"], away.meta["actuator"]) == ("constraint", "dc")
    assert home.meta["world"] == away.meta["world"] == "mujoco"


def test_a_robot_without_motion_capture_has_an_estimated_return(here: Path):
    result(["trot.onnx", "--to", "mujoco", "--episodes", "2"])
    for file in sorted(Path("gap/trot/mujoco-away").glob("*.npz")):
        trace = EpisodeTrace.load(file)
        unknown = {
            name: np.full_like(getattr(trace, name), np.nan) for name in ("base_position_world", "base_quat_world")
        }
        replace(trace, **unknown, meta={**trace.meta, "world": "robot"}).save(Path("robot") / file.name)
    sides = ["--from", "trace", "gap/trot/mujoco-away", "--to", "trace", "robot", "--out", "compared"]
    output = result(["trot.onnx", *sides])
    assert output["estimated"] == ["robot/run_000.npz", "robot/run_001.npz"]
    assert output["runs"] is None  # nothing was simulated
    measured, estimated = output["policies"][0]["worlds"]
    # These runs last a third of a second, in which the trot begins.
    assert estimated["return_mean"] == pytest.approx(measured["return_mean"], abs=0.03)
    assert abs(estimated["distance_mean"]) > 0.01
    intervals = output["estimated_intervals"]["trot"]
    (world,) = intervals
    assert set(intervals[world]) == {"distance_mean", "speed_mean", "return_mean", "gap"}
    low, high = intervals[world]["return_mean"]
    assert low < estimated["return_mean"] < high < low + 0.1


def test_the_same_worlds_have_no_gap(here: Path):
    home, away = result(["gallop.onnx", "--to", "mujoco"])["policies"][0]["worlds"]
    # Runs start in the same states, and the gallop was trained with the data sheet's robot.
    assert away["gap"] == 0
    assert home["return_mean"] == away["return_mean"]
    other = result(["gallop.onnx", "--to", "mujoco", "--seed", "2"])
    assert other["policies"][0]["worlds"][0]["return_mean"] != home["return_mean"]
    # A robot with weaker motors differs from one with constraint motors.
    ideal = result(["gallop.onnx", "--to", "mujoco", "--to-actuator", "constraint"])
    assert ideal["policies"][0]["away"]["actuator"] == "constraint"
    assert ideal["policies"][0]["worlds"][1]["gap"] != 0


def test_runs_have_the_same_duration_in_every_world(here: Path):
    words = ["gallop.onnx", "--to", "mujoco", "--episodes", "1", "--to-set", "control_step=0.012"]
    result(words)
    steps = [int(run["steps"]) for run in read(Path("gap/episodes.csv"))]
    assert steps == [60, 30]
    result([*words, "--duration", "0.12"])
    assert [int(run["steps"]) for run in read(Path("gap/episodes.csv"))] == [20, 10]
    message = "its run was planned for 0.12 s, the others for 0.36 s; give --duration 0.12 to compare"
    assert_rejected(
        surefoot("gap", "gallop.onnx", "--to", "trace", "gap/gallop/mujoco", "--out", "other", *ONE), message
    )
    assert not Path("other").exists()
    output = result(["gallop.onnx", "--to", "trace", "gap/gallop/mujoco", "--out", "other", "--duration", "0.12"])
    assert output["policies"][0]["worlds"][1]["runs"] == 1


def test_recorded_runs_have_the_same_results_as_simulated_runs(here: Path):
    words = ["trot.onnx", "gallop.onnx", "--episodes", "2"]
    simulated = result([*words, "--to", "mujoco", "--to-set", "voltage=13"])
    shutil.copytree("gap/trot/mujoco-away", "robot/monday/trot")
    shutil.copytree("gap/gallop/mujoco-away", "robot/tuesday")
    for path in Path("robot").rglob("*.npz"):
        trace = EpisodeTrace.load(path)
        trace.meta["world"] = "lab"
        trace.save(path)
    recorded = result([*words, "--to", "trace", "robot", "--out", "other"])
    for one, other in zip(simulated["policies"], recorded["policies"], strict=True):
        assert other["worlds"][0] == one["worlds"][0]
        assert other["worlds"][1] == one["worlds"][1] | {"world": "lab"}
    assert not Path("other/trot/lab").exists()
    assert {run["trace"] for run in read(Path("other/episodes.csv")) if run["world"] == "lab"} == set(
        map(str, Path("robot").rglob("*.npz"))
    )
    turned = result([*words, "--from", "trace", "robot", "--to", "mujoco", "--out", "turned"])
    assert turned["from"] == "trace robot"
    assert [row["world"] for row in turned["pooled"]] == ["lab", "mujoco"]
    assert turned["pooled"][0]["return_mean"] == recorded["pooled"][1]["return_mean"]


def test_sides_have_distinct_labels():
    folder = Path("a/robot")
    assert make_labels(["mujoco", "mujoco", "lab"], ["mujoco", "mujoco", folder]) == ["mujoco", "mujoco-away", "lab"]
    assert make_labels(["lab"] * 3, [folder, folder, Path("b/robot")]) == ["lab", "lab-robot", "lab-robot-2"]
    assert parse_side("--to", ("trace", "x y")) == Path("x y")
    with pytest.raises(SurefootError, match="--to is 'nothing'"):
        parse_side("--to", ())


def test_bullet_is_another_world(here: Path):
    pytest.importorskip("pybullet")
    output = result(["gallop.onnx", "--to", "bullet", "--episodes", "2"])
    home, away = output["policies"][0]["worlds"]
    assert (home["world"], away["world"]) == ("mujoco", "bullet")
    assert away["gap"] != 0
    trace = EpisodeTrace.load(here / "gap/gallop/bullet/run_001.npz")
    assert trace.meta["world"] == "bullet"
