"""`surefoot robot firmware`: a robot's firmware as a folder of C sources, and the test of a motor."""

from __future__ import annotations

import pytest
from compiled_firmware import needs_gcc
from processes import EmulatorHere

pytest.importorskip("mujoco")

from surefoot.cli.main import main
from surefoot.deploy.messages import Reason
from surefoot.firmware.project import build_firmware


@needs_gcc
def test_firmware_compiles_and_runs_the_emulated_robot(tmp_path, capsys):
    folder = tmp_path / "fw"
    assert main(["robot", "firmware", "new", "solo8", "--out", str(folder)]) == 0
    assert f"make -C {folder}" in capsys.readouterr().out
    program = build_firmware(folder)
    words = ["--firmware", str(program), "--duration", "0.05"]
    assert main(["emulate", "--robot", "solo8", *words]) == 0
    assert "frames received 0" in capsys.readouterr().err
    assert main(["emulate", "--robot", "go2", *words]) == 2
    assert "is not for robot go2" in capsys.readouterr().err
    assert main(["robot", "firmware", "new", "solo8", "--out", str(folder)]) == 2
    assert "fw exists; give another name" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fault", "code", "text"),
    [
        (None, 0, "pass      back_left_1_motor     a duty of -0.05 turned it by -0."),
        ("flip-sign=3", 3, "the wrong direction"),
        ("swap-motors=2", 3, "and back_left_2_motor by -0."),
    ],
)
def test_one_motor_is_turned_without_the_servo(fault, code, text, capsys):
    robot = EmulatorHere("--lockstep", "--rack", *(("--fault", fault) if fault else ()))
    words = ["back_left_1_motor", "--port", robot.port, "--lockstep", "--yes", "--duty", "-0.05"]
    try:
        assert main(["robot", "firmware", "motor", *words]) == code
    finally:
        robot.stop()
    output = capsys.readouterr().out
    assert text in output
    assert (robot.board.firmware.armed, robot.board.firmware.reason) == (False, Reason.HOST)
