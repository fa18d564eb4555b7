"""Export to other deployment frameworks: an exported and readopted policy is the same policy."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from third_party_policies import DATA, LAB_ORDER, perceptron

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


def test_files_for_rl_sar_have_the_orders_of_hardware_and_policy(go2, tmp_path):
    (config,) = yaml.safe_load((DATA / "robot_lab" / "config.yaml").read_text()).values()
    pose = dict(zip(go2.motor_names, [0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5], strict=True))
    config |= {"joint_mapping": LAB_ORDER, "default_dof_pos": [pose[go2.motor_names[motor]] for motor in LAB_ORDER]}
    folder = tmp_path / "given" / "isaac"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump({"go2/isaac": config}))
    (folder.parent / "base.yaml").write_text((DATA / "base.yaml").read_text())
    (folder / "policy.onnx").write_bytes(perceptron(45))
    path = tmp_path / "isaac.onnx"
    path.write_bytes(adopt(folder / "policy.onnx", "rl_sar", go2, "isaac").data)

    EXPORTERS["rl_sar"](PolicyRuntime.load(path), path.read_bytes(), go2, tmp_path / "isaac")
    config, base = (
        next(iter(yaml.safe_load((tmp_path / "isaac" / f"{name}.yaml").read_text()).values()))
        for name in ("config", "base")
    )
    limit = dict(zip(go2.motor_names, np.broadcast_to(go2.actuator.torque_limit, 12).tolist(), strict=True))
    assert len(set(limit.values())) == 2
    assert config["joint_mapping"] == LAB_ORDER
    for table in (config, base):
        names = [go2.motor_names[motor] for motor in table["joint_mapping"]]
        assert dict(zip(names, table["default_dof_pos"], strict=True)) == pytest.approx(pose)
        assert dict(zip(names, table["torque_limits"], strict=True)) == limit
    assert base["joint_names"] == list(go2.motor_names)
    assert base["joint_mapping"] == list(range(12))


@pytest.mark.parametrize(
    ("policy", "message"),
    [("go2-steer", "a reference gait adds to its actions"), ("go2-scratch", "its actions are not motor angles")],
)
def test_export_rejects_policies_that_other_frameworks_can_not_run(go2, tmp_path, policy, message):
    path = find_policy(policy)
    with pytest.raises(SurefootError, match=message):
        EXPORTERS["rl_sar"](PolicyRuntime.load(path), path.read_bytes(), go2, tmp_path)
    assert not list(tmp_path.iterdir())
