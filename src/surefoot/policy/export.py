"""A trained actor as one ONNX file: normalizer, network, squashing, bounds, contract and digest in it."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from surefoot.errors import SurefootError, suggest
from surefoot.files import atomic_write
from surefoot.policy.contract import METADATA_KEY, Contract
from surefoot.policy.digest import ROBOT_KEY, add_digest, read_parts
from surefoot.policy.network import INPUT, OPSET, OUTPUT, check_network

IR_VERSION = 8
ACTIVATIONS = {"elu": "Elu", "relu": "Relu", "tanh": "Tanh", "selu": "Selu", "swish": "swish"}

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]


class _Graph:
    """Nodes and constants of a graph; `value` is the name of the last result."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.value = INPUT

    def constant(self, name: str, array: Any) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(array, np.float32), name))
        return name

    def apply(self, kind: str, *others: str, result: str = "", **attributes: Any) -> None:
        """Apply an operator to the last result and other values."""
        result = result or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, [self.value, *others], [result], **attributes))
        self.value = result

    def activate(self, activation: str) -> None:
        before = self.value
        if activation == "swish":
            self.apply("Sigmoid")
            self.apply("Mul", before)
        else:
            self.apply(ACTIVATIONS[activation])


def build_model(
    layers: list[Layer],
    mean: NDArray[np.float32],
    scale: NDArray[np.float32],
    activation: str,
    contract: Contract,
    robot: bytes = b"",
) -> onnx.ModelProto:
    """Return the ONNX model of a multilayer perceptron.

    feedback = low + (clip(mlp((observation - mean) / scale), -1, 1) + 1) / 2 (high - low)

    Args:
        layers: weight (out, in) and bias (out,) of each layer; the activation stands between two of them.
        mean: subtracted from the observation, (O * history,), raw SI units.
        scale: divisor of the observation, (O * history,).
        activation: one of `ACTIVATIONS`.
        contract: written into the metadata; its bounds are constants of the graph.
        robot: archive of a robot that does not ship, written beside it.

    Raises:
        SurefootError: an unknown activation, or layers that do not fit the contract.
    """
    if activation not in ACTIVATIONS:
        raise SurefootError(f"activation is '{activation}'; {suggest(activation, ACTIVATIONS)}")
    inputs, outputs = contract.width, len(contract.action_names)
    widths = (layers[0][0].shape[1], layers[-1][0].shape[0])
    if widths != (inputs, outputs):
        raise SurefootError(
            f"the network takes {widths[0]} and gives {widths[1]}; its contract says {inputs} and {outputs}"
        )
    low, high = np.array(contract.low), np.array(contract.high)
    graph = _Graph()
    graph.apply("Sub", graph.constant("observation_mean", np.reshape(mean, (1, inputs))))
    graph.apply("Div", graph.constant("observation_scale", np.reshape(scale, (1, inputs))))
    for index, (weight, bias) in enumerate(layers):
        if index:
            graph.activate(activation)
        names = (graph.constant(f"weight_{index}", weight), graph.constant(f"bias_{index}", bias))
        graph.apply("Gemm", *names, transB=1)
    graph.apply("Clip", graph.constant("minus_one", -1.0), graph.constant("one", 1.0))
    graph.apply("Mul", graph.constant("half_width", (high - low)[None] / 2))
    graph.apply("Add", graph.constant("middle", (high + low)[None] / 2), result=OUTPUT)
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "policy",
            [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["N", inputs])],
            [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["N", outputs])],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="surefoot",
        producer_version=contract.version,
    )
    properties = {METADATA_KEY: contract.to_json()}
    if robot:
        properties[ROBOT_KEY] = base64.b64encode(robot).decode()
    helper.set_model_props(model, properties)
    onnx.checker.check_model(model, full_check=True)
    return model


def export_policy(actor: Any, activation: str, contract: Contract, path: str | Path, robot: bytes = b"") -> Path:
    """Write an actor as a policy file; the file appears whole or not at all.

    Args:
        actor: rsl_rl's `MLPModel`; its deterministic output is the action in [-1, 1].
        activation: of its hidden layers, one of `ACTIVATIONS`.
        contract: the policy's.
        path: .onnx to write.
        robot: archive of a robot that does not ship (`RobotDescription.archive`), which the file is to carry.

    Raises:
        SurefootError: another ending, or an actor that does not fit its contract or is not finite.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise SurefootError(f"policy file {path}: the name must end in .onnx")
    linear = [layer for layer in actor.mlp if hasattr(layer, "weight")]
    layers = [(_array(layer.weight), _array(layer.bias)) for layer in linear]
    width = layers[0][0].shape[1]
    mean, scale = np.zeros(width, np.float32), np.ones(width, np.float32)
    if hasattr(actor.obs_normalizer, "_mean"):
        normalizer = actor.obs_normalizer
        mean, scale = _array(normalizer._mean)[0], _array(normalizer._std)[0] + np.float32(normalizer.eps)
    data = build_model(layers, mean, scale, activation, contract, robot).SerializeToString()
    try:
        check_network(read_parts(data).graph)
    except SurefootError as error:
        raise SurefootError(f"policy file {path}: {error}; it is not written") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, add_digest(data))
    return path


def _array(tensor: Any) -> NDArray[np.float32]:
    array: NDArray[np.float32] = tensor.detach().cpu().numpy().astype(np.float32)
    return array
