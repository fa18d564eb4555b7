"""`surefoot deploy` with the emulator on a pseudo-terminal, in this process or (to be killed) in another one."""

from __future__ import annotations

import csv
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from fault_bench import QUICK
from processes import SUREFOOT, EmulatorHere, assert_rejected, emulators, surefoot

from surefoot.deploy.motion_capture import read_capture
from surefoot.evaluation.estimated_motion import with_estimated_motion
from surefoot.evaluation.recorded import find_traces
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.rotations import quat_yaw
from surefoot.task.config import load_task
from surefoot.task.contract_mapping import contract_from_task
from surefoot.task.height_scan import POLICY_GRID, scan_heights
from surefoot.task.partial_trace import recover
from surefoot.task.trace import EpisodeTrace

pytest.importorskip("mujoco")

from surefoot.emulator.capture_writer import CaptureWriter
from surefoot.world.terrain import read_map

ABSENT = ("mujoco", "numba", "gymnasium", "torch", "scipy", "matplotlib", "pybullet", "onnx")
PATIENCE = 120.0


@pytest.fixture
def emulate() -> Iterator[Callable[..., EmulatorHere]]:
    """Start emulators in lockstep, which are ended with the test."""
    with emulators(EmulatorHere) as start:
        yield lambda *options: start("--lockstep", *options)


@pytest.fixture
def quick() -> Iterator[None]:
    """Shorten the time in which sitting robots stand up."""
    with mock.patch.multiple("surefoot.deploy.motion_runner", **QUICK):
        yield


def deploy(port: str, *options: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return surefoot("deploy", "trot", "--port", port, "--lockstep", *options, cwd=cwd)


def test_the_trot_covers_the_same_distance_as_in_simulation(emulate, tmp_path, repository):
    capture, robot = tmp_path / "capture.csv", emulate("--ideal-sensors")
    robot.board.on_step.append(CaptureWriter(capture, robot.board.plant).update)
    done = deploy(robot.port, "--out", str(tmp_path / "out"), "--motion-capture", str(capture), "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    (run,) = result["runs"]
    assert (run["ended"], run["steps"], run["notes"]) == ("time", 1000, [])
    assert run["timing"]["missed"] == 0
    assert result["frames"]["damaged"] == result["frames"]["missing"] == result["frames"]["commands_refused"] == 0
    policy = PolicyRuntime.load(repository / "policies" / "trot.onnx")
    assert run["speed"] == pytest.approx(policy.contract.figures["training"]["speed_mean"], rel=0.05)

    trace = EpisodeTrace.load(run["trace"])
    assert trace.base_position_world[0, :2] == pytest.approx(0.0, abs=1e-9)
    assert trace.base_position_world[-1, 0] == pytest.approx(run["distance"])
    blind = {name: np.full_like(getattr(trace, name), np.nan) for name in ("base_position_world", "base_quat_world")}
    estimated = with_estimated_motion(replace(trace, **blind), trace.load_robot())
    assert estimated.base_position_world[-1, 0] == pytest.approx(run["distance"], rel=0.03)
    assert trace.feedback == pytest.approx(policy.feedback(trace.observation), abs=1e-5)
    assert trace.observation[1:, 0] == pytest.approx(trace.roll_pitch_yaw[:-1, 0], abs=1e-7)
    assert_readings_are_20_ms_old(trace, capture)

    read = surefoot("evaluate", "--trace", run["trace"], "--json")
    assert read.returncode == 0, read.stderr
    assert json.loads(read.stdout)["speed_mean"] == pytest.approx(run["speed"])


def test_a_policy_with_foot_trajectories_covers_the_same_distance_as_in_simulation(emulate, tmp_path, repository):
    pytest.importorskip("torch")
    from surefoot.learn.config import load_train_config
    from surefoot.learn.ppo_learner import PpoLearner
    from surefoot.world.sim_world import SimWorld

    config = load_train_config(str(repository / "results/handcrafted/trot-60.yaml"))
    config = replace(config, num_envs=4, ppo=replace(config.ppo, policy_hidden=(8,)))
    policy = PpoLearner(config, SimWorld).export(tmp_path / "untrained.onnx")
    assert (PolicyRuntime.load(policy).contract.reference or {})["kind"] == "foot"
    simulated = json.loads(surefoot("evaluate", policy, "--episodes", "3", "--json").stdout)
    robot = emulate("--ideal-sensors")
    robot.board.on_step.append(CaptureWriter(tmp_path / "capture.csv", robot.board.plant).update)
    words = ("--lockstep", "--out", tmp_path / "out", "--motion-capture", tmp_path / "capture.csv", "--json")
    done = surefoot("deploy", policy, "--port", robot.port, *words)
    assert done.returncode == 0, done.stderr
    (run,) = json.loads(done.stdout)["runs"]
    assert simulated["speed_mean"] > 0.3
    assert run["speed"] == pytest.approx(simulated["speed_mean"], rel=0.1)


def test_a_file_of_commands_steers_the_robot(emulate, tmp_path, repository):
    robot = emulate("--robot", "go2", "--ideal-sensors", "--set", "servo_kp=40", "servo_kd=1")
    robot.board.on_step.append(CaptureWriter(tmp_path / "capture.csv", robot.board.plant).update)
    rows = ("time,forward,sideways,yaw_rate", "0.5,0.5,0,0", "2.5,0,0,0", "3.3,0,0,0.6", "5.3,0,0,0", "5.9,0,0,9")
    (tmp_path / "way.csv").write_text("\n".join(rows))
    words = ("deploy", "go2-steer", "--port", robot.port, "--lockstep", "--out", tmp_path / "out")
    # Invalid commands are rejected before anything is sent to the robot.
    assert_rejected(surefoot(*words, "--commands", tmp_path / "none.csv"), "none.csv")
    done = surefoot(
        *(*words, "--commands", tmp_path / "way.csv", "--duration", "6"),
        *("--motion-capture", tmp_path / "capture.csv", "--json"),
    )
    assert done.returncode == 0, done.stderr
    (run,) = json.loads(done.stdout)["runs"]
    trace = EpisodeTrace.load(run["trace"])
    begins = trace.time - trace.meta["control_step"] + 1e-6
    active = [(0.5 <= t < 2.5, 3.3 <= t < 5.3) for t in begins]
    last = begins >= 5.9
    np.testing.assert_allclose(trace.command[~last], [(0.5 * w, 0.0, 0.6 * t) for w, t in np.array(active)[~last]])
    most = PolicyRuntime.load(repository / "policies" / "go2-steer.onnx").contract.commands.high[2]
    np.testing.assert_allclose(trace.command[last], [(0.0, 0.0, most)] * int(last.sum()))
    assert done.stderr.count("command out of range: ") == 1
    at = np.searchsorted(trace.time, [0.4, 3.2])
    start, walked, end = (trace.base_position_world[k, :2] for k in (*at, -1))
    assert walked - start == pytest.approx([1.0, 0.0], abs=0.15)
    assert end - walked == pytest.approx(0.0, abs=0.08)
    assert quat_yaw(trace.base_quat_world)[[at[1], -1]] == pytest.approx([0.0, 1.2], abs=0.15)


def test_a_policy_without_commands_rejects_a_source_of_commands(emulate):
    done = deploy(emulate().port, "--commands", "5555")
    assert_rejected(done, "--commands is given; policy 'trot' follows no commands")


@pytest.fixture
def seeing(tmp_path: Path) -> Path:
    """Return a perceptive policy for the Go2 whose feedback is zero."""
    torch = pytest.importorskip("torch")
    from surefoot.policy.export import export_policy

    robot = RobotDescription.load("go2")
    task = load_task("steer", "go2")[0]
    contract = contract_from_task(replace(task, observations=(*task.observations, "height_scan")), robot, name="seeing")
    network = torch.nn.Linear(contract.width, len(contract.action_names))
    torch.nn.init.zeros_(network.weight)
    torch.nn.init.zeros_(network.bias)
    return export_policy(network, contract, tmp_path / "seeing.onnx", "feedback")


@pytest.mark.slow
def test_a_policy_observes_the_step_in_front_of_an_emulated_robot(seeing: Path, tmp_path: Path) -> None:
    heights = np.where(np.arange(81)[:, None] * 0.05 - 2.0 > 0.52, 0.1, np.zeros((81, 81)))
    np.savez(tmp_path / "step.npz", heights=heights, cell=0.05)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    exact = [word for name in ("noise", "drift", "shift", "holes", "delay") for word in (f"--scan.{name}", "0")]
    robot = ("--robot", "go2", "--ideal-sensors", "--set", "servo_kp=40", "servo_kd=1", "--lockstep")
    capture = tmp_path / "capture.csv"
    ground = ("--terrain", tmp_path / "step.npz", "--height-map", port, *exact, "--out", capture)
    with emulators() as start:
        words = ("deploy", seeing, "--port", start(*robot, *ground).port, "--lockstep", "--out", tmp_path / "out")
        assert_rejected(surefoot(*words), "policy 'seeing' needs a height map; give --height-map PORT")
        done = surefoot(*words, "--height-map", port, "--duration", "0.5", "--json")
    assert done.returncode == 0, done.stderr
    (run,) = json.loads(done.stdout)["runs"]
    trace = EpisodeTrace.load(run["trace"])
    columns = [name.startswith("ground") for name in PolicyRuntime.load(seeing).contract.columns]
    seen = trace.observation[-1][columns]
    rows = read_capture(capture)
    at = np.searchsorted(rows["time"], trace.meta["robot_time_start"] + trace.time[-1])
    position, quat = (np.array([rows[name][at] for name in names]) for names in ("xyz", ("qw", "qx", "qy", "qz")))
    expected = scan_heights(
        read_map(tmp_path / "step.npz"),
        POLICY_GRID.points(RobotDescription.load("go2")),
        position[None],
        np.atleast_1d(quat_yaw(quat)),
    )[0]
    # Points on the slope of the step would reveal an error of a millimetre.
    on_step = np.abs(expected + position[2] - 0.05) < 0.0499
    assert seen[~on_step] == pytest.approx(expected[~on_step], abs=0.005)
    assert np.ptp(seen) == pytest.approx(0.1, abs=0.005)


def assert_readings_are_20_ms_old(trace: EpisodeTrace, capture: Path) -> None:
    """Check that the pitch in a row equals motion capture 20 ms before the end of the row."""
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


def test_the_computer_of_the_robot_needs_no_simulator(emulate, tmp_path):
    script = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {ABSENT!r}:
            raise ImportError(f"the robot's computer has no {{name}}", name=name)

sys.meta_path.insert(0, Absent())
from surefoot.cli.main import main
code = main(["doctor", "trot", *sys.argv[1:4]]) or main(["deploy", "trot", *sys.argv[1:]])
assert not [name for name in {ABSENT!r} if name in sys.modules]
sys.exit(code)
"""
    options = f"--port {emulate().port} --lockstep --duration 0.3 --out {tmp_path}".split()
    done = subprocess.run([sys.executable, "-c", script, *options], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    assert "done; 50 steps" in done.stdout


@pytest.mark.usefixtures("quick")
def test_several_runs_in_a_row_each_leave_a_trace(emulate, tmp_path):
    words = ("--duration", "0.3", "--episodes", "2", "--out", str(tmp_path), "--world-name", "bench")
    done = deploy(emulate().port, *words)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("surefoot: disarm") == 2
    assert sorted(path.name for path in tmp_path.glob("*.npz")) == ["run_000.npz", "run_001.npz"]
    trace = EpisodeTrace.load(tmp_path / "run_001.npz")
    assert trace.meta["world"] == "bench"
    assert trace.meta["episode"] == 1
    assert trace.num_steps == 50


@pytest.mark.usefixtures("quick")
def test_a_dry_run_moves_no_motor_and_writes_no_file(emulate, tmp_path):
    port = emulate().port
    done = deploy(port, "--dry-run", "--duration", "0.3", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "done; 50 steps" in done.stdout
    assert "arm" not in done.stderr.replace("surefoot: disarm", "")
    assert list(tmp_path.iterdir()) == []
    kept = deploy(port, "--dry-run", "--duration", "0.3", "--out", str(tmp_path))
    assert kept.returncode == 0, kept.stderr
    assert EpisodeTrace.load(tmp_path / "run_000.npz").meta["dry_run"]


@pytest.mark.usefixtures("quick")
def test_traces_default_to_deploy_and_lack_the_base_without_motion_capture(emulate, tmp_path):
    done = deploy(emulate().port, "--duration", "0.1", "--motion-capture", "none.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "none.csv: can't be read: No such file or directory; the trace has no base motion" in done.stdout
    assert np.isnan(EpisodeTrace.load(tmp_path / "deploy" / "run_000.npz").base_position_world).all()


def test_a_killed_host_leaves_its_trace_and_the_next_host_gets_the_robot(emulate, tmp_path):
    port = emulate().port
    command = [*SUREFOOT, "deploy", "trot", "--port", port, "--lockstep", "--duration", "60", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert any(line.startswith("surefoot: run") for line in process.stderr)
    partial, end = tmp_path / "run_000.npz.partial", time.monotonic() + PATIENCE
    while time.monotonic() < end and not (partial.exists() and partial.stat().st_size > 20_000):
        time.sleep(0.05)
    process.kill()
    process.communicate(timeout=PATIENCE)
    assert not list(tmp_path.glob("*.npz"))
    trace = recover(partial)
    assert trace.num_steps > 10
    assert trace.meta["ended"] == "fault"
    assert trace.meta["robot_time_start"] > 0.0
    ((path, loaded),) = find_traces(tmp_path)
    assert path == partial
    assert loaded.num_steps == trace.num_steps
    done = deploy(port, "--duration", "0.1", "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr


def test_deploy_reports_a_silent_robot_in_one_line(tmp_path):
    """Use a port without a robot."""
    master, slave = os.openpty()
    try:
        done = surefoot("deploy", "trot", "--port", os.ttyname(slave))
    finally:
        os.close(master)
        os.close(slave)
    assert done.returncode == 2
    assert "no robot answers within 2 s" in done.stderr
