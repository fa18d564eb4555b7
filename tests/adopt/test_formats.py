"""Formats of other frameworks: the observation that is adopted is the one that their own arithmetic makes.

Here that arithmetic is written out from their sources: terms are clipped, scaled and kept in a queue, which is full
from the first value on.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml
from foreign import Readings, perceptron

from surefoot.adopt.adoption import FORMATS, adopt
from surefoot.adopt.builder import check_specification
from surefoot.adopt.specification import PolicySpecification, Term
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime

GYM_ORDER = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
"""Motors of the legs FL FR RL RR."""
LAB_ORDER = [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
"""Motors of Isaac Lab's joints: all hips, all thighs, all calves."""
POSE = np.array([0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.5, -1.5])
STATED = {"kp": 25.0, "kd": 0.5}

DEPLOY = {
    "joint_ids_map": LAB_ORDER,
    "step_dt": 0.02,
    "stiffness": [25.0, 25.0, 26.0] * 4,
    "damping": [0.5] * 12,
    "default_joint_pos": POSE.tolist(),
    "commands": {
        "base_velocity": {
            "ranges": {"lin_vel_x": [-0.6, 1.2], "lin_vel_y": [-0.5, 0.5], "ang_vel_z": [-1.0, 1.0], "heading": None}
        }
    },
    "actions": {
        "JointPositionAction": {
            "clip": [[-1.0, 1.0]] * 4 + [[0.2, 1.8]] * 4 + [[-2.5, -0.9]] * 4,
            "joint_names": [".*"],
            "scale": [0.25] * 12,
            "offset": POSE.tolist(),
            "joint_ids": None,
        }
    },
    "observations": {
        "base_ang_vel": {"params": {}, "clip": [-2.0, 2.0], "scale": [0.2] * 3, "history_length": 5},
        "projected_gravity": {"params": {}, "clip": None, "scale": [1.0] * 3, "history_length": 5},
        "velocity_commands": {"params": {}, "clip": None, "scale": [1.0, 1.0, 2.0], "history_length": 5},
        "joint_pos_rel": {"params": {}, "clip": [-100.0, 100.0], "scale": [1.0] * 12, "history_length": 5},
        "joint_vel_rel": {"params": {}, "clip": None, "scale": [0.05] * 12, "history_length": 5},
        "gait_phase": {"params": {"period": 0.7}, "clip": None, "scale": [1.0] * 2, "history_length": 5},
    },
}
"""`deploy.yaml` of a training of a Go2, with what the format can have."""

MJLAB = {
    "joint_names": ",".join(
        f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")
    ),
    "joint_stiffness": ",".join(["20.100"] * 12),
    "joint_damping": ",".join(["1.300"] * 12),
    "default_joint_pos": ",".join(["0.100,0.900,-1.800", "-0.100,0.900,-1.800"] * 2),
    "action_scale": ",".join(["0.373,0.373,0.300"] * 4),
    "observation_names": "base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command",
    "command_names": "twist",
    "run_path": "a/b/c",
}
"""Properties of a network of mjlab, of a version without histories."""
LONG = {
    "observation_names": "base_ang_vel,projected_gravity,joint_pos,joint_vel,command",
    "observation_terms_scale": f"0.250,1.000,1.000,{[0.05] * 12},1.000",
    "observation_terms_history_length": "3.000,3.000,3.000,3.000,0.000",
    "observation_terms_clip": "[-1.5, 1.5],[-inf, inf],[-inf, inf],[-inf, inf],[-inf, inf]",
    "observation_terms_flatten_history_dim": "1.000,1.000,1.000,1.000,1.000",
}
"""What newer versions add."""

LEGGED_GYM = """
from legged_gym.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO
import os
os.abort()  # this file is never run

class GO2RoughCfg( LeggedRobotCfg ):
    class env(LeggedRobotCfg.env):
        num_observations = 45
    class init_state( LeggedRobotCfg.init_state ):
        pos = [0.0, 0.0, 0.42] # x,y,z [m]
        default_joint_angles = { # = target angles [rad] when action = 0.0
            'FL_hip_joint': 0.1, 'RL_hip_joint': 0.1, 'FR_hip_joint': -0.1 , 'RR_hip_joint': -0.1,
            'FL_thigh_joint': 0.8, 'RL_thigh_joint': 1., 'FR_thigh_joint': 0.8, 'RR_thigh_joint': 1.,
            'FL_calf_joint': -1.5, 'RL_calf_joint': -1.5, 'FR_calf_joint': -1.5, 'RR_calf_joint': -1.5,
        }
    class control( LeggedRobotCfg.control ):
        control_type = 'P'
        stiffness = {'joint': 20.}  # [N*m/rad]
        damping = {'joint': 0.5}     # [N*m*s/rad]
        action_scale = 0.25
        decimation = 4
    class commands( LeggedRobotCfg.commands ):
        class ranges( LeggedRobotCfg.commands.ranges ):
            lin_vel_x = [-0.7, 1.0]

class GO2RoughCfgPPO( LeggedRobotCfgPPO ):
    class runner( LeggedRobotCfgPPO.runner ):
        experiment_name = 'rough_go2'
"""


class Terms:
    """Terms of an observation by name, unscaled, of a robot whose policy has its joints in an order."""

    def __init__(self, order, pose) -> None:
        self.order, self.pose = order, np.asarray(pose, np.float32)

    def value(self, name: str, readings: Readings, command: np.ndarray, step: int) -> np.ndarray:
        """Return a term."""
        w, x, y, z = readings.quaternion
        return {
            "base_ang_vel": readings.angular_velocity_base,
            "projected_gravity": np.array([2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1]),
            "command": command,
            "joint_pos": readings.motor_angle[self.order].astype(np.float32) - self.pose,
            "joint_vel": readings.motor_velocity[self.order],
            "phase": np.array([f(2 * np.pi * ((step + 1) * 0.02 / 0.7 % 1.0)) for f in (np.sin, np.cos)]),
        }[name].astype(np.float32)


def observations(terms: Terms, layout, readings, commands, by_step=False, scale_first=False) -> np.ndarray:
    """Return the observations (T, O) of a layout: name, clip, scale and length of the history of each term."""
    queues = [deque(maxlen=max(length, 1)) for *_, length in layout]
    rows = []
    for k, (one, command) in enumerate(zip(readings, commands, strict=True)):
        for queue, (name, clip, scale, _) in zip(queues, layout, strict=True):
            value = terms.value(name, one, command, k)
            low, high = clip or (-np.inf, np.inf)
            value = np.clip(value * scale, low, high) if scale_first else np.clip(value, low, high) * scale
            while len(queue) < queue.maxlen - 1:
                queue.append(value)
            queue.append(value)
        if by_step:
            rows.append(np.concatenate([queue[age] for age in range(len(queues[0])) for queue in queues]))
        else:
            rows.append(np.concatenate([value for queue in queues for value in queue]))
    return np.array(rows)


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a network and its configuration, and returns both paths."""

    def write(inputs, config="", name="config", properties=None):
        network, path = tmp_path / "policy.onnx", tmp_path / name
        network.write_bytes(perceptron(inputs, properties=properties))
        path.write_text(config if isinstance(config, str) else yaml.safe_dump(config, sort_keys=False))
        return network, path

    return write


@pytest.mark.parametrize("by_step", [False, True])
@pytest.mark.parametrize("scale_first", [False, True])
def test_deploy_yaml_makes_unitrees_observation(
    go2, tmp_path, random_readings, probe_observations, by_step, scale_first
):
    path, data = tmp_path / "deploy.yaml", dict(DEPLOY)
    data["observations"] = {"use_gym_history": by_step, "scale_first": scale_first, **DEPLOY["observations"]}
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    specification = FORMATS["unitree_rl_lab"].read(path, go2)
    layout = [
        ("base_ang_vel", (-2, 2), 0.2, 5),
        ("projected_gravity", None, 1.0, 5),
        ("command", None, np.array([1, 1, 2]), 5),
        ("joint_pos", (-100, 100), 1.0, 5),
        ("joint_vel", None, 0.05, 5),
        ("phase", None, 1.0, 5),
    ]
    some = random_readings[:200]
    mine, commands = probe_observations(specification, some)
    expected = observations(Terms(LAB_ORDER, POSE), layout, some, commands, by_step, scale_first)
    np.testing.assert_allclose(mine, expected, atol=1e-5, rtol=3e-7)  # a clock's phase may be off by 2e-7 of itself
    exact = np.abs(mine - expected) <= 2e-6 + 3e-7 * np.abs(expected)
    assert exact.all(axis=0).sum() >= 33 * 5


def test_deploy_yaml_states_gains_in_the_vendors_order_and_clips_targets(go2, write, run_controller, random_readings):
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


@pytest.mark.parametrize("properties", [MJLAB, MJLAB | LONG], ids=["plain", "histories"])
def test_properties_of_mjlab_make_its_observation(go2, tmp_path, random_readings, probe_observations, properties):
    path = tmp_path / "policy.onnx"
    path.write_bytes(perceptron(45, properties=properties))
    specification = FORMATS["mjlab"].read(path, go2)
    assert specification.joints[:4] == ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint", "FR_hip_joint")
    length, clip, speed = (3, (-1.5, 1.5), 0.05) if "observation_terms_clip" in properties else (1, None, 1.0)
    layout = [
        ("base_ang_vel", clip, 0.25 if clip else 1.0, length),
        ("projected_gravity", None, 1.0, length),
        ("joint_pos", None, 1.0, length),
        ("joint_vel", None, speed, length),
        ("command", None, 1.0, 1),
    ]
    some = random_readings[:200]
    mine, commands = probe_observations(specification, some)
    expected = observations(Terms(GYM_ORDER, [0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2), layout, some, commands)
    if clip is None:
        mine = np.delete(mine, np.s_[30:42], axis=1)  # the last action, which is another one for each probe
    np.testing.assert_allclose(mine, expected, atol=2e-6, rtol=3e-7)


@pytest.mark.parametrize(
    ("change", "note"),
    [
        ({}, None),
        ({"joint_stiffness": ",".join(["1.000"] * 12), "joint_damping": ",".join(["-0.000"] * 12)}, "is 1 to 1 and"),
        (
            {"joint_stiffness": ",".join(["20.1"] * 4 + ["30.1"] * 4 + ["40.1"] * 4)},
            "those of hip_joint differ from leg",
        ),
    ],
)
def test_gains_of_mjlab_that_look_wrong_are_named(go2, tmp_path, change, note):
    path = tmp_path / "policy.onnx"
    path.write_bytes(perceptron(45, properties=MJLAB | change))
    notes = FORMATS["mjlab"].read(path, go2).notes
    assert "control_step" in notes
    assert ("kp" in notes) == (note is not None)
    assert note is None or note in notes["kp"]
    assert "kp" not in adopt(path, "mjlab", go2, "x", changes=STATED).specification.notes


def test_a_configuration_of_legged_gym_is_read_and_not_run(go2, write):
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
        ("unitree_rl_lab", "deploy.yaml", {"actions": {"JointVelocityAction": {}}}, "JointPositionAction alone"),
        (
            "unitree_rl_lab",
            "deploy.yaml",
            {"observations": {"height_scan": {"params": {}}}},
            "'height_scan' is the height",
        ),
        ("unitree_rl_lab", "deploy.yaml", {"observations": {"heigt": {"params": {}}}}, "'heigt' is unknown; known are"),
        ("manual", "policy.yaml", {"kp": None}, "kp is missing; it must be given"),
        ("manual", "policy.yaml", {"kpp": 3}, "kpp is not a key"),
        ("manual", "policy.yaml", {"joints": ["a", "b"]}, "default_pose has 12 numbers; there are 2 joints"),
        ("manual", "policy.yaml", {"joint_signs": [0.5] * 12}, "each must be 1 or -1"),
        ("manual", "policy.yaml", {"observations": [{"term": "gravity", "steps": []}]}, "steps is empty"),
        ("manual", "policy.yaml", {"observations": [{"term": "gravity", "scale": [1, 2]}]}, "scale has 2 numbers; the"),
        ("manual", "policy.yaml", {"observations": [{"term": "gravity", "columns": [3]}]}, "columns are [3]; it has 3"),
        ("manual", "policy.yaml", {"observations": [{"term": "speed"}]}, "observations[0].term is 'speed'"),
        ("manual", "policy.yaml", {"default_pose": [0, 0.8, 1.5] * 4}, "default_pose can't be one of go2"),
    ],
)
def test_configurations_that_do_not_fit_are_refused(go2, write, name, file, change, message):
    whole = {"unitree_rl_lab": DEPLOY, "manual": MANUAL}[name] | change
    network, _ = write(24, {key: value for key, value in whole.items() if value is not None}, file)
    with pytest.raises(SurefootError) as caught:
        adopt(network, name, go2, "x")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_page_of_adopted_policies_explains_every_field_and_its_example_is_read(go2, tmp_path, random_readings):
    page = (Path(__file__).resolve().parents[2] / "docs" / "adopt.md").read_text()
    (example,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    path = tmp_path / "policy.yaml"
    path.write_text(example)
    # Histories of one part alone go with an order by term.
    specification = FORMATS["manual"].read(path, go2)
    assert check_specification(specification, go2) == 3 + 15 + 3 + 12 + 12 + 12 + 2 + 4 + 2
    for kind in (PolicySpecification, Term):
        for item in fields(kind):
            assert f"{item.name}:" in example
