"""`surefoot deploy` against the emulator's process on a pseudo-terminal; stopped and killed, it is a process too."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited import edited_policy
from processes import SUREFOOT, Emulator, refused, surefoot

from surefoot.evaluate.recorded import find_traces
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.partial_trace import recover
from surefoot.task.trace import EpisodeTrace

pytest.importorskip("mujoco")

ABSENT = ("mujoco", "numba", "gymnasium", "torch", "scipy", "matplotlib", "pybullet", "onnx")
PATIENCE = 120.0


@pytest.fixture
def emulator(emulate: Callable[..., Emulator]) -> Callable[..., str]:
    """Start an emulator in lockstep; returns its port."""
    return lambda *options: emulate("--lockstep", *options).port


def deploy(port: str, *options: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return surefoot("deploy", "trot", "--port", port, "--lockstep", *options, cwd=cwd)


def start_deploy(port: str, *options: str, until: str = "surefoot: run") -> subprocess.Popen[str]:
    """Start a deployment and wait until it says a line."""
    command = [*SUREFOOT, "deploy", "trot", "--port", port, "--lockstep", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(until):
            return process
    raise AssertionError(f"it never said '{until}'")


def test_the_trot_goes_as_far_as_in_simulation(emulator, tmp_path, repository):
    capture = tmp_path / "capture.csv"
    port = emulator("--ideal-sensors", "--motion-capture", str(capture))
    done = deploy(port, "--out", str(tmp_path / "out"), "--motion-capture", str(capture), "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    (run,) = told["runs"]
    assert (run["ended"], run["steps"], run["notes"]) == ("time", 1000, [])
    assert run["timing"]["missed"] == 0
    assert told["frames"]["damaged"] == told["frames"]["missing"] == told["frames"]["commands_refused"] == 0
    policy = PolicyRuntime.load(repository / "policies" / "trot.onnx")
    assert run["speed"] == pytest.approx(policy.contract.figures["training"]["speed_mean"], rel=0.05)

    trace = EpisodeTrace.load(run["trace"])
    assert trace.base_position_world[0, :2] == pytest.approx(0.0, abs=1e-9)
    assert trace.base_position_world[-1, 0] == pytest.approx(run["distance"])
    assert trace.feedback == pytest.approx(policy.feedback(trace.observation), abs=1e-5)
    assert trace.observation[1:, 0] == pytest.approx(trace.roll_pitch_yaw[:-1, 0], abs=1e-7)
    assert_readings_are_20_ms_old(trace, capture)

    read = surefoot("evaluate", "--trace", run["trace"], "--json")
    assert read.returncode == 0, read.stderr
    assert json.loads(read.stdout)["speed_mean"] == pytest.approx(run["speed"])


def assert_readings_are_20_ms_old(trace: EpisodeTrace, capture: Path) -> None:
    """What a row tells of the pitch is what motion capture saw 20 ms before the row's end, and not at another time."""
    with capture.open() as file:
        rows = np.array([[float(word) for word in row] for row in list(csv.reader(file))[1:]])
    w, x, y, z = rows[:, 4:8].T
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    ends = trace.meta["robot_time_start"] + trace.time

    def error(age: float) -> float:
        return float(np.abs(trace.roll_pitch_yaw[:, 1] - np.interp(ends - age, rows[:, 0], pitch)).mean())

    ages = np.arange(0.0, 0.041, 0.001)
    errors = [error(age) for age in ages]
    assert ages[int(np.argmin(errors))] == pytest.approx(0.020, abs=0.0015)
    assert min(errors) < 1e-3


def test_the_computer_of_the_robot_needs_no_simulator(emulator, tmp_path):
    script = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {ABSENT!r}:
            raise ImportError(f"the robot's computer has no {{name}}", name=name)

sys.meta_path.insert(0, Absent())
from surefoot.cli.main import main
code = main(["deploy", "trot", *sys.argv[1:]])
assert not [name for name in {ABSENT!r} if name in sys.modules]
sys.exit(code)
"""
    options = ("--port", emulator("--ideal-sensors"), "--lockstep", "--duration", "0.3", "--out", str(tmp_path / "out"))
    done = subprocess.run([sys.executable, "-c", script, *options], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    assert "done; 50 steps" in done.stdout


def test_several_runs_in_a_row_each_leave_a_trace(emulator, tmp_path):
    done = deploy(emulator(), "--duration", "0.3", "--runs", "2", "--out", str(tmp_path), "--world-name", "bench")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("surefoot: disarm") == 2
    assert sorted(path.name for path in tmp_path.glob("*.npz")) == ["run_000.npz", "run_001.npz"]
    trace = EpisodeTrace.load(tmp_path / "run_001.npz")
    assert trace.meta["world"] == "bench"
    assert trace.meta["episode"] == 1
    assert trace.num_steps == 50


def test_two_runs_on_the_same_robot_are_the_same_to_the_last_bit(emulator, tmp_path):
    traces = []
    for name in ("one", "two"):
        deploy(emulator("--seed", "3"), "--duration", "0.6", "--out", str(tmp_path / name))
        traces.append(EpisodeTrace.load(tmp_path / name / "run_000.npz"))
    for array in ("target", "observation", "motor_torque", "energy", "time"):
        assert getattr(traces[0], array).tolist() == getattr(traces[1], array).tolist(), array


def test_a_dry_run_moves_nothing_and_keeps_nothing(emulator, tmp_path):
    port = emulator()
    done = deploy(port, "--dry-run", "--duration", "0.3", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "done; 50 steps" in done.stdout
    assert "arm" not in done.stderr.replace("surefoot: disarm", "")
    assert list(tmp_path.iterdir()) == []
    kept = deploy(port, "--dry-run", "--duration", "0.3", "--out", str(tmp_path))
    assert kept.returncode == 0, kept.stderr
    assert EpisodeTrace.load(tmp_path / "run_000.npz").meta["dry_run"]


def test_without_a_folder_traces_go_to_deploy(emulator, tmp_path):
    done = deploy(emulator(), "--duration", "0.1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "deploy" / "run_000.npz").exists()


def test_a_hangup_lets_the_robot_sit_and_keeps_the_trace(emulator, tmp_path):
    process = start_deploy(emulator(), "--duration", "60", "--out", str(tmp_path), "--json")
    time.sleep(0.3)
    process.send_signal(signal.SIGHUP)
    told, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, said
    (run,) = json.loads(told)["runs"]
    assert (run["ended"], run["reason"]) == ("stopped", "operator")
    assert said.splitlines()[-2:] == ["surefoot: sit (0.7 s)", "surefoot: disarm"]
    trace = EpisodeTrace.load(tmp_path / "run_000.npz")
    assert trace.meta["ended"] == "stopped"
    assert 0 < trace.num_steps < 10_000


def test_a_killed_host_leaves_its_run_behind(emulator, tmp_path):
    process = start_deploy(emulator(), "--duration", "60", "--out", str(tmp_path))
    time.sleep(1.0)
    process.kill()
    process.communicate(timeout=PATIENCE)
    assert not list(tmp_path.glob("*.npz"))
    trace = recover(tmp_path / "run_000.npz.partial")
    assert trace.num_steps > 10
    assert trace.meta["ended"] == "fault"
    assert trace.meta["robot_time_start"] > 0.0
    ((path, found),) = find_traces(tmp_path)
    assert path.name == "run_000.npz.partial"
    assert found.num_steps == trace.num_steps


@pytest.mark.parametrize("until", ["surefoot: lay legs flat", "surefoot: run"])
def test_a_killed_host_loses_the_robot_to_the_next_one(emulator, tmp_path, until):
    port = emulator()
    process = start_deploy(port, "--duration", "60", "--out", str(tmp_path), until=until)
    process.kill()
    process.communicate(timeout=PATIENCE)
    looked = surefoot("doctor", "trot", "--port", port, "--lockstep")
    assert looked.returncode == 0, looked.stdout + looked.stderr
    done = deploy(port, "--duration", "0.1", "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr


def test_motion_capture_that_is_missing_costs_only_the_base(emulator, tmp_path):
    done = deploy(
        emulator(), "--duration", "0.3", "--out", str(tmp_path), "--motion-capture", str(tmp_path / "none.csv")
    )
    assert done.returncode == 0, done.stderr
    assert "none.csv: can't be read: No such file or directory; the trace has no base motion" in done.stdout
    assert np.isnan(EpisodeTrace.load(tmp_path / "run_000.npz").base_position_world).all()


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["trot", "--port", "/dev/nothing"], "port /dev/nothing: can't be opened: No such file or directory"),
        (["canter", "--port", "x"], "policy 'canter' does not exist"),
        (["trot", "--port", "x", "--duration", "-1"], "duration is -1; it must be over 0"),
        (["trot", "--port", "x", "--runs", "0"], "runs is 0; it must be 1 or more"),
        (["trot"], "--port"),
        (["trot", "--port", "x", "--out", "/dev/null"], "out is /dev/null; it must be a folder"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(words, match):
    refused(surefoot("deploy", *words), match)


@pytest.mark.parametrize(
    ("words", "change", "match"),
    [
        (["deploy", "--port", "x"], {"control_latency": float("nan")}, "contract: is not JSON: it holds NaN"),
        (["deploy", "--port", "x"], {"task": {"fall_angle": 1e9}}, "task.fall_angle is 1000000000.0; it must be"),
        (["evaluate"], {"control_latency": -0.02}, "contract: control_latency is -0.02; it must be a number from 0 to"),
    ],
)
def test_a_contract_with_a_number_out_of_range_is_refused(tmp_path, words, change, match):
    def edit(contract: dict[str, Any]) -> None:
        contract |= change | {"task": contract["task"] | change.get("task", {})}

    command, *rest = words
    refused(surefoot(command, edited_policy(tmp_path / "edited.onnx", edit, "trot"), *rest), match)


def test_a_robot_that_says_nothing_is_told_in_one_line(tmp_path):
    """A port with nobody behind it."""
    master, slave = os.openpty()
    try:
        done = surefoot("deploy", "trot", "--port", os.ttyname(slave))
    finally:
        os.close(master)
        os.close(slave)
    assert done.returncode == 2
    assert "no robot answers within 2 s" in done.stderr
