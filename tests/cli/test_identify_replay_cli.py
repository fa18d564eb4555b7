"""`surefoot identify replay`, `import` and `--trace` on the logs of a real robot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.cli.main import main
from surefoot.robot import RobotDescription
from surefoot.robot.params_file import read_params
from surefoot.task.trace import EpisodeTrace

DATA = Path(__file__).parents[2] / "data" / "pupper_v2"


def test_replay_with_identified_parameters_has_small_errors(capsys: pytest.CaptureFixture[str]):
    words = [str(DATA / "one_hip_200hz.npz"), "--robot", "pupper_v2", "--rack", "--json"]
    assert main(["identify", "replay", *words, "--params", "identified"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["moving"] == ["rightFrontUpperLegMotor"]
    assert output["rms"] == output["rms_by_motor"]["rightFrontUpperLegMotor"] < 0.021 / 5
    assert set(output["rms_imu"]) == {"roll", "pitch", "roll_rate", "pitch_rate"}
    assert main(["identify", "replay", *words]) == 0
    assert json.loads(capsys.readouterr().out)["rms"] > output["rms"]


def test_an_imported_log_replays_like_the_original_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("matplotlib")
    log, trace, figure = DATA / "one_hip_200hz.npz", tmp_path / "trace.npz", tmp_path / "figure.png"
    assert main(["identify", "import", str(log), "--robot", "pupper_v2", "--out", str(trace)]) == 0
    assert "missing: motor_velocity, motor_torque" in capsys.readouterr().out
    output = []
    for path in (log, trace):
        assert main(["identify", "replay", str(path), "--robot", "pupper_v2", "--rack", "--json"]) == 0
        output.append(json.loads(capsys.readouterr().out))
    assert output[0]["rms_by_motor"] == output[1]["rms_by_motor"]
    beside = str(DATA / "published_simulator" / "one_hip_200hz.npz")
    words = ["--robot", "pupper_v2", "--rack", "--beside", beside, "--out", str(figure)]
    assert main(["identify", "replay", str(log), *words]) == 0
    assert f"{beside}: 0.0" in capsys.readouterr().out
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_import_prints_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    np.savez(tmp_path / "log.npz", time=[0.0, 0.01, 0.01, 0.03], command=np.linspace(0, 1, 48).reshape(4, 12))
    files = str(tmp_path / "log.npz"), "--robot", "pupper_v2", "--out", str(tmp_path / "trace.npz")
    words = ["identify", "import", *files]
    assert main([*words, "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["missing"][0] == "motor_angle"
    assert (output["timing"]["rows"], output["timing"]["repeated_times"]) == (4, pytest.approx(1 / 3))
    assert EpisodeTrace.load(output["trace"]).num_steps == 4


def test_gains_are_stored_in_a_trace_and_reported_by_a_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log, trace = str(DATA / "one_hip_200hz.npz"), str(tmp_path / "trace.npz")
    words = ["identify", "import", log, "--robot", "pupper_v2", "--out", trace]
    assert main([*words, "--set", "servo_kp=9", "servo_kd=0.8"]) == 0
    assert EpisodeTrace.load(trace).meta["params"] == {"servo_kp": 9.0, "servo_kd": 0.8}
    capsys.readouterr()
    replay = ["identify", "replay", trace, "--robot", "pupper_v2", "--rack"]
    for more, text in (
        ([], "gains: servo_kp 9 and servo_kd 0.8, from the log"),
        (["--set", "servo_kp=7"], "gains: servo_kp 7 and servo_kd 0.8, from --set"),
    ):
        assert main([*replay, *more]) == 0
        assert capsys.readouterr().out.startswith(text)
    file = tmp_path / "file.toml"
    file.write_text('robot = "pupper_v2"\n[params]\n[gains]\nservo_kp = 6.0\nservo_kd = 0.5\nstated = []\n')
    assert main(["identify", "replay", log, "--robot", "pupper_v2", "--rack", "--params", str(file), "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert (output["gains"]["servo_kp"], output["gains_from"]) == ([6.0] * 12, str(file))
    assert main([*words, "--set", "motor_friction=1"]) == 2
    assert "--set names motor_friction; a log has only the gains servo_kp, servo_kd" in capsys.readouterr().err


def test_help_of_trace_needs_no_value(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as shown:
        main(["identify", "--trace", "--help"])
    assert shown.value.code == 0
    assert "--hold-out" in capsys.readouterr().out


def test_the_plan_of_air_is_shown_with_its_expected_accuracy(capsys: pytest.CaptureFixture[str]):
    words = ["identify", "air", "--plan", "--robot", "go2", "--set", "servo_kp=20", "servo_kd=1.5"]
    assert main([*words, "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    by_name = {(item["name"], item["index"]): item for item in output["estimates"]}
    assert "servo_kp" not in {name for name, _ in by_name}
    low, high = by_name["motor_viscous_friction", 0]["interval"]
    assert low < 0.235 < high
    assert high - low < 0.4


def test_a_fit_writes_the_values_that_it_was_told(tmp_path: Path):
    robot, file = RobotDescription.load("pupper_v2"), tmp_path / "robot.toml"
    words = ["--trace", str(DATA / "one_hip_200hz.npz"), "--robot", "pupper_v2", "--rack", "one_hip_200hz"]
    words += ["--fit", "motor_friction", "--duration", "2", "--params", str(file), "--out", str(tmp_path / "report")]
    assert main(["identify", *words, "--set", "leg_mass_ratio=1.1", "servo_kp=9"]) == 0
    written = read_params(file, robot).values
    assert written["leg_mass_ratio"] == 1.1
    assert written["servo_kp"] == 9.0
    assert "motor_friction" in written
    assert "base_mass_ratio" not in written
