"""`surefoot robot new` and `surefoot robot check`: import of a robot, and checks of its description."""

from __future__ import annotations

import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from odd_quadrupeds import urdf
from PIL import Image
from processes import surefoot

from surefoot.cli import robot as robot_command
from surefoot.cli.main import main
from surefoot.robot import RobotDescription
from surefoot.robot.importing.reader import read_robot

SOLO = RobotDescription.load("solo8")


def test_an_imported_robot_has_an_image(tmp_path: Path) -> None:
    result = surefoot("robot", "new", str(SOLO.urdf.path), "--name", "mine", "--knees", "backward", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "mine: 2.18 kg, 8 motors, legs of 0.320 m, forward is +x of the file" in result.stdout
    assert "guessed  kp = " in result.stdout
    assert "pass      stands" in result.stdout
    robot = RobotDescription.load(tmp_path / "mine")
    assert robot.motor_names == tuple(name for leg in ("FL", "FR", "HL", "HR") for name in (f"{leg}_HFE", f"{leg}_KFE"))
    picture = np.asarray(Image.open(tmp_path / "mine/robot.png").convert("RGB"), int)
    assert picture.shape == (720, 960, 3)
    # The image contains the robot's grey, and the axes' red and green.
    for red, green, blue in ((200, 40, 40), (30, 140, 50)):
        assert (np.abs(picture - [red, green, blue]).sum(axis=2) < 30).sum() > 100


def test_a_warning_passes_and_origins_of_numbers_are_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("odd.urdf").write_text(urdf(0.004))
    assert main(["robot", "new", "odd.urdf", "--out", "odd", "--name", "odd"]) == 0
    out = capsys.readouterr().out
    assert "stated   actuator.torque_limit = 20.0: N m, from odd.urdf" in out
    assert "warn      left and right        back_left's upper link is 4 mm longer than back_right's" in out
    assert "to do: correct positions and lengths of links" in out
    assert "9 passed, 1 passed with a warning, 0 failed" in out
    assert "train trot --robot" in out
    assert main(["robot", "check", "odd"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"guessed  actuator.kp = [\d.]+: 1.5 m g l, so that two legs", out)
    assert main(["robot", "check", "odd", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [item["name"] for item in report["checks"] if item["warn"]] == ["left and right"]
    stated = {item["origin"].split(" = ")[0] for item in report["numbers"] if not item["guessed"]}
    assert {"actuator.torque_limit", "actuator.speed_limit"} <= stated


def test_check_reports_a_placeholder_torque_and_unequal_legs(tmp_path: Path) -> None:
    folder = tmp_path / "odd"
    folder.mkdir()
    sheet, urdf = (SOLO.folder / "robot.toml").read_text(), SOLO.urdf.path.read_text()
    (folder / "robot.toml").write_text(sheet.replace("torque_limit = 2.7", "torque_limit = 1000.0"))
    # One upper link has twice the mass of the others.
    place = urdf.index("<mass", urdf.index('name="front_left_upper"'))
    end = urdf.index("/>", place)
    (folder / "solo8.urdf").write_text(urdf[:place] + '<mass value="0.5" ' + urdf[end:])
    result = surefoot("robot", "check", str(folder), "--json", cwd=tmp_path)
    assert result.returncode == 3, result.stderr
    report = json.loads(result.stdout)
    assert report["passed"] is False
    wrong = {item["name"]: item for item in report["checks"] if item["passed"] is False}
    assert set(wrong) == {"torque limits", "left and right"}
    assert "placeholder" in wrong["torque limits"]["message"]
    assert "front_left, front_right" in wrong["left and right"]["message"]
    assert all(item["remedy"] for item in wrong.values())


def test_check_names_the_motor_that_is_too_weak_and_the_required_torque(tmp_path: Path) -> None:
    folder = tmp_path / "weak"
    shutil.copytree(SOLO.folder, folder)
    sheet = (folder / "robot.toml").read_text()
    # Standing requires 0.7 N m in a knee, a trot 1.8 N m.
    (folder / "robot.toml").write_text(sheet.replace("torque_limit = 2.7", "torque_limit = 0.5"))
    result = surefoot("robot", "check", str(folder), "--json", cwd=tmp_path)
    assert result.returncode == 3, result.stderr
    wrong = {item["name"]: item for item in json.loads(result.stdout)["checks"] if item["passed"] is False}
    assert set(wrong) == {"stands", "torque to stand", "torque to trot"}
    for item in wrong.values():
        assert "has 0.5 N m" in item["message"]
        assert "KFE needs 0.7" in item["message"] or item["name"] == "torque to trot"
        assert "stronger motors" in item["remedy"]
        assert "stiffer gains" not in item["remedy"]


@pytest.mark.parametrize("name", RobotDescription.available())
def test_released_robots_pass(name: str, tmp_path: Path) -> None:
    result = surefoot("robot", "check", name, "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    assert len(json.loads(result.stdout)["checks"]) >= 7


def test_a_step_too_long_for_light_rotors_is_shortened(tmp_path: Path) -> None:
    # Without armature in the file, 0.005 m l^2 is guessed; with a hundredth of it the damping requires a shorter step.
    legs = "".join(
        f"""<body name="{n}" pos="{x} {y} 0"><joint name="{n}_hip" axis="0 1 0" armature="1e-5"/>
        <inertial pos="0 0 -.1" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>
        <body name="{n}_lower" pos="0 0 -.2"><joint name="{n}_knee" axis="0 1 0" armature="1e-5" range="-2.6 -.5"/>
        <inertial pos="0 0 -.1" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>
        <geom type="sphere" size=".02" pos="0 0 -.2"/></body></body>"""
        for n, x, y in (("FL", 0.2, 0.1), ("FR", 0.2, -0.1), ("RL", -0.2, 0.1), ("RR", -0.2, -0.1))
    )
    base = '<geom type="box" size=".2 .1 .05"/><inertial pos="0 0 0" mass="6" diaginertia=".05 .1 .12"/>'
    (tmp_path / "dog.xml").write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="trunk"><freejoint/>'
        f"{base}{legs}</body></worldbody></mujoco>"
    )
    result = surefoot("robot", "new", "dog.xml", cwd=tmp_path)
    assert "the longest that servos, friction and feet allow" in result.stdout, result.stdout + result.stderr
    assert "pass      physics step" in result.stdout
    assert result.stdout.count("servo_step") == 1
    assert RobotDescription.load(tmp_path / "dog").timing.servo_step < 0.001


def test_uncertain_knees_are_asked_for_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    solo = read_robot(SOLO.urdf.path)
    assert robot_command.find_knees(solo) is None  # no terminal: the guess holds
    assert "guessed  knees: inward; " in (out := capsys.readouterr().out)
    assert "--knees forward|backward|outward changes it" in out
    terminal = io.StringIO("sideways\noutward\n\n")
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr("sys.stdin", terminal)
    assert robot_command.find_knees(solo) == "outward"
    assert robot_command.find_knees(solo) == "inward"
    terminal.seek(0)
    go2 = read_robot(RobotDescription.load("go2").urdf.path)
    capsys.readouterr()
    assert robot_command.find_knees(go2) is None
    assert capsys.readouterr().out == "knees point backward, according to the knees' limits\n"


def solo8_with(pattern: str, text: str) -> str:
    """Return the URDF of a released robot with all matches of a pattern replaced."""
    changed = re.sub(pattern, text, RobotDescription.load("solo8").urdf.path.read_text(), flags=re.DOTALL)
    assert changed != RobotDescription.load("solo8").urdf.path.read_text()
    return changed


@pytest.mark.parametrize(
    ("pattern", "text", "message"),
    [
        (
            r'(<joint name="[A-Z]*_KFE".*?<limit) lower="[^"]*" upper="[^"]*"',
            r'\1 lower="0" upper="0.01"',
            "extension is",
        ),
        (r'effort="[^"]*"', 'effort="1e-12"', "torque_limit is 1e-12"),
    ],
)
@pytest.mark.parametrize("exists", [False, True])
def test_no_folder_is_written_for_an_invalid_robot(
    pattern: str,
    text: str,
    message: str,
    exists: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dog.urdf").write_text(solo8_with(pattern, text))
    if exists:
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "notes.txt").write_text("mine")
    assert main(["robot", "new", "dog.urdf", "--out", "out", "--name", "dog", "--knees", "inward"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.endswith("; out was not written\n")
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.glob("out/*")] == (["notes.txt"] if exists else [])
    assert (tmp_path / "out").exists() == exists
