"""Check of the network in a policy file before onnxruntime loads it.

An arbitrary ONNX file can loop indefinitely and expand ten bytes to gigabytes. Surefoot exports only multilayer
perceptrons, in which each node takes the result of an earlier node and constants of the file. Their memory is bounded
by the size of the file, and their time by the number of weights.
"""

from __future__ import annotations

import math

import numpy as np

from surefoot.errors import SurefootError, choices
from surefoot.policy.protobuf import BYTES, BYTES_LIST, NUMBER, NUMBERS, read_message

OPSET = 17
"""Version of the ONNX operator set that surefoot writes and reads."""
INPUT, OUTPUT = "observation", "feedback"
OPERATORS = {
    **{"Sub": 2, "Div": 2, "Mul": 2, "Add": 2, "Gemm": 3, "Clip": 3},
    **{"Elu": 1, "Relu": 1, "Tanh": 1, "Selu": 1, "Sigmoid": 1},
    **{"Min": 2, "Max": 2, "Sqrt": 1, "LayerNormalization": 3},
}
"""Allowed operators, and the number of inputs of each."""
MAX_BYTES = 64 * 2**20
"""Maximum size of a policy file; the built-in gaits have some 90 kB."""
MAX_NODES = 512
MAX_WIDTH = 16384
"""Maximum number of rows or columns of a constant."""
_CONSTANT_OPERANDS = ("Gemm", "LayerNormalization")
"""Operators whose inputs other than the first must be constants."""
_GRAPH = {1: BYTES_LIST, 2: BYTES, 5: BYTES_LIST, 11: BYTES_LIST, 12: BYTES_LIST}
_NODE = {1: BYTES_LIST, 2: BYTES_LIST, 3: BYTES, 4: BYTES, 5: BYTES_LIST}
_ATTRIBUTE = {1: BYTES, 3: NUMBER, 20: NUMBER}
_TENSOR = {1: NUMBERS, 2: NUMBER, 8: BYTES, 9: BYTES}
_FLOAT = 1
_TRANSPOSED = {1: [b"transB"], 3: [1], 20: [2]}
"""The only attribute that surefoot writes (transB = 1): the weights of a Gemm have the shape (out, in)."""


def check_network(graph: bytes) -> None:
    """Reject a network that surefoot could not have exported.

    Args:
        graph: bytes of the file's `GraphProto`.

    Raises:
        SurefootError: the network has another operator or attribute, constants that are of another type, not finite or
            too large, or too many nodes.
    """
    parts = read_message(graph, "graph", _GRAPH)
    if len(parts[1]) > MAX_NODES:
        raise SurefootError(f"its network has {len(parts[1])} nodes; at most {MAX_NODES} are allowed")
    shapes: dict[bytes, tuple[int, ...]] = {}
    for tensor in parts[5]:
        name, shape = _constant(tensor)
        if name in shapes:
            raise SurefootError(f"its network has constant {_quoted(name)} twice")
        shapes[name] = shape
    results = {INPUT.encode()}
    for node in parts[1]:
        result = _node(node, shapes, results)
        if result in results or result in shapes:
            raise SurefootError(f"its network has value {_quoted(result)} twice")
        results.add(result)


def _constant(tensor: bytes) -> tuple[bytes, tuple[int, ...]]:
    """Return the name and shape of a constant."""
    parts = read_message(tensor, "constant", _TENSOR)
    name, shape, data = b"".join(parts[8]), tuple(parts[1]), b"".join(parts[9])
    if len(shape) > 2 or any(not 0 < size <= MAX_WIDTH for size in shape):
        raise SurefootError(
            f"constant {_quoted(name)} has shape {shape}; at most 2 dimensions of size 1 to {MAX_WIDTH} are allowed"
        )
    if parts[2] != [_FLOAT] or len(data) != 4 * math.prod(shape):
        raise SurefootError(f"constant {_quoted(name)} does not hold 32-bit floats for its shape {shape}")
    if not np.isfinite(np.frombuffer(data, "<f4")).all():
        raise SurefootError(f"constant {_quoted(name)} holds numbers that are not finite")
    return name, shape


def _node(node: bytes, shapes: dict[bytes, tuple[int, ...]], results: set[bytes]) -> bytes:
    """Check a node and return the name of its result."""
    parts = read_message(node, "node", _NODE)
    kind = b"".join(parts[4]).decode(errors="replace")
    inputs, outputs = parts[1], parts[2]
    if kind not in OPERATORS:
        raise SurefootError(f"its network has operator {kind[:40]!r}; allowed are {choices(OPERATORS)}")
    if len(inputs) != OPERATORS[kind] or len(outputs) != 1 or inputs[0] not in results:
        raise SurefootError(f"its network has a {kind} with inputs that surefoot could not have written")
    weights = inputs[1:2] if kind == "Gemm" else []
    for name in inputs[1:]:
        if name not in shapes and (name not in results or kind in _CONSTANT_OPERANDS):
            raise SurefootError(f"its network has a {kind} of {_quoted(name)}, which is not an allowed input")
        # A constant with several rows would be broadcast with the batch, which makes results of unbounded size.
        if math.prod(shapes.get(name, ())[:-1]) > 1 and name not in weights:
            raise SurefootError(f"its network has a {kind} of {_quoted(name)}, which has more than one row")
    attributes = [read_message(attribute, "attribute", _ATTRIBUTE) for attribute in parts[5]]
    if attributes != ([_TRANSPOSED] if kind == "Gemm" else []):
        raise SurefootError(f"its network has a {kind} with other attributes than surefoot writes")
    return bytes(outputs[0])


def _quoted(name: bytes) -> str:
    """Return a name from a file, truncated and escaped for printing."""
    return repr(name[:40].decode(errors="replace"))
