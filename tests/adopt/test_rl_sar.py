"""Policies of rl_sar: their contract, and rejected files; test_arithmetic compares the arithmetic."""

from __future__ import annotations

import pytest
import yaml
from third_party_policies import DATA, perceptron

from surefoot.adopt.adoption import adopt
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime

FILES = {"himloco": DATA / "himloco" / "himloco.pt", "robot_lab": DATA / "robot_lab" / "policy.pt"}


@pytest.fixture(scope="session")
def adopted(go2):
    return {name: adopt(path, "rl_sar", go2, name) for name, path in FILES.items()}


def test_the_contract_matches_rl_sars_files(adopted):
    contract = PolicyRuntime.parse(adopted["himloco"].data).contract
    assert (contract.robot, contract.history, contract.control_step) == ("go2", 6, 0.02)
    assert (contract.servo_kp, contract.servo_kd) == (40.0, 1.0)
    assert contract.action_names[:2] == ("angle.FR_hip_joint", "angle.FR_thigh_joint")
    assert len(contract.action_names) == 24
    assert contract.reference is None
    assert contract.figures["adopted"]["format"] == "rl_sar"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"observations": ["ang_vel", "lin_vel"]},
            "observation base_velocity is the speed of the base, which no sensor",
        ),
        ({"observations": ["ang_vel", "ang_speed"]}, "observation 'ang_speed' is unknown; known are commands"),
        ({"rl_kp": None}, "rl_kp is missing; it must be given"),
        ({"rl_kp": [20.0] * 11}, "kp has 11 numbers; there are 12 joints"),
        ({"joint_mapping": [0] * 12}, "joint_mapping is [0, 0"),
        ({"wheel_indices": [3]}, "robots with wheels can't be adopted"),
        ({"default_dof_pos": [0.0, 0.8, 1.5] * 4}, "go2 can't reach default_pose"),
        ({"observations": ["ang_vel", "gravity_vec"]}, "the network takes 45 numbers; the observations are 6"),
    ],
)
def test_incompatible_configurations_are_rejected_in_one_line(tmp_path, go2, change, message):
    (config,) = yaml.safe_load((FILES["robot_lab"].parent / "config.yaml").read_text()).values()
    changed = {key: value for key, value in {**config, **change}.items() if value is not None}
    path, base = tmp_path / "robot_lab" / "config.yaml", tmp_path / "base.yaml"
    path.parent.mkdir()
    path.write_text(yaml.safe_dump({"go2/robot_lab": changed}))
    base.write_text((DATA / "base.yaml").read_text())
    network = tmp_path / "policy.onnx"
    network.write_bytes(perceptron(45))
    with pytest.raises(SurefootError) as caught:
        adopt(network, "rl_sar", go2, "x", path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
