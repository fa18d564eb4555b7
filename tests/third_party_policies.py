"""Third-party policies for tests of adoption, readings of a Go2, and a network that exposes its observation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from surefoot.policy.graph import Graph, Value

DATA = Path(__file__).resolve().parents[1] / "data" / "rl_sar"
GYM_ORDER = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
"""Motors of the legs FL FR RL RR."""
LAB_ORDER = [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
"""Motors of Isaac Lab's joints: all hips, all thighs, all calves."""
POSE = np.array([0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.5, -1.5])
MJLAB_PROPERTIES = {
    "joint_names": ",".join(
        f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")
    ),
    "joint_stiffness": ",".join(["20.000"] * 12),
    "joint_damping": ",".join(["0.500"] * 12),
    "default_joint_pos": ",".join(["0.000,0.800,-1.500"] * 4),
    "action_scale": "0.010",
    "observation_names": "base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command",
}
"""Metadata of a policy file of mjlab."""
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
"""`deploy.yaml` of a training of a Go2, with all features of the format."""

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
"""Metadata of a network of mjlab, in a version without histories."""
LONG = {
    "observation_names": "base_ang_vel,projected_gravity,joint_pos,joint_vel,command",
    "observation_terms_scale": f"0.250,1.000,1.000,{[0.05] * 12},1.000",
    "observation_terms_history_length": "3.000,3.000,3.000,3.000,0.000",
    "observation_terms_clip": "[-1.5, 1.5],[-inf, inf],[-inf, inf],[-inf, inf],[-inf, inf]",
    "observation_terms_flatten_history_dim": "1.000,1.000,1.000,1.000,1.000",
}
"""Metadata added by newer versions."""

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


@dataclass
class Readings:
    """Readings of a Go2 at a control step, in the vendor's order and signs."""

    roll_pitch_yaw: np.ndarray
    angular_velocity_base: np.ndarray
    motor_angle: np.ndarray
    motor_velocity: np.ndarray

    @property
    def quaternion(self) -> np.ndarray:
        """Orientation of the base, w x y z."""
        (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in self.roll_pitch_yaw)
        return np.array(
            [
                cy * cp * cr + sy * sp * sr,
                cy * cp * sr - sy * sp * cr,
                cy * sp * cr + sy * cp * sr,
                sy * cp * cr - cy * sp * sr,
            ]
        )


class Probe:
    """Network that returns the first part of its observation as action, and stores the observation."""

    def __init__(self, inputs: int, outputs: int) -> None:
        self.inputs, self.outputs, self.hidden = inputs, outputs, (inputs,)

    def add(self, graph: Graph, observation: Value, hidden: list[Value]) -> tuple[Value, list[Value]]:
        """Add the node that selects the action."""
        return graph.select(observation, range(self.outputs)), [observation]


def perceptron(
    inputs: int, outputs: int = 12, hidden: int = 16, seed: int = 0, properties: dict | None = None
) -> bytes:
    """Return a small ONNX network for one robot in rsl_rl's export format: a normalizer and layers with ELU."""
    random, nodes, constants, name = np.random.default_rng(seed), [], [], "obs"

    def constant(label: str, values: np.ndarray) -> str:
        constants.append(numpy_helper.from_array(np.asarray(values, np.float32), label))
        return label

    nodes.append(helper.make_node("Sub", [name, constant("mean", random.normal(size=(1, inputs)))], ["centred"]))
    nodes.append(helper.make_node("Div", ["centred", constant("std", random.uniform(0.5, 2, (1, inputs)))], ["normal"]))
    name = "normal"
    for k, (rows, columns) in enumerate(((inputs, hidden), (hidden, outputs))):
        weight = constant(f"weight{k}", random.normal(scale=rows**-0.5, size=(columns, rows)))
        offset = constant(f"bias{k}", random.normal(size=columns))
        result = "actions" if k else "layer"
        nodes.append(helper.make_node("Gemm", [name, weight, offset], [result], transB=1))
        name = result
        if not k:
            nodes.append(helper.make_node("Elu", [name], ["hidden"]))
            name = "hidden"
    return onnx_model(nodes, constants, {"obs": inputs}, {"actions": outputs}, properties)


def onnx_model(nodes, constants, inputs: dict, outputs: dict, properties: dict | None = None) -> bytes:
    """Return an ONNX model for one robot with given inputs and outputs (width by name)."""
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width]) for name, width in part.items()]
        for part in (inputs, outputs)
    ]
    graph = helper.make_graph(nodes, "policy", *ends, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, properties or {})
    return model.SerializeToString()
