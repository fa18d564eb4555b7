"""Builder of the ONNX graph of a policy file, with the few operators that `network.py` allows."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from surefoot.errors import SurefootError
from surefoot.policy.contract import METADATA_KEY, Contract
from surefoot.policy.digest import ROBOT_KEY
from surefoot.policy.network import INPUT, OPSET, OUTPUT

IR_VERSION = 8
MAX_FLOAT = float(np.finfo(np.float32).max)
MAX_CONSTANTS = 1 << 24
"""Numbers in all constants of a graph, 64 MiB; a network that is translated may need many to select columns."""


class Value(NamedTuple):
    """Named value (N, width) of the graph that depends on the observation."""

    name: str
    width: int


class Graph:
    """Nodes and constants of an ONNX graph under construction."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._numbers = 0

    def constant(self, array: Any, name: str = "") -> str:
        """Add a constant of 32-bit floats and return its name."""
        name = name or f"constant_{len(self.constants)}"
        self._check_room(np.size(array))
        self._numbers += np.size(array)
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(array, np.float32), name))
        return name

    def apply(self, kind: str, *values: str, result: str = "", **attributes: Any) -> str:
        """Apply an operator to values and return the name of the result."""
        result = result or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, values, [result], **attributes))
        return result

    def _check_room(self, numbers: int) -> None:
        """Reject constants with too many numbers, before they are made."""
        if self._numbers + numbers > MAX_CONSTANTS:
            raise SurefootError(f"the network needs constants of over {MAX_CONSTANTS} numbers; a policy has fewer")

    def linear(self, value: str, weight: ArrayLike, offset: ArrayLike | None = None) -> Value:
        """Apply a linear layer with a weight (in, out) and an offset (out,)."""
        transposed = np.asarray(weight, np.float64).T
        bias = np.zeros(len(transposed)) if offset is None else offset
        name = self.apply("Gemm", value, self.constant(transposed), self.constant(bias), transB=1)
        return Value(name, len(transposed))

    def select(self, value: Value, columns: Sequence[int]) -> Value:
        """Select columns of a value, in the given order."""
        self._check_room(value.width * len(columns))
        weight = np.zeros((value.width, len(columns)))
        weight[columns, np.arange(len(columns))] = 1.0
        return self.linear(value.name, weight)

    def join(self, values: Sequence[Value]) -> Value:
        """Concatenate values along columns, as a sum of values that are each padded with zeros to the full width."""
        if len(values) == 1:
            return values[0]
        width, start = sum(value.width for value in values), 0
        names = []
        for value in values:
            self._check_room(value.width * width)
            names.append(self.linear(value.name, np.eye(value.width, width, start)).name)
            start += value.width
        total = names[0]
        for name in names[1:]:
            total = self.apply("Add", total, name)
        return Value(total, width)

    def norm(self, value: Value) -> Value:
        """Return the Euclidean norm (N, 1) of each row."""
        squares = self.apply("Mul", value.name, value.name)
        return Value(self.apply("Sqrt", self.linear(squares, np.ones((value.width, 1))).name), 1)

    def leaky_relu(self, value: str, slope: float) -> str:
        """Apply a leaky ReLU with the given slope for negative inputs."""
        above = self.apply("Mul", self.apply("Relu", value), self.constant(1.0 - slope))
        return self.apply("Add", self.apply("Mul", value, self.constant(slope)), above)

    def elu(self, value: str, alpha: float) -> str:
        """Apply an ELU."""
        result = self.apply("Elu", value)
        if alpha == 1:
            return result
        # Only negative inputs are scaled by alpha.
        above = self.apply("Mul", self.apply("Relu", value), self.constant(1.0 - alpha))
        return self.apply("Add", self.apply("Mul", result, self.constant(alpha)), above)

    def clip(self, value: str, low: float, high: float) -> str:
        """Clip to bounds that may be infinite."""
        bounds = (self.constant(float(np.clip(bound, -MAX_FLOAT, MAX_FLOAT))) for bound in (low, high))
        return self.apply("Clip", value, *bounds)

    def to_onnx(
        self, inputs: Sequence[Value], outputs: Sequence[Value], name: str = "", version: str = ""
    ) -> onnx.ModelProto:
        """Return the graph as an ONNX model with the given inputs and outputs."""
        ends = [
            [helper.make_tensor_value_info(one.name, TensorProto.FLOAT, ["N", one.width]) for one in values]
            for values in (inputs, outputs)
        ]
        return helper.make_model(
            helper.make_graph(self.nodes, name, ends[0], ends[1], self.constants),
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="surefoot",
            producer_version=version,
        )

    def to_model(self, contract: Contract, robot: bytes) -> bytes:
        """Return the bytes of the policy file, without digest; the graph must define `OUTPUT`.

        Args:
            contract: contract of the policy.
            robot: archive of a robot that is not built in, to include in the file.
        """
        inputs, outputs = [Value(INPUT, contract.width)], [Value(OUTPUT, len(contract.action_names))]
        model = self.to_onnx(inputs, outputs, "policy", contract.version)
        properties = {METADATA_KEY: contract.to_json()}
        if robot:
            properties[ROBOT_KEY] = base64.b64encode(robot).decode()
        helper.set_model_props(model, properties)
        onnx.checker.check_model(model, full_check=True)
        data: bytes = model.SerializeToString()
        return data
