"""Export to other deployment frameworks: an exported and readopted policy is the same policy."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.adopt.adoption import adopt
from surefoot.adopt.exporting import EXPORTERS
from surefoot.api.policies import find_policy
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime


@pytest.mark.parametrize("name", EXPORTERS)
def test_an_exported_and_readopted_policy_gives_the_same_angles(
    name, go2, robot_lab, tmp_path, run_controller, random_readings
):
    policy = PolicyRuntime.load(robot_lab)
    files = EXPORTERS[name](policy, robot_lab.read_bytes(), go2, tmp_path / "robot_lab")
    assert files[0].name == "policy.onnx"
    again = adopt(files[0], name, go2, "again").data
    contract = PolicyRuntime.parse(again).contract
    for field in ("servo_kp", "servo_kd", "control_step", "rest", "action_names"):
        assert getattr(contract, field) == getattr(policy.contract, field)
    some = random_readings[:200]
    mine, feedback, _ = run_controller(robot_lab.read_bytes(), some)
    theirs, again_feedback, _ = run_controller(again, some)
    np.testing.assert_allclose(theirs, mine, atol=1e-4)
    np.testing.assert_allclose(again_feedback[:, 12:], feedback[:, 12:], atol=1e-3)


@pytest.mark.parametrize(
    ("policy", "message"),
    [("go2-steer", "a reference gait adds to its actions"), ("go2-scratch", "its actions are not motor angles")],
)
def test_export_rejects_policies_that_other_frameworks_can_not_run(go2, tmp_path, policy, message):
    path = find_policy(policy)
    with pytest.raises(SurefootError, match=message):
        EXPORTERS["rl_sar"](PolicyRuntime.load(path), path.read_bytes(), go2, tmp_path)
    assert not list(tmp_path.iterdir())
