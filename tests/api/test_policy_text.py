"""What a policy file says, as `surefoot show POLICY --contract` prints it."""

from __future__ import annotations

import pytest

from surefoot.api.policies import find_policy
from surefoot.cli.main import main


def said(policy: str, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    assert main(["show", policy, "--contract"]) == 0
    lines = capsys.readouterr().out.splitlines()
    width = max(line.find("  ") for line in lines if line.startswith("age of readings")) + 2
    assert width
    return {name.strip(): text.strip() for name, _, text in (line.partition("  ") for line in lines)}


def test_a_steered_policy(capsys: pytest.CaptureFixture[str]) -> None:
    facts = said("go2-steer", capsys)
    assert facts["robot"].startswith("go2, 12 motors: FR_hip_joint")
    assert facts["commands"].startswith("forward ")
    assert facts["gains"] == "kp 40, kd 1"
    assert facts["control step"].endswith(" Hz)")
    assert facts["height map"] == facts["plug-ins"] == "none"
    assert facts["input motor_angles"].startswith("12 rad")
    assert str(find_policy("go2-steer")) in facts["policy"]


def test_a_policy_that_sees_the_ground_names_its_grid(capsys: pytest.CaptureFixture[str]) -> None:
    facts = said("go2-terrain-seeing", capsys)
    assert facts["height map"].startswith("19 places ahead from -0.3195 to 0.639 m, 0.05325 m apart, 13 places to the")
    assert facts["inputs"] == "165 numbers: 55, of the last 3 control steps, newest first"
    assert facts["input motor_speeds"] == "12 rad/s; motor"


def test_a_policy_without_commands(capsys: pytest.CaptureFixture[str]) -> None:
    facts = said("trot", capsys)
    assert facts["commands"] == "none"
    assert facts["reference"] != "none"
