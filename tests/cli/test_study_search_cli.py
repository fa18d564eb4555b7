"""`surefoot study search`: loss of a computer, a killed search, and the report."""

from __future__ import annotations

import csv
import os
import re
import signal
import subprocess
from pathlib import Path

import pytest
from processes import SUREFOOT, assert_rejected, surefoot, wait_until
from ray_nodes import cluster, free_port

from surefoot.files import read_json_lines

for module in ("optuna", "ray"):
    pytest.importorskip(module)

TASK = """
name: tiny
observations: [roll, pitch, roll_rate, pitch_rate, motor_angles]
feedback: {swing: [-0.5, 0.5], extension: [1.0707963, 2.0707963]}
max_steps: 40
train:
  {num_envs: 16, steps_per_update: 16, checkpoint_every: 512,
   ppo: {policy_hidden: [8, 8], value_hidden: [8, 8], epochs: 2}}
"""
SPACE = """
ppo.learning_rate: {low: 1.0e-4, high: 3.0e-3, log: true}
ppo.policy_hidden.0: {low: 8, high: 16, int: true}
ppo.activation: {choices: [elu, tanh]}
task.reward.energy: {low: -0.02, high: -0.002, log: true}
"""
STEPS = 16384
UPDATES = STEPS // 256
SEARCH = ("study", "search", "tiny.yaml", "--space", "space.yaml", "--steps", str(STEPS), "--out", "out", "--seed", "5")


def rows(folder: Path, number: int) -> list[dict[str, object]]:
    return read_json_lines(folder / f"out/trials/trial_{number:04d}/figures.jsonl")


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [*SUREFOOT, *SEARCH, *words]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def untimed(row: dict[str, object]) -> dict[str, object]:
    return {name: value for name, value in row.items() if "seconds" not in name}


@pytest.mark.ray
@pytest.mark.timeout(900)
def test_every_trial_is_finished_once_after_processes_die(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(TASK)
    (tmp_path / "space.yaml").write_text(SPACE)
    with cluster(tmp_path, cpus=1) as nodes:
        second = nodes.join()
        process = start(tmp_path, "--trials", "3", "--ray", nodes.address)
        # One trial on each computer, both well before their end, whichever of the three trials they are.
        wait_until(lambda: sum(5 <= len(rows(tmp_path, number)) <= 2 * UPDATES // 3 for number in range(3)) == 2)
        second.kill()

        # The search is killed after it has noticed the loss, and its journal is truncated.
        assert process.stdout is not None
        lost = next(results[1] for line in process.stdout if (results := re.match(r"trial_(\d{4}) .* lost ", line)))
        wait_until(lambda: len(rows(tmp_path, 2)) >= 5)
        os.kill(process.pid, signal.SIGKILL)
        _, errors = process.communicate(timeout=60)
        assert errors == ""
        journal = tmp_path / "out/trials.log"
        journal.write_bytes(journal.read_bytes()[:-3])
        result = surefoot(*SEARCH, "--trials", "3", "--ray", nodes.address, "--resume", cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        assert result.stderr == ""
        assert "trials.log: removed the last record, which was incomplete" in result.stdout
    check(tmp_path, 3)
    check_same(tmp_path, int(lost))
    check_report(tmp_path / "out", 3)
    # No training is left, so Ray is not started.
    tables = ("trials.csv", "best.csv", "top.csv")
    before = [(tmp_path / "out" / name).read_text() for name in tables]
    fresh = {path: path.stat().st_mtime_ns for path in tmp_path.glob("out/trials/*/evaluations/fresh_*.json")}
    assert fresh
    result = surefoot(*SEARCH, "--trials", "3", "--resume", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert [(tmp_path / "out" / name).read_text() for name in tables] == before
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("out/trials/*/evaluations/fresh_*.json")} == fresh
    assert_rejected(
        surefoot(*SEARCH, cwd=tmp_path), "out: already has a search; resume it with --resume, or choose another --out"
    )


def check(folder: Path, trials: int) -> None:
    """Check that every trial is in the table once, and every update in its log once."""
    with (folder / "out/trials.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["trial"] for row in table] == [str(number) for number in range(trials)]
    assert all(row["state"] == "complete" for row in table)
    for number in range(trials):
        results = rows(folder, number)
        assert len((folder / f"out/trials/trial_{number:04d}/figures.jsonl").read_text().splitlines()) == UPDATES
        assert [row["steps"] for row in results] == [256 * (n + 1) for n in range(UPDATES)]
        assert float(table[number]["return"]) == pytest.approx(results[-1]["evaluation"]["return_mean"], abs=1e-6)  # type: ignore[index]
    assert len({row["seed"] for row in table}) == trials


def check_same(folder: Path, number: int) -> None:
    """Check that a trial that was lost and resumed equals an uninterrupted one, run without Ray."""
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop
    from surefoot.world.sim_world import SimWorld

    _, config = RunFolder.open(folder / f"out/trials/trial_{number:04d}")
    again = TrainingLoop.create(config, RunFolder.create_at(config, folder / "again"), SimWorld)
    again.run(lambda *_: None)
    assert [untimed(row) for row in again.folder.rows()] == [untimed(row) for row in rows(folder, number)]


def check_report(out: Path, trials: int) -> None:
    report = (out / "README.md").read_text()
    assert (
        f"{trials} trials ({trials} complete) of {STEPS:,} control steps, 8 episodes per evaluation, seed 5" in report
    )
    assert "surefoot study search tiny.yaml --space space.yaml" in report
    assert "Claimed minus fresh, mean of these 3: " in report
    gaits = re.findall(r"\((gait_\w+\.png)\)", report)
    assert gaits
    for name in ("search.png", "parameters.png", *gaits):
        assert (out / name).stat().st_size > 1000, name
    with (out / "best.csv").open() as file:
        table = list(csv.DictReader(file))
    worlds = {row["world"] for row in table}
    assert {"mujoco"} <= worlds <= {"mujoco", "bullet"}
    assert len(table) == 3 * 20 * len(worlds)


def test_an_address_without_ray_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surefoot.studies.workers._CONNECT_TIMEOUT", 0.5)
    port = free_port()
    done = surefoot("study", "search", "trot", "--ray", f"127.0.0.1:{port}", cwd=tmp_path)
    assert_rejected(done, f"ray is 127.0.0.1:{port}: no Ray cluster answers within 0.5 s")
    assert not list(tmp_path.iterdir())
