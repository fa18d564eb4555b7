"""`surefoot firmware new`: a robot's firmware as a folder of C."""

from __future__ import annotations

import pytest
from compiled_firmware import needs_gcc

pytest.importorskip("mujoco")

from surefoot.cli.main import main
from surefoot.firmware.project import build_firmware


@needs_gcc
def test_a_robots_firmware_is_written_and_compiles_and_runs_the_emulated_robot(tmp_path, capsys):
    folder = tmp_path / "fw"
    assert main(["firmware", "new", "solo8", "--out", str(folder)]) == 0
    assert f"make -C {folder}" in capsys.readouterr().out
    program = build_firmware(folder)
    words = ["--firmware", str(program), "--duration", "0.05"]
    assert main(["emulate", "--robot", "solo8", *words]) == 0
    assert "frames received 0" in capsys.readouterr().err
    assert main(["emulate", "--robot", "go2", *words]) == 2
    assert "is not one of robot go2" in capsys.readouterr().err
    assert main(["firmware", "new", "solo8", "--out", str(folder)]) == 2
    assert "fw exists; give another name" in capsys.readouterr().err


def test_a_word_that_is_no_action_or_no_robot_is_refused(capsys):
    assert main(["firmware", "old"]) == 2
    assert "'old' is not an action" in capsys.readouterr().err
    assert main(["firmware", "new", "no-such-robot"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
