"""Policies of others that tests adopt, readings of a Go2, and a network that shows its observation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from surefoot.policy.graph import Graph, Value

DATA = Path(__file__).resolve().parents[1] / "data" / "rl_sar"


@dataclass
class Readings:
    """Readings of a Go2 at a control step, in the order and with the signs of the vendor's messages."""

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
    """A network whose action is the first part of its observation, and which keeps its observation."""

    def __init__(self, inputs: int, outputs: int) -> None:
        self.inputs, self.outputs, self.hidden = inputs, outputs, (inputs,)

    def add(self, graph: Graph, observation: Value, hidden: list[Value]) -> tuple[Value, list[Value]]:
        """Add the selection."""
        return graph.select(observation, range(self.outputs)), [observation]


def perceptron(
    inputs: int, outputs: int = 12, hidden: int = 16, seed: int = 0, properties: dict | None = None
) -> bytes:
    """Return a small network as rsl_rl exports it, a normalizer and layers with ELU, as ONNX for one robot."""
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
    """Return a model of ONNX for one robot with these inputs and outputs, each of a width."""
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width]) for name, width in part.items()]
        for part in (inputs, outputs)
    ]
    graph = helper.make_graph(nodes, "policy", *ends, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, properties or {})
    return model.SerializeToString()
