"""`surefoot study`: interrupted, killed or with a killed worker, it is finished by running the same command again."""

from __future__ import annotations

import csv
import gc
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import SUREFOOT, assert_rejected, surefoot, wait_until

from surefoot.api.extras import install_command
from surefoot.files import read_json_lines
from surefoot.studies.study_config import load_study
from surefoot.studies.training import Training

TINY = """
name: tiny
task: trot
seeds: [0]
train:
  {steps: 20480, num_envs: 16, steps_per_update: 16, evaluate_every: 5000, evaluation_episodes: 2,
   checkpoint_every: 512, ppo: {policy_hidden: [8, 8], value_hidden: [8, 8], epochs: 2}, task: {max_steps: 40}}
groups:
  plain: {label: 4-D, train: {task: {pushes: {enabled: false}, randomize: none}}}
  drawn: {label: "4-D, randomized", train: {task: {randomize: table1}}}
evaluate: [sensitivity, table1]
"""
STEPS = 20480
BROKEN = TINY.replace("evaluate:", "  broken: {train: {task: {randomize: none}}}\nevaluate:")


def start(cwd: Path, workers: int) -> subprocess.Popen[str]:
    command = [*SUREFOOT, "study", "tiny.yaml", "--workers", str(workers), "--train-only"]
    return subprocess.Popen(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def updates(folder: Path, group: str) -> int:
    return len(read_json_lines(folder / "runs" / "tiny" / group / "seed_0" / "figures.jsonl"))


def worker(folder: Path, group: str) -> int:
    return int((folder / "runs" / "tiny" / group / "seed_0" / "lock").read_text() or 0)


def alive(pid: int) -> bool:
    """Return whether a process is running; a zombie is not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.ray
@pytest.mark.timeout(600)
def test_a_study_resumes_after_kills_and_interrupts(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(TINY)
    groups = ("plain", "drawn")

    # The study is killed: its worker ends with it.
    process = start(tmp_path, workers=1)
    wait_until(lambda: updates(tmp_path, "plain") >= 3)
    trains = worker(tmp_path, "plain")
    process.kill()
    process.communicate(timeout=60)
    wait_until(lambda: not alive(trains))
    done = updates(tmp_path, "plain")

    # Training continues from the last checkpoint. A worker that dies is replaced, and repeats the same steps.
    process = start(tmp_path, workers=2)
    wait_until(lambda: updates(tmp_path, "plain") >= done + 2 and updates(tmp_path, "drawn") >= 2)
    os.kill(first := worker(tmp_path, "drawn"), signal.SIGKILL)
    wait_until(lambda: worker(tmp_path, "drawn") != first)
    again = updates(tmp_path, "drawn")
    wait_until(lambda: updates(tmp_path, "drawn") >= again + 2)

    # Ctrl-C saves the training.
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 130, errors
    assert re.search(r"drawn +seed 0 +lost ", output)
    assert re.search(r"drawn +seed 0 +stopped ", output)
    assert "The same command continues" in output
    assert errors == ""
    assert all((tmp_path / "runs/tiny" / g / "seed_0/checkpoints/latest.ckpt").exists() for g in groups)

    # One training can't start; the others are finished and reported.
    (tmp_path / "tiny.yaml").write_text(BROKEN)
    place = tmp_path / "runs/tiny/broken/seed_0"
    place.parent.mkdir()
    place.write_text("a file where a folder must be")
    result = surefoot("study", "tiny.yaml", "--workers", "1", cwd=tmp_path)
    assert result.returncode == 1
    assert result.stderr == "surefoot: error: broken seed 0: runs/tiny/broken/seed_0: can't be made: File exists\n"
    assert "Not in the report: broken seed 0" in result.stdout
    assert re.search(rf"drawn +seed 0 +finished +{STEPS:,} of {STEPS:,} steps", result.stdout)
    check_log(tmp_path)
    check_results(tmp_path / "results" / "tiny")

    (tmp_path / "tiny.yaml").write_text(TINY.replace("max_steps: 40", "max_steps: 41"))
    assert_rejected(
        surefoot("study", "tiny.yaml", cwd=tmp_path),
        "surefoot: error: runs/tiny/plain/seed_0: was trained with task.max_steps 40, and the study asks for 41; move "
        "the folder away to train it again, choose another --out, or change the study back\n",
    )


def check_log(folder: Path) -> None:
    """Check that every update is in the log exactly once, however the run was interrupted."""
    for group in ("plain", "drawn"):
        log = (folder / "runs/tiny" / group / "seed_0" / "figures.jsonl").read_text().splitlines()
        assert [json.loads(line)["steps"] for line in log] == [256 * (n + 1) for n in range(STEPS // 256)]


def check_results(out: Path) -> None:
    with (out / "policies.csv").open() as file:
        runs = {row["group"]: row for row in csv.DictReader(file)}
    assert set(runs) == {"plain", "drawn"}
    for row in runs.values():
        assert row["steps"] == str(STEPS)
        assert 0 <= float(row["table1_falls"]) <= 100
        assert float(row["sensitivity_std"]) > 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["missing"] == ["broken seed 0"]
    # A single seed gives no confidence interval.
    assert all(row["low"] is None for row in summary["groups"])
    report = (out / "README.md").read_text()
    assert "surefoot study run tiny.yaml --workers 1" in report
    assert "| 4-D, randomized | 4-D |" in report
    for name in (
        "learning_curves.png",
        "groups.png",
        "parameters.png",
        "parameters/control_latency.png",
        "sensitivity.csv",
    ):
        assert (out / name).stat().st_size > 1000, name


ROBOTS = """
name: hidden
task: trot
seeds: [0]
train:
  {steps: 8192, num_envs: 16, steps_per_update: 16, evaluate_every: 4096, evaluation_episodes: 2,
   checkpoint_every: 512, ppo: {policy_hidden: [8, 8], value_hidden: [8, 8], epochs: 2}, task: {max_steps: 20}}
robots: {seeds: [201, 202], ranges: ensemble, world: mujoco, starts: 2}
groups:
  half: {identified: [body], train: {task: {actuator: constraint, params: {control_latency: 0.0}}}}
  whole: {identified: [body, motors, contact, sensors]}
questions:
  gap: {text: the gap of the whole is smaller, figure: gap, pairs: [[half, whole]], expect: less}
"""


def robots_study(folder: Path) -> Path:
    """Write a study of two robots to identify, with parameter ranges that MuJoCo models."""
    folder.mkdir()
    (folder / "ranges.yaml").write_text("base_mass_ratio: [0.8, 1.2]\nvoltage: [14.0, 16.8]\n")
    (folder / "hidden.yaml").write_text(ROBOTS.replace("ranges: ensemble", "ranges: ranges.yaml"))
    for seed, mass in ((201, 1.1), (202, 0.9)):
        path = folder / f"results/hidden/robots/robot_{seed}.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"[params]\nbase_mass_ratio = {mass}\nvoltage = 15.0\ncontrol_latency = 0.016\n")
    load_study(folder / "hidden.yaml").hidden.write_settings(path.parent)
    return folder


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_study_on_robots_that_was_killed_twice_has_the_same_digits(tmp_path: Path) -> None:
    """Two robots, two groups, one seed: once without interruption, and once killed in the first and third training."""
    whole, parts = robots_study(tmp_path / "whole"), robots_study(tmp_path / "parts")
    command = [*SUREFOOT, "study", "hidden.yaml", "--workers", "1"]
    for run in ("half/robot_201", "whole/robot_201"):
        process = subprocess.Popen(command, cwd=parts, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        place = parts / "runs/hidden" / run / "seed_0"
        wait_until(lambda place=place: len(read_json_lines(place / "figures.jsonl")) >= 4)  # type: ignore[misc]
        trains = int((place / "lock").read_text())
        process.kill()
        process.communicate(timeout=60)
        wait_until(lambda trains=trains: not alive(trains))  # type: ignore[misc]
        assert not (place / "policy.onnx").exists()
    for folder in (whole, parts):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
        assert "all 2 robots are identified" in done.stdout
    tables = ["robots", "groups", "questions", "parameters", "episodes"]
    for table in tables:
        first, second = ((folder / f"results/hidden/{table}.csv").read_text() for folder in (whole, parts))
        assert first == second, table
    with (parts / "results/hidden/episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * 2 * 2 * 2
    report = (parts / "results/hidden/README.md").read_text()
    assert "Not complete" not in report
    assert "- The gap of the whole is smaller: **" in report
    # Another identification requires another training.
    (parts / "results/hidden/robots/robot_202.toml").write_text("[params]\nbase_mass_ratio = 1.0\n")
    done = surefoot("study", "hidden.yaml", cwd=parts)
    assert done.returncode == 2
    assert "runs/hidden/half/robot_202/seed_0: was trained with task.params " in done.stderr


def test_identify_takes_a_study_with_robots_and_skips_those_that_are_identified(tmp_path: Path) -> None:
    folder = robots_study(tmp_path / "study")
    done = surefoot("study", "identify", "hidden.yaml", cwd=folder)
    assert (done.returncode, done.stdout) == (0, "hidden: all 2 robots are identified\n"), done.stderr
    (folder / "tiny.yaml").write_text(TINY)
    done = surefoot("study", "identify", "tiny.yaml", cwd=folder)
    assert_rejected(done, "tiny.yaml: the study has no hidden robots to identify")
    (folder / "hidden.yaml").write_text(ROBOTS.replace("world: mujoco", "world: ensemble"))
    assert_rejected(surefoot("study", "hidden.yaml", cwd=folder), "world is 'ensemble'")


GAP = """
name: gaps
task: trot
seeds: [0]
train:
  {steps: 1024, num_envs: 8, steps_per_update: 16, evaluate_every: 512, evaluation_episodes: 2,
   task: {max_steps: 30, pushes: {enabled: false}}}
groups:
  baseline: {train: {task: {actuator: constraint, params: {control_latency: 0.0, servo_latency: 0.0}}}}
  improved: {label: "improved, at last"}
evaluate: [gap]
top: 1
bars: {simulators: [baseline, improved]}
findings: [{groups: [improved, baseline], text: the baseline had the larger gap.}]
"""


@pytest.mark.slow
def test_a_study_of_the_reality_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Train, run in two worlds and report; MuJoCo replaces the other world."""
    from surefoot.cli import study
    from surefoot.cli.helpers import study_results
    from surefoot.cli.main import main
    from surefoot.studies import evaluations
    from surefoot.studies.workers import TrainingsOutcome, Worker
    from surefoot.world.sim_world import SimWorld

    def train_here(title: str, trainings: list[Training], *_: object) -> TrainingsOutcome:
        """Train like a worker, without Ray."""
        for training in trainings:
            worker = Worker(".")
            report = worker.begin(training)
            while not report.finished:
                report = worker.advance()
        return TrainingsOutcome([training.name for training in trainings])

    (tmp_path / "gaps.yaml").write_text(GAP)
    monkeypatch.setattr(study, "train_many", train_here)
    monkeypatch.setattr(gc, "unfreeze", lambda: None)  # of what collection imported
    monkeypatch.chdir(tmp_path)
    worlds: list[str] = []

    def find_world(name: str) -> type[SimWorld]:
        worlds.append(name)
        return SimWorld

    monkeypatch.setattr(study_results, "find_world", find_world)
    monkeypatch.setattr(evaluations, "find_world", find_world)
    assert main(["study", "gaps.yaml", "--workers", "1"]) == 0, capsys.readouterr().err
    assert set(worlds) == {"mujoco", "ensemble"}
    out = tmp_path / "results/gaps"
    report = (out / "README.md").read_text()
    assert "In the paper: the baseline had the larger gap." in report
    assert report.count("| improved, at last | baseline |") == 1 + 3 + 2
    assert json.loads((out / "summary.json").read_text())["missing"] == []
    assert sorted(path.name for path in out.iterdir()) == sorted(
        [
            *("README.md", "summary.json", "policies.csv", "groups.csv", "differences.csv", "episodes.csv"),
            *("gap_groups.csv", "top_differences.csv"),
            *("groups.png", "gap_simulators.png", "gap_simulators_top.png", "learning_curves_simulators.png"),
        ]
    )
    with (out / "episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * (20 + 3 * 20)
    with (out / "policies.csv").open() as file:
        assert all(row["best_steps"] in ("512", "1024") for row in csv.DictReader(file))

    capsys.readouterr()
    worlds.clear()
    before = (out / "episodes.csv").read_text()
    # Run folders contain this process's command, not the worker's.
    for path in (tmp_path / "runs/gaps").glob("*/*/run.json"):
        assert json.loads(path.read_text())["command"] == ["surefoot", *sys.argv[1:]]
    # All files that are required to continue a finished run.
    needed = {"policy.onnx", "config.yaml", "run.json", "figures.jsonl", "evaluations"}
    for file in (tmp_path / "runs/gaps").glob("*/*/*"):
        if file.name not in needed:
            shutil.rmtree(file) if file.is_dir() else file.unlink()
    assert main(["study", "gaps.yaml"]) == 0
    output = capsys.readouterr().out
    assert "all 2 trainings are finished" in output
    assert "return in training simulator" not in output
    assert (out / "episodes.csv").read_text() == before


def test_a_missing_world_is_rejected_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from surefoot.cli.helpers import study_results
    from surefoot.cli.main import main

    def find_world(name: str) -> object:
        if name == "ensemble":
            raise ModuleNotFoundError("No module named 'pybullet'", name="pybullet")
        return None

    (tmp_path / "gaps.yaml").write_text(GAP)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(study_results, "find_world", find_world)
    assert main(["study", "gaps.yaml"]) == 2
    assert install_command("bullet") in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
