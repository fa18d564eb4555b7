"""Policy files that are loaded for simulation."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gymnasium")

from surefoot.cli.helpers.policies import find_policy, load_policies, load_policy
from surefoot.errors import SurefootError
from surefoot.policy.contract import METADATA_KEY
from surefoot.policy.digest import read_parts, stamped
from surefoot.policy.network import OPSET
from surefoot.policy.protobuf import field
from surefoot.robot import RobotDescription


def unsigned(path: Path, changes: dict[str, Any], policy: str = "trot") -> Path:
    """A policy that ships after an edit of its contract, without a digest; a key of a table is "table.key"."""
    parts = read_parts(find_policy(policy).read_bytes())
    contract = json.loads(parts.properties[METADATA_KEY])
    for name, value in changes.items():
        *tables, key = name.split(".")
        place = contract
        for table in tables:
            place = place[table]
        if value is None:
            del place[key]
        else:
            place[key] = value
    properties = field(1, METADATA_KEY.encode()) + field(2, json.dumps(contract).encode())
    path.write_bytes(
        bytes([1 << 3, 8]) + field(7, parts.graph) + field(8, bytes([2 << 3, OPSET])) + field(14, properties)
    )
    return path


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"low": [-0.8] * 8}, "swing can be -1.100 to 0.550 rad"),
        ({"servo_kd": math.nan}, "nan|finite"),
        ({"rest": [0.0, 3.0]}, "extension at rest is 3 rad; a leg of minitaur allows 0.6 to 2.7"),
        ({"rest": [math.nan, 2.0]}, "nan|finite"),
        ({"reference.swing.amplitude.front_left": math.nan}, "must be finite"),
        ({"reference": {"kind": "table", "period": 1.0}}, "reference"),
        ({"columns": ["roll", "roll_rate", "pitch", "pitch_rate"]}, "column 1 is 'roll_rate' in the policy"),
        ({"robot": "spot"}, "robot: is 'spot' (policy), 'minitaur' (data sheet); all must be the same"),
        ({"schema": 1}, "has schema 1; this surefoot reads schema 2: export the policy again"),
    ],
)
def test_a_simulation_refuses_a_contract_that_the_robot_does_not_fit(changes: dict[str, Any], why: str, tmp_path: Path):
    with pytest.raises(SurefootError) as error:
        load_policy(unsigned(tmp_path / "edited.onnx", changes), None)
    assert re.search(re.escape(why) if "(" in why else why, str(error.value))
    assert "\n" not in str(error.value)


def test_policies_that_are_compared_are_checked_too(tmp_path: Path):
    edited = unsigned(tmp_path / "edited.onnx", {"rest": [0.0, 3.0]})
    with pytest.raises(SurefootError, match="policy 'trot' must not run on minitaur: gait: extension at rest is 3 rad"):
        load_policies([find_policy("gallop"), edited])


def test_a_policy_keeps_its_control_step_and_gains_on_another_robot(tmp_path: Path):
    folder = tmp_path / "robot"
    shutil.copytree(RobotDescription.load("minitaur").folder, folder)
    policy = unsigned(tmp_path / "edited.onnx", {"control_step": 0.008, "servo_kp": 2.0})
    _, robot, task = load_policy(policy, str(folder))
    assert robot.folder == folder
    params = task.nominal(robot)
    assert (params.control_step[0], params.servo_kp[0, 0]) == (0.008, 2.0)


def test_a_warning_names_an_unsigned_policy_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = unsigned(tmp_path / "unsigned.onnx", {})
    assert load_policy(path, None)[0].digest is None
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"surefoot: policy file {path}: is unsigned: it has no digest")
    assert said.err.endswith("for simulation only, deploy refuses it\n")
    assert said.err.count("\n") == 1


def test_a_signed_policy_gives_no_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = unsigned(tmp_path / "signed.onnx", {})
    path.write_bytes(stamped(path.read_bytes()))
    for one in (path, find_policy("gallop")):
        load_policy(one, None)
    assert capsys.readouterr().err == ""
