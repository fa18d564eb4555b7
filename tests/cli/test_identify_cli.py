"""`surefoot identify` as a user runs it, on emulated robots."""

from __future__ import annotations

import io
import json
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import SUREFOOT, EmulatorHere, assert_rejected, emulators, printed_commands, surefoot

from surefoot.api.extras import install_command
from surefoot.cli.helpers.identify_run import check_robot
from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.errors import SurefootError
from surefoot.identify.registry import EXPERIMENTS
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import read_params


def identify(*words: object) -> subprocess.CompletedProcess[str]:
    return surefoot("identify", *words)


def test_motor_figure_without_a_log(tmp_path: Path) -> None:
    out = tmp_path / "figures" / "motor.png"
    done = identify("motor-figure", "--out", out, "--duration", 0.1)
    assert done.returncode == 0
    assert "servo and DC motor: " in done.stdout
    assert "rad RMS relative to target" in done.stdout
    assert out.read_bytes().startswith(b"\x89PNG")


def test_a_recording_from_one_world_is_compared_with_both_motor_models_in_another(tmp_path: Path) -> None:
    pytest.importorskip("pybullet")
    log, out = tmp_path / "motor.csv", tmp_path / "motor.png"
    words = ["motor-figure", "--json", "--out", out]
    assert identify(*words, log, "--world", "bullet", "--duration", 0.5).returncode == 0
    output = json.loads(identify(*words, "--log", log).stdout)
    assert output["against"] == str(log)
    # The same motor model agrees in another engine; the other model does not.
    assert output["rms_error"]["dc"] < 0.002
    assert output["rms_error"]["constraint"] > 5 * output["rms_error"]["dc"]


def test_identify_without_arguments_lists_the_experiments():
    done = identify()
    assert done.returncode == 2
    assert identify("--help").stdout == done.stderr
    for name in ("air", "latency", "motor", "mass", "contact", "--trace FOLDER", "motor-figure"):
        assert f"\n  {name}  " in done.stderr


# --- experiments on a robot -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hanging() -> Iterator[EmulatorHere]:
    """Robot on its rack, shared by several tests."""
    pytest.importorskip("mujoco")
    with emulators(EmulatorHere) as start:
        yield start("--lockstep", "--rack")


Recorded = tuple[Path, subprocess.CompletedProcess[str]]
ON_THE_ROBOTS_COMPUTER = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        absent = {"mujoco", "numba", "gymnasium", "scipy", "cma", "pybullet", "torch", "onnx", "matplotlib", "PIL"}
        if name.split(".")[0] in absent:
            raise ModuleNotFoundError(f"the robot's computer has no {name}", name=name)

sys.meta_path.insert(0, Absent())
from dataclasses import replace
from surefoot.cli.main import main
from surefoot.identify.registry import EXPERIMENTS
contact = EXPERIMENTS["contact"]

def shorter(robot):
    plan = contact.plan(robot)
    lengths = {"drag": 3.0, "nod": 2.0}
    kept = (phase for phase in plan.phases if phase.name not in ("drop", "rock"))
    return replace(plan, phases=tuple(replace(p, duration=lengths.get(p.name, p.duration)) for p in kept))

EXPERIMENTS["contact"] = replace(contact, plan=shorter)
sys.exit(main(sys.argv[1:]))
"""


def run_bare(*words: object) -> subprocess.CompletedProcess[str]:
    """Run `surefoot identify` with only the bare install; contact is shortened and without phases that no fit uses."""
    command = [sys.executable, "-c", ON_THE_ROBOTS_COMPUTER, "identify", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=200)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Folder of an experiment recorded on the robot's computer, and the finished process."""
    pytest.importorskip("mujoco")
    folder = tmp_path_factory.mktemp("contact")
    # The robot's folder is removed afterwards, since the recording contains the robot's description.
    robot = shutil.copytree(RobotDescription.load("minitaur").folder, folder / "my robots" / "mine")
    with emulators(EmulatorHere) as start:
        port = start("--lockstep", "--set", "contact_friction=0.7", "--robot", robot).port
        words = ["contact", "--port", port, "--lockstep", "--yes", "--record-only", "--out", folder / "run"]
        done = run_bare(*words, "--robot", robot)
    shutil.rmtree(robot)
    return folder / "run", done


def test_record_only_needs_the_bare_install(recorded: Recorded):
    folder, done = recorded
    assert done.returncode == 0, done.stderr
    assert [path.name for path in folder.iterdir()] == ["recording.npz"]
    assert done.stdout.startswith("contact experiment with minitaur on flat ground, ")
    phases = [phase.name for phase in EXPERIMENTS["contact"].plan(RobotDescription.load("minitaur")).phases]
    phases = [name for name in phases if name not in ("drop", "rock")]
    for output in (phases[0], "drag x 2", "motors are damped if an angle leaves", "N m for 0.4 s"):
        assert output in done.stdout
    assert f"contact experiment recorded: {folder / 'recording.npz'}" in done.stdout
    assert printed_commands(done.stdout)["fit it"][1:] == ["identify", "contact", "--recording", str(folder)]
    # Without a terminal, one line of plain text per phase.
    lines = [line for line in done.stderr.splitlines() if line.startswith("surefoot: ")]
    assert [line.partition(", ")[0] for line in lines] == [f"surefoot: {name}" for name in phases]
    assert lines[0].startswith(f"surefoot: {phases[0]}, 1 of {len(phases)}, ")
    assert lines[0].endswith(" s left")
    assert "\x1b" not in done.stdout + done.stderr


def test_identify_never_overwrites_a_recording(recorded: Recorded):
    path = recorded[0] / "recording.npz"
    before = path.read_bytes()
    done = identify("contact", "--port", "/dev/none", "--yes", "--record-only", "--out", path.parent)
    assert_rejected(done, f"{path} exists and is not overwritten; give another folder with --out")
    assert path.read_bytes() == before


def test_a_recording_is_fitted(recorded: Recorded, robot: RobotDescription, tmp_path: Path):
    folder, _ = recorded
    params, out = tmp_path / "known" / "robot.toml", tmp_path / "out"
    params.parent.mkdir()
    params.write_text('[params]\nvoltage = 15.5\nmotor_strength = 0.98\n[note]\nby = "hand"\n')
    done = identify("contact", "--recording", folder, "--params", params, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "surefoot: warning: contact should be run after motor and mass, but " in done.stderr
    assert " contact_friction " in done.stdout
    assert f"wrote {params}, {out / 'report.png'}, {out / 'report.html'}" in done.stdout
    overlay = read_params(params, robot)
    assert {"voltage", "motor_strength", "contact_friction"} <= set(overlay.names)
    assert (overlay.params.voltage[0], overlay.tables["note"]) == (15.5, {"by": "hand"})
    low, high = overlay.tables["intervals"]["contact_friction"]
    assert low <= overlay.params.contact_friction[0] <= high
    assert overlay.params.contact_friction[0] == pytest.approx(0.7, abs=0.2)
    output = overlay.tables["identified"]["contact"]
    assert output["file"] == str(folder / "recording.npz")
    assert overlay.tables["identified_by"]["contact_friction"] == "contact"
    assert (out / "report.png").read_bytes().startswith(b"\x89PNG")
    assert output["data"] in (out / "report.html").read_text()
    # Again with the results so far, with --json, and without --params: the file is next to the report.
    again = tmp_path / "again"
    done = identify("contact", "--recording", folder / "recording.npz", "--json", "--out", again)
    assert done.returncode == 0, done.stderr
    found_again: dict[str, Any] = json.loads(done.stdout)
    assert found_again["digest"] == output["data"]
    assert found_again["lacks"] == ["motor", "mass"]
    assert found_again["files"][0] == str(again / "robot.toml")
    (friction,) = (item for item in found_again["estimates"] if item["name"] == "contact_friction")
    assert friction["interval"][0] <= friction["value"] <= friction["interval"][1]
    assert friction["before"] == robot.contact.friction
    assert "contact_friction" in tomllib.loads((again / "robot.toml").read_text())["params"]


def test_identify_rejects_before_motion_without_fit_libraries(tmp_path: Path):
    done = run_bare("latency", "--port", "/dev/none", "--lockstep", "--yes", "--out", tmp_path / "out")
    assert done.returncode == 2
    message = f"the fit requires mujoco, which is not installed: {install_command('sim')}; surefoot identify latency"
    assert message in done.stderr
    assert "--record-only records without it" in done.stderr
    assert not (tmp_path / "out").exists()


def test_ctrl_c_ends_an_experiment_and_keeps_the_recording(hanging: EmulatorHere, tmp_path: Path):
    out = tmp_path / "out"
    phase = EXPERIMENTS["motor"].plan(RobotDescription.load("minitaur")).phases[3].name
    words = ["motor", "--port", hanging.port, "--lockstep", "--yes", "--out", out]
    process = subprocess.Popen(
        [*SUREFOOT, "identify", *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    for line in process.stderr:
        if f"surefoot: {phase}, 4 of " in line:
            process.send_signal(signal.SIGINT)
            break
    message, errors = process.communicate(timeout=60)
    assert process.returncode == 3
    with np.load(out / "recording.npz") as file:
        ended = json.loads(str(file["meta"]))["ended"]
    assert ended == f"stopped by the operator (in phase '{phase}')"
    assert f": {ended}; recorded until then: {out / 'recording.npz'}" in errors
    assert "to fit it" not in message
    assert [path.name for path in out.iterdir()] == ["recording.npz"]
    # A stopped recording can't be fitted later.
    assert_rejected(identify("motor", "--recording", out), "stopped early: stopped by the operator")


def test_an_experiment_rejects_a_robot_that_differs_from_its_data_sheet(robot: RobotDescription):
    message = make_handshake(robot, Limits.from_robot(robot), "", robot.timing.servo_step)
    check_robot(message, robot)
    signs = np.array(message.motor_signs, float)
    signs[3] *= -1
    for other, why in (
        (replace(message, robot="cat"), "robot: it is 'cat'; the data sheet is for 'minitaur'"),
        (replace(message, motor_names=message.motor_names[::-1]), "motors: motor 0 is '"),
        (replace(message, servo_period=0.002), "servo period: 2 ms; the data sheet says 1 ms"),
        (replace(message, motor_signs=signs), f"motor signs: {robot.motor_names[3]} has "),
    ):
        with pytest.raises(SurefootError, match=re.escape(f"the robot does not match its data sheet: {why}")):
            check_robot(other, robot)


class Terminal(io.StringIO):
    """Operator who answers on a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("answer", "code"), [("n\n", 2), ("\n", 2), ("yes\n", 0)])
def test_experiment_asks_at_a_terminal(
    hanging: EmulatorHere, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, code: int
):
    latency = EXPERIMENTS["latency"]
    plan = latency.plan(RobotDescription.load("minitaur"))
    short = replace(latency, plan=lambda robot: replace(plan, phases=plan.phases[:1]))
    monkeypatch.setitem(EXPERIMENTS, "latency", short)
    monkeypatch.setattr("sys.stdin", Terminal(answer))
    monkeypatch.chdir(tmp_path)
    done = identify("latency", "--port", hanging.port, "--lockstep", "--record-only", "--out", "out", "--json")
    message, errors = done.stdout, done.stderr
    assert done.returncode == code, errors
    # The plan is printed before the question; stdout contains only the JSON object.
    question = errors.index("Motors will move. Does the robot hang freely, with its legs in the air? [y/N] ")
    assert 0 < errors.index("motor angles from ") < question
    assert ("not confirmed; nothing has moved" in errors) == (code == 2)
    assert Path("out/recording.npz").exists() == (code == 0)
    if code == 0:
        output = json.loads(message)
        assert (output["experiment"], output["ended"]) == ("latency", "complete")
        assert output["recording"] == "out/recording.npz"
    else:
        assert message == ""


def test_identify_warns_of_missing_experiments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    Path("known.toml").write_text("[params]\n[identified.motor]\ndate = 2026-01-01\n")
    for name, params, output in (
        ("contact", (), "contact should be run after motor and mass, but --params FILE is not given"),
        (
            "contact",
            ("--params", "known.toml"),
            "contact should be run after mass, but known.toml has no results of it",
        ),
        ("latency", ("--params", "new.toml"), ""),
    ):
        done = identify(name, "--port", "/dev/none", "--yes", *params)
        assert done.returncode == 2
        assert output in done.stderr
        assert ("warning" in done.stderr) == bool(output)


# --- recorded runs ----------------------------------------------------------------------------------------


def test_identify_from_traces(tmp_path: Path):
    pytest.importorskip("mujoco")
    pytest.importorskip("matplotlib")
    traces, out = tmp_path / "traces", tmp_path / "out"
    words = ["evaluate", "trot", "--episodes", 2, "--threads", 1, "--set", "motor_strength=0.9", "--out", traces]
    assert surefoot(*words).returncode == 0
    done = identify("--trace", traces, "--fit", "motor_strength", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    output = json.loads(done.stdout)
    assert output["experiment"] == "traces"
    assert output["traces"] == [str(traces / f"episode_00{i}.npz") for i in range(2)]
    overlay = tomllib.loads((out / "robot.toml").read_text())
    assert set(overlay["params"]) == {"motor_strength"}
    assert np.mean(overlay["params"]["motor_strength"]) == pytest.approx(0.9, abs=0.03)
    assert overlay["identified"]["traces"]["file"] == str(traces)
    done = identify("--trace", traces, "--fit", "contact_friction")
    assert_rejected(done, "traces can't identify 'contact_friction'; choices: motor_strength")


def test_identify_from_logs_with_one_held_out(tmp_path: Path):
    pytest.importorskip("mujoco")
    pytest.importorskip("matplotlib")
    from surefoot.identify.motion.recorded import RecordedMotion
    from surefoot.identify.replay import Replayer, segment_from_motion

    pupper, logs, out = RobotDescription.load("pupper_v2"), tmp_path / "logs", tmp_path / "out"
    words = ("--trace", logs, "--robot", "pupper_v2")
    logs.mkdir()
    truth = PhysicalParams.nominal(pupper).with_values(pupper, control_latency=0.030)
    replayer, time = Replayer(pupper, 1, torques=False), 0.01 * np.arange(71)
    # Times of readings are unknown; they are assumed to be half a row old.
    read = np.concatenate([[0.0], time[1:] - 0.005])
    for name, rate in (("slow", 9.0), ("fast", 13.0)):
        command = np.tile(np.tile([0.0, 0.6, -1.2], 4), (len(time), 1))
        command[:, 1] += 0.3 * np.sin(rate * time)
        blank = RecordedMotion(name, time, command, read)
        output = replayer.run(segment_from_motion(blank, pupper), truth)
        np.savez(logs / f"{name}.npz", time=time, command=command, motor_angle=output.motor_angle[0])
    assert_rejected(
        identify(*words, "--hold-out", "quick"), "--hold-out names 'quick', which is not a log; choices: fast, slow"
    )
    assert_rejected(identify("--trace", logs, "--rack", "slow"), "--rack is for logs of a robot with joint actuators")
    how = ("--rack", "fast", "slow", "--hold-out", "fast", "--fit", "control_latency", "--out", out)
    done = identify(*words, *how, "--json")
    assert done.returncode == 0, done.stderr
    message = json.loads(done.stdout)
    assert message["logs"] == [str(logs / name) for name in ("fast.npz", "slow.npz")]
    overlay = tomllib.loads((out / "robot.toml").read_text())["params"]
    assert overlay["control_latency"] == pytest.approx(0.030, abs=0.001)
    assert [check["what"] for check in message["checks"]] == ["slow.npz, fitted: 0.7 of 0.7 s", "fast.npz, held out"]
    for check in message["checks"]:
        assert check["after"] < 0.5 * check["before"], check
