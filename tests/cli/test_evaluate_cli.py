"""`surefoot evaluate` and `surefoot show POLICY`."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import SUREFOOT, assert_rejected, run_surefoot, surefoot
from shipped_variants import modified_policy

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("onnx")

from surefoot.api.extras import install_command

KEYS = {
    *("episodes", "falls", "steps_mean", "distance_mean", "speed_mean", "speed_std", "power_mean"),
    *("return_mean", "return_std", "drift_mean", "gait", "duty_factor", "phases", "world", "policy"),
}
EXTRAS = {
    *("cost_of_transport_mean", "stance", "faults", "seed", "pushes", "push_force", "command", "set", "robot"),
    *("policy_file", "config_hash", "randomize", "actuator", "params", "params_source", "saturation"),
    *("gait_reason", "hottest_motor", "hottest_heat"),
    "terrain",
}
LEGS = {"front_left", "back_left", "front_right", "back_right"}


@pytest.fixture(scope="module")
def policy(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Policy from a very short training, with short episodes."""

    def change(contract: dict[str, Any]) -> None:
        contract["name"] = "beginner"
        contract["task"] |= {"max_steps": 240, "params": {}, "pushes": {"enabled": False}}

    return modified_policy(tmp_path_factory.mktemp("policy") / "beginner.onnx", change, trained / "policy.onnx")


def test_help_is_fast_and_names_the_commands():
    before = os.times()
    done = run_surefoot("--help")
    after = os.times()
    # Processor time, because a busy computer takes longer.
    assert after.children_user + after.children_system - before.children_user - before.children_system < 1.0
    assert done.returncode == 0
    for command in ("train", "evaluate", "show"):
        assert command in done.stdout
    assert surefoot("--version").stdout.startswith("surefoot ")


def test_errors_come_before_anything_heavy_is_imported():
    lines = (
        "evaluate x.onnx --episodes 0",
        "evaluate sensitivity x.onnx --episodes 0",
        "gap x.onnx --to bullet --episodes 0",
    )
    script = (
        "import sys; from surefoot.cli.main import main;"
        f"assert [main(line.split()) for line in {lines}] == [2, 2, 2];"
        "heavy = ('torch', 'mujoco', 'numba', 'matplotlib', 'gymnasium', 'pybullet');"
        "print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_json_is_one_object_with_all_keys(policy: Path):
    done = surefoot("evaluate", policy, "--episodes", "3", "--json", "--seed", "4")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    result = json.loads(done.stdout)
    assert set(result) == KEYS | EXTRAS
    assert (result["episodes"], result["world"], result["policy"]) == (3, "mujoco", "beginner")
    assert set(result["duty_factor"]) == set(result["phases"]) == LEGS
    assert (result["seed"], result["pushes"], result["set"]) == (4, False, {})
    assert result["randomize"] == {}


def test_settings_and_pushes_change_the_result(policy: Path):
    calm, weak, pushed, mildly = (
        json.loads(surefoot("evaluate", policy, "--episodes", "2", "--json", *more).stdout)
        for more in (
            (),
            ("--set", "motor_strength=0.7", "--set", "voltage=15"),
            ("--pushes",),
            ("--push-force", "30", "30"),
        )
    )
    assert weak["set"] == {"motor_strength": 0.7, "voltage": 15.0}
    assert (pushed["pushes"], pushed["push_force"]) == (True, None)
    assert (mildly["pushes"], mildly["push_force"]) == (True, [30.0, 30.0])
    assert len({result["distance_mean"] for result in (calm, weak, pushed, mildly)}) == 4


def test_show_writes_a_video_of_a_policy_without_a_display(policy: Path, tmp_path: Path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    done = surefoot("show", policy, "--duration", "0.4", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "wrote beginner.mp4\n"
    assert done.stderr == f"surefoot: {policy} is a policy: it runs in mujoco, for a video\n"
    frames = ffmpeg.read_frames(str(tmp_path / "beginner.mp4"))
    meta = next(frames)
    assert meta["size"] == (320, 180)
    first = np.frombuffer(next(frames), np.uint8)
    for later in frames:
        last = np.frombuffer(later, np.uint8)
    assert np.abs(first.astype(int) - last).mean() > 0.1
    frames.close()


def test_a_missing_simulator_is_named_with_the_command_that_installs_it(policy: Path):
    hide = "import sys; sys.modules['mujoco'] = None"
    script = f"{hide}\nfrom surefoot.cli.main import main\nsys.exit(main())"
    command = [sys.executable, "-c", script, "evaluate", str(policy)]
    without = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert_rejected(without, f"this needs mujoco, which is not installed: {install_command('sim')}")


def test_an_interrupt_ends_with_130():
    # A balanced gait runs to the end of its long episodes, which would take far longer than the timeout.
    command = [*SUREFOOT, "evaluate", "trot", "--episodes", "600"]
    terminal, other_end = pty.openpty()
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=other_end,
        env=os.environ | {"TERM": "xterm", "COLUMNS": "100"},
    )
    os.close(other_end)
    errors, interrupted = b"", False
    while True:
        try:
            read = os.read(terminal, 4096)
        except OSError:  # the other end is closed
            break
        errors += read
        if not interrupted and re.search(rb"[1-9]\d*%", errors):
            interrupted = True
            process.send_signal(signal.SIGINT)
    os.close(terminal)
    assert process.wait(60) == 130, errors
    assert interrupted
    assert b"Traceback" not in errors


def test_a_released_policy_is_found_by_name(policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from surefoot.api import policies

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(policies, "SEARCH_PATHS", (policy.parent,))
    assert policies.find_policy("beginner") == policy
    with pytest.raises(ValueError, match=r"policy 'trot' .*choices: beginner"):
        policies.find_policy("trot")


@pytest.fixture(scope="module")
def recorded(policy: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """Folder with the traces of three runs, and the output of the `evaluate` command that ran them."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "episode_007.npz").write_bytes(b"of an earlier run")  # which must not count as one of these
    done = surefoot("evaluate", policy, "--episodes", "3", "--out", folder, "--json")
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


def test_recorded_runs_have_the_same_metrics(recorded: tuple[Path, dict[str, object]]):
    folder, ran = recorded
    done = surefoot("evaluate", "--trace", folder, "--json")
    assert done.returncode == 0, done.stderr
    assert sorted(Path(file).name for file in ran["files"]) == [
        *("episode.png", "episode_000.npz", "episode_001.npz", "episode_002.npz", "footfalls.png")
    ]
    measured = json.loads(done.stdout)
    assert {key: measured[key] for key in KEYS} == {key: ran[key] for key in KEYS}
    assert len(measured["traces"]) == 3
    files = sorted(folder.glob("*.npz"))
    two = surefoot("evaluate", "--trace", files[0], files[1])
    assert "beginner in mujoco" in two.stdout
    assert re.search(r"falls +\d of 2", two.stdout)


def test_the_motion_of_a_robot_without_a_measured_position_is_estimated(
    recorded: tuple[Path, dict[str, object]], tmp_path: Path
):
    from surefoot.task.trace import EpisodeTrace

    trace = EpisodeTrace.load(sorted(recorded[0].glob("*.npz"))[0])
    blind = ("base_position_world", "base_quat_world", "foot_contact", "foot_position_world", "true_motor_angle")
    unseen = replace(trace, **{name: np.full_like(getattr(trace, name), np.nan) for name in blind})
    unseen.save(tmp_path / "runs" / "run.npz")
    done = surefoot("evaluate", "--trace", tmp_path / "runs", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    rows = dict(re.findall(r"^ ?(\S.*?)  +(\S.*?) *$", done.stdout, re.MULTILINE))
    assert rows["gait"] == "-"
    travelled = trace.base_position_world[-1, 0] - trace.base_position_world[0, 0]
    assert float(rows["distance"].split()[0]) == pytest.approx(travelled, rel=0.05, abs=0.05)
    assert "are estimated from IMU and legs" in done.stdout
    assert re.search(r"intervals of the estimates: distance .* to .*, speed .* to .*, return .* to ", done.stdout)
    assert rows["power"] == f"{trace.energy.sum() / trace.duration:.3f} W"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["episode.png"]


def test_a_policy_with_commands_is_measured_over_a_grid_of_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from surefoot.evaluation import tracking
    from surefoot.task.trace import EpisodeTrace

    monkeypatch.setattr(tracking, "GRID_SIZE", 2)
    from surefoot.api.episodes import captions
    from surefoot.api.policies import find_policy, load_gait, run_policy
    from surefoot.evaluation.conditions import Condition, with_duration
    from surefoot.report.figures.runs import episode_plot

    words = ("evaluate", "go2-steer", "--command-grid", "--threads", 1, "--out", tmp_path)
    done = surefoot(*words, "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    # Two forward velocities with two yaw rates, and two with two lateral velocities.
    assert result["episodes"] == 8
    assert str(tmp_path / "tracking.png") in result["files"]
    traces = [EpisodeTrace.load(path) for path in sorted(tmp_path.glob("*.npz"))]
    assert len({tuple(trace.command[-1]) for trace in traces}) == 8
    assert all(np.ptp(trace.command, axis=0).max() == 0 for trace in traces)
    # The policy follows: errors are small compared with commands of 1 m/s and 1 rad/s.
    assert set(result["rmse"]) == set(result["rmse_stride"]) == {"forward", "sideways", "yaw_rate"}
    assert max(result["rmse_stride"].values()) < 0.3
    read = surefoot("evaluate", "--trace", *sorted(tmp_path.glob("*.npz")))
    row = re.search(r"stride-averaged RMSE: forward, sideways, yaw rate +(.*?) *$", read.stdout, re.MULTILINE)
    errors = ", ".join(
        f"{value:.3f} {unit}"
        for value, unit in zip(result["rmse_stride"].values(), ("m/s", "m/s", "rad/s"), strict=True)
    )
    assert row is not None
    assert row[1] == errors
    # An episode of the task takes 9.6 s; a file extends it to two seconds after its last row.
    policy, robot, task, _ = load_gait(find_policy("go2-steer"), None)
    for end, duration in ((7.0, 9.6), (9.0, 11.008)):
        (tmp_path / "way.csv").write_text(f"time,forward,sideways,yaw_rate\n0,0.5,0,0\n{end},0,0,0\n")
        run = Condition(commands=tmp_path / "way.csv").apply(task, robot)
        assert 0.016 * run.max_steps == pytest.approx(duration)
    (trace,) = run_policy(policy, with_duration(run, robot, 0.8), 1, "mujoco", 1)
    texts = captions(trace)
    assert len(texts) == trace.num_steps == 50
    assert "command: forward 0.50, left 0.00 m/s, turn 0.00 rad/s\nrobot: forward 0." in texts[-1]
    episode_plot(trace, robot, tmp_path / "episode.png")
    assert (tmp_path / "episode.png").stat().st_size > 10_000


def test_a_policy_is_measured_with_a_constant_command_on_an_identified_robot():
    words = ("evaluate", "go2-steer", "--command", 0.4, 0.2, 0.0, "--episodes", 1, "--duration", 2.5, "--threads", 1)
    done = surefoot(*words, "--params", "fitted", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["command"] == [0.4, 0.2, 0.0]
    assert result["params"]["torque_lag"] == 0.0151
    # Energy per weight and distance along the command, not along the world's x axis.
    way = result["power_mean"] * 2.496 / (16.085004 * 9.81 * result["cost_of_transport_mean"])
    assert way == pytest.approx(np.hypot(0.4, 0.2) * 2.0, rel=0.35)
    assert way > result["distance_mean"]


def test_the_success_rate_on_terrain_is_measured():
    words = (
        "evaluate",
        "go2-steer",
        "--command",
        0.5,
        0,
        0,
        "--episodes",
        2,
        "--duration",
        3,
        "--threads",
        1,
        "--json",
    )
    summary = json.loads(surefoot(*words, "--terrain", "slope_down:10").stdout)
    assert (summary["terrain"], summary["success"], summary["falls"]) == ("slope_down:10", 1.0, 0)
    # Feet that are lifted by a few centimetres do not clear steps of 0.2 m.
    assert json.loads(surefoot(*words, "--terrain", "stairs:0.2").stdout)["success"] == 0.0
