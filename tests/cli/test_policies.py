"""A policy file from anywhere: what its contract says is what a simulation would run, or it is refused."""

from __future__ import annotations

import json
import math
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
        ({"low": [-0.2] * 8}, "low of swing is -0.2; its task says -0.25"),
        ({"low": [-6.0] * 8, "high": [6.0] * 8, "task.feedback": None}, "low of swing is -6; its task says -0.5"),
        ({"servo_kp": 2.0}, "the robot's servos have kp 1 and kd 0.015; the policy was trained with kp 2 and kd 0.015"),
        ({"servo_kd": math.nan}, "nan|finite"),
        ({"rest": [0.0, 1.6]}, "extension at rest is 1.6 rad; the middle of its commands is 2 rad"),
        ({"rest": [0.0, 1.6], "task.rest": [0.0, 1.7]}, "extension at rest is 1.6 rad; its task says 1.7 rad"),
        ({"rest": [math.nan, 2.0]}, "nan|finite"),
        ({"reference.swing.amplitude.front_left": 0.1}, "its reference gait is not the one of its task"),
        ({"reference.swing.amplitude.front_left": math.nan}, "must be finite"),
        ({"reference": {"kind": "table", "period": 1.0}}, "reference.swing must give one list of numbers"),
        ({"control_step": 0.012}, "control_step is 0.012; the data sheet of minitaur says 0.006"),
        ({"columns": ["roll", "roll_rate", "pitch", "pitch_rate"]}, "column 1 is 'roll_rate' in the policy"),
    ],
)
def test_a_contract_that_is_not_what_would_be_run_is_refused(changes: dict[str, Any], why: str, tmp_path: Path):
    with pytest.raises(SurefootError, match=why) as caught:
        load_policy(unsigned(tmp_path / "edited.onnx", changes), None)
    assert "\n" not in str(caught.value)


def test_policies_that_are_compared_are_checked_too(tmp_path: Path):
    edited = unsigned(tmp_path / "edited.onnx", {"servo_kp": 2.0})
    with pytest.raises(SurefootError, match="policy 'trot' must not run on minitaur: the robot's servos have kp 1"):
        load_policies([find_policy("gallop"), edited])


def test_an_unsigned_policy_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = unsigned(tmp_path / "unsigned.onnx", {})
    assert load_policy(path, None)[0].digest is None
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"surefoot: policy file {path}: is unsigned: it has no digest")
    assert said.err.endswith("for simulation only, deploy refuses it\n")
    assert said.err.count("\n") == 1


def test_a_signed_policy_needs_no_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = unsigned(tmp_path / "signed.onnx", {})
    path.write_bytes(stamped(path.read_bytes()))
    for one in (path, find_policy("gallop")):
        load_policy(one, None)
    assert capsys.readouterr().err == ""
