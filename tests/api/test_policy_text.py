"""Contract of a policy file, as printed by `surefoot show POLICY --contract`."""

from __future__ import annotations

import pytest

from surefoot.api.policies import find_policy
from surefoot.cli.main import main


def print_contract(policy: str, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    assert main(["show", policy, "--contract"]) == 0
    lines = capsys.readouterr().out.splitlines()
    width = max(line.find("  ") for line in lines if line.startswith("height map")) + 2
    assert width
    return {name.strip(): text.strip() for name, _, text in (line.partition("  ") for line in lines)}


def test_a_policy_with_commands(capsys: pytest.CaptureFixture[str]) -> None:
    facts = print_contract("go2-steer", capsys)
    assert facts["robot"].startswith("go2, 12 motors: FR_hip_joint")
    assert facts["commands"].startswith("forward ")
    assert facts["gains"] == "kp 40, kd 1"
    assert facts["control step"].endswith(" Hz)")
    assert facts["height map"] == facts["plug-ins"] == "none"
    assert facts["input motor_angles"].startswith("12 rad")
    assert str(find_policy("go2-steer")) in facts["policy"]


def test_a_perceptive_policy_lists_its_grid(capsys: pytest.CaptureFixture[str]) -> None:
    facts = print_contract("go2-terrain-seeing", capsys)
    assert facts["height map"].startswith("19 points ahead from -0.3195 to 0.639 m, 0.05325 m apart, 13 points to the")
    assert facts["inputs"] == "165 numbers: 55 of each of 3 control steps, newest first"
    assert facts["input motor_speeds"] == "12 rad/s; motor"


def test_a_policy_without_commands(capsys: pytest.CaptureFixture[str]) -> None:
    facts = print_contract("trot", capsys)
    assert facts["commands"] == "none"
    assert facts["reference"] != "none"
