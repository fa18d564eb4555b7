"""Loading of policy files for simulation."""

from __future__ import annotations

import functools
import math
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from shipped_variants import modified_policy

pytest.importorskip("gymnasium")

from surefoot.api.policies import find_policy, load_policies, load_policy, open_policy, released_policies
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription


def shipped_variants(path: Path, changes: dict[str, Any]) -> Path:
    """Return the trot with a modified contract; keys of tables are written "table.key"."""

    def edit(contract: dict[str, Any]) -> None:
        for name, value in changes.items():
            *tables, key = name.split(".")
            functools.reduce(dict.__getitem__, tables, contract)[key] = value

    return modified_policy(path, edit, "trot")


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"low": [-0.8] * 8}, "swing can be -1.100 to 0.550 rad"),
        ({"servo_kd": math.nan}, "nan|finite"),
        ({"rest": [0.0, 3.0]}, "extension at rest is 3 rad; a leg of minitaur allows 0.6 to 2.7"),
        ({"rest": [math.nan, 2.0]}, "nan|finite"),
        ({"reference.swing.amplitude.front_left": math.nan}, "must be finite"),
        ({"reference": {"kind": "table", "period": 1.0}}, "reference"),
        (
            {"columns": ["roll", "roll_rate", "pitch", "pitch_rate"]},
            "column 1 is 'roll_rate' (policy), 'pitch' (data sheet)",
        ),
        ({"robot": "spot"}, "policy 'trot' must not run on minitaur: it is for robot 'spot'"),
        ({"schema": 1}, "has schema 1; this surefoot reads schema 2: use the version that wrote it"),
    ],
)
def test_load_policy_rejects_a_contract_of_another_robot(changes: dict[str, Any], why: str, tmp_path: Path):
    with pytest.raises(SurefootError) as error:
        load_policy(shipped_variants(tmp_path / "edited.onnx", changes), None)
    assert re.search(re.escape(why) if "(" in why else why, str(error.value))
    assert "\n" not in str(error.value)


def test_load_policies_checks_each_policy(tmp_path: Path):
    policy = shipped_variants(tmp_path / "edited.onnx", {"rest": [0.0, 3.0]})
    with pytest.raises(SurefootError, match="policy 'trot' must not run on minitaur: extension at rest is 3 rad"):
        load_policies([find_policy("gallop"), policy])


def test_policy_keeps_its_control_step_and_gains_on_another_robot(tmp_path: Path):
    folder = tmp_path / "robot"
    shutil.copytree(RobotDescription.load("minitaur").folder, folder)
    policy = shipped_variants(tmp_path / "edited.onnx", {"control_step": 0.008, "servo_kp": 2.0})
    _, robot, task = load_policy(policy, str(folder))
    assert robot.folder == folder
    params = task.nominal(robot)
    assert (params.control_step[0], params.servo_kp[0, 0]) == (0.008, 2.0)


@pytest.mark.parametrize("policy", released_policies())
def test_a_released_policy_matches_its_robot(policy: str):
    open_policy(find_policy(policy))
