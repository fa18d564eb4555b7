"""Translation of third-party ONNX networks into the few operators that a policy file may have.

The file is read as data. Its nodes are translated one by one; unknown operators are rejected. Rows are robots: every
value has the shape (N, width), without the axes of length 1 that exporters add. Finally the translation is compared
with the file itself, which onnxruntime runs only after all nodes were translated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from surefoot.adopt.onnx_weights import constant_tensors
from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, quote
from surefoot.native_output import stdout_to_stderr
from surefoot.policy.graph import MAX_CONSTANTS, Graph, Value
from surefoot.policy.network import MAX_BYTES

MAX_NODES = 2000
MAX_NUMBERS = 8_000_000
"""Maximum number of elements in all constants together."""
MAX_WIDTH = 16384
_NUM_SAMPLES = 16
"""Number of random observations on which the translation is compared."""
_TOLERANCE = 1e-4
Item = Value | NDArray[Any]
"""A value, or a constant."""


class OnnxNetwork:
    """Network of an ONNX file; implements `ForeignNetwork`.

    The first input is the observation, further inputs are hidden states. The first output is the action, followed by
    the next hidden states in the same order.

    Raises:
        SurefootError: the file is not ONNX, or has an unsupported operator, size or input.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self.model = data, read_model(data)
        graph = self.model.graph
        constants = {tensor.name for tensor in graph.initializer}
        self._inputs = [one for one in graph.input if one.name not in constants]
        if not self._inputs or len(graph.output) < len(self._inputs):
            names = ", ".join(one.name for one in self._inputs)
            raise SurefootError(
                f"the network has inputs {names or 'none'} and {len(graph.output)} outputs; it must have an "
                "observation, an action, and an output for each hidden state"
            )
        widths = [_width(one) for one in self._inputs]
        self.inputs, self.hidden = widths[0], tuple(widths[1:])
        self.properties = {one.key: one.value for one in self.model.metadata_props}
        trial = Graph()
        action, after = self.add(trial, Value("observation", self.inputs), self._named_hidden())
        self.outputs = action.width
        if tuple(value.width for value in after) != self.hidden:
            raise SurefootError(
                f"the network takes hidden states of {list(self.hidden)} numbers and gives "
                f"{[value.width for value in after]}; they must be the same"
            )
        self._compare(trial, [action, *after])

    def _named_hidden(self) -> list[Value]:
        return [Value(f"hidden_{k}", width) for k, width in enumerate(self.hidden)]

    def add(self, graph: Graph, observation: Value, hidden: list[Value]) -> tuple[Value, list[Value]]:
        """Add the translated nodes to a graph; return the action and the next hidden states."""
        source = self.model.graph
        items: dict[str, Item] = {tensor.name: _read_constant(tensor) for tensor in source.initializer}
        items |= {one.name: value for one, value in zip(self._inputs, [observation, *hidden], strict=True)}
        numbers = 0
        for node in source.node:
            _translate(graph, node, items)
            made = [items[name] for name in node.output if name in items]
            numbers += sum(int(np.size(item)) for item in made if not isinstance(item, Value))
            if numbers > MAX_CONSTANTS:
                raise SurefootError(f"the network computes over {MAX_CONSTANTS} constant numbers; a policy has fewer")
        results = []
        for output in source.output[: len(self._inputs)]:
            item = items.get(output.name)
            if not isinstance(item, Value):
                raise SurefootError(f"output {quote(output.name)} of the network does not depend on its input")
            results.append(item)
        return results[0], results[1:]

    def _compare(self, graph: Graph, outputs: list[Value]) -> None:
        """Reject a translation with other outputs than the file."""
        graph_inputs = [Value("observation", self.inputs), *self._named_hidden()]
        model = graph.to_onnx(graph_inputs, outputs, "translation")
        random = np.random.default_rng(0)
        inputs = [random.normal(size=(_NUM_SAMPLES, v.width)).astype(np.float32) for v in graph_inputs]
        translated = run_model(
            model.SerializeToString(), dict(zip((v.name for v in graph_inputs), inputs, strict=True))
        )
        for row in range(_NUM_SAMPLES):
            feed = {}
            for one, samples in zip(self._inputs, inputs, strict=True):
                feed[one.name] = samples[row].reshape([size or 1 for size in _shape(one)])
            for mine, theirs in zip(translated, run_model(self._data, feed), strict=False):
                check_translation(mine[row], theirs.ravel())


def check_translation(mine: NDArray[Any], theirs: NDArray[Any]) -> None:
    """Reject a translation whose outputs differ from the outputs of the original network."""
    difference = np.abs(mine - theirs) / np.maximum(1.0, np.abs(theirs))
    if not difference.max() <= _TOLERANCE:
        raise SurefootError(f"the network was not translated correctly: outputs differ by {difference.max():.2g}")


def read_model(data: bytes) -> onnx.ModelProto:
    """Parse an ONNX model as data and check it for malicious content.

    Raises:
        SurefootError: it is not ONNX or too large, has data outside of the file, functions, or graphs in nodes.
    """
    if len(data) > MAX_BYTES:
        raise SurefootError(f"has over {MAX_BYTES >> 20} MiB; a policy is smaller")
    try:
        model = onnx.load_model_from_string(data)
    except Exception as error:  # protobuf has no specific error class
        raise SurefootError(f"is not ONNX: {' '.join(str(error).split())[:200]}") from error
    graph = model.graph
    if not graph.node:
        raise SurefootError("is not ONNX, or has no network")
    if model.functions or graph.sparse_initializer:
        raise SurefootError("has functions or sparse constants; a policy needs none")
    if len(graph.node) > MAX_NODES:
        raise SurefootError(f"its network has {len(graph.node)} nodes; at most {MAX_NODES} are allowed")
    total = 0
    for tensor in constant_tensors(graph):
        if tensor.data_location == TensorProto.EXTERNAL or tensor.external_data:
            raise SurefootError(f"constant {quote(tensor.name)} is in another file, which was not read")
        if any(size < 0 for size in tensor.dims):
            raise SurefootError(f"constant {quote(tensor.name)} has a size below 0")
        total += math.prod(tensor.dims)
        if total > MAX_NUMBERS:
            raise SurefootError(f"its constants have over {MAX_NUMBERS} numbers; a policy has fewer")
    for node in graph.node:
        if node.domain not in ("", "ai.onnx"):
            raise SurefootError(f"operator {quote(node.op_type)} of {quote(node.domain)} is unknown")
        for attribute in node.attribute:
            if attribute.type in (attribute.GRAPH, attribute.GRAPHS):
                raise SurefootError(
                    f"operator {quote(node.op_type)} contains a graph; a policy needs no branches or loops"
                )
    return model


def run_model(data: bytes, inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
    """Run a model that was checked before, and return its outputs."""
    with stdout_to_stderr():
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
            outputs: list[NDArray[Any]] = session.run(None, dict(inputs))
        except Exception as error:  # onnxruntime's errors have no common class
            raise SurefootError(f"onnxruntime can't run the network: {' '.join(str(error).split())[:200]}") from error
    return outputs


def _shape(info: onnx.ValueInfoProto) -> list[int]:
    """Return the shape of an input; 0 for a free dimension."""
    return [dim.dim_value for dim in info.type.tensor_type.shape.dim]


def _width(info: onnx.ValueInfoProto) -> int:
    """Return the width of an input."""
    shape = _shape(info)
    if info.type.tensor_type.elem_type != TensorProto.FLOAT or not shape:
        raise SurefootError(f"input {quote(info.name)} of the network is not a tensor of 32-bit numbers")
    if not 0 < shape[-1] <= MAX_WIDTH or any(size not in (0, 1) for size in shape[:-1]):
        raise SurefootError(f"input {quote(info.name)} of the network has shape {shape}; it must be one row of numbers")
    return shape[-1]


def _attributes(node: onnx.NodeProto) -> dict[str, Any]:
    return {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}


class _UnknownUseError(Exception):
    """An operator is used in an unsupported way."""


def _translate(graph: Graph, node: onnx.NodeProto, items: dict[str, Item]) -> None:
    """Translate a node: add its operations to the graph and its outputs to `items`."""
    kind = node.op_type
    if kind not in _OPERATORS:
        raise SurefootError(f"the network has operator {quote(kind)}; known are {choices(sorted(_OPERATORS))}")
    missing = [name for name in node.input if name and name not in items]
    if missing:
        raise SurefootError(f"the network has a {kind} of {quote(missing[0])}, which is not defined before it")
    inputs = [items[name] if name else None for name in node.input]
    try:
        attributes = _attributes(node)
        if kind == "Split":  # before opset 18, the number of parts is the number of outputs
            attributes.setdefault("num_outputs", len(node.output))
        results = _OPERATORS[kind](graph, inputs, attributes)
    except (_UnknownUseError, ArithmeticError, ValueError, IndexError, TypeError, KeyError, AttributeError) as error:
        raise SurefootError(f"the network uses operator {kind} in an unsupported way: {error}") from error
    for name, item in zip(node.output, results, strict=False):
        if isinstance(item, Value) and not 0 < item.width <= MAX_WIDTH:
            raise SurefootError(f"the network has a {kind} of {item.width} numbers; at most {MAX_WIDTH} are allowed")
        if not isinstance(item, Value) and np.size(item) > MAX_NUMBERS:
            raise SurefootError(f"the network has a {kind} of {np.size(item)} numbers")
        items[name] = item


Operator = Callable[[Graph, list[Any], dict[str, Any]], Sequence[Item]]


def _value(item: Any) -> Value:
    if not isinstance(item, Value):
        raise _UnknownUseError("it must take a value that depends on the observation")
    return item


def _constant(item: Any) -> NDArray[Any]:
    if item is None or isinstance(item, Value):
        raise _UnknownUseError("it must take a constant there")
    return np.asarray(item)


def _read_constant(tensor: TensorProto) -> NDArray[Any]:
    try:
        return numpy_helper.to_array(tensor)
    except (ValueError, TypeError, KeyError) as error:
        raise SurefootError(f"constant {quote(tensor.name)} of the network can't be read: {error}") from error


def _check_size(shape: Sequence[int]) -> None:
    """Reject the shape of a constant with too many numbers, before it is computed."""
    if math.prod(shape) > MAX_NUMBERS:
        raise _UnknownUseError(f"it makes {math.prod(shape)} numbers; at most {MAX_NUMBERS} are allowed")


def _row(array: Any) -> Array:
    """Return a constant as one row; a single number has width 1."""
    numbers = np.asarray(array, np.float64)
    if numbers.size != (numbers.shape[-1] if numbers.ndim else 1):
        raise _UnknownUseError("a constant has several rows")
    return numbers.reshape(1, -1)


def _unary(kind: str) -> Operator:
    return lambda graph, inputs, _: [Value(graph.apply(kind, _value(inputs[0]).name), inputs[0].width)]


def _binary(kind: str, function: Callable[[Any, Any], Any]) -> Operator:
    def apply(graph: Graph, inputs: list[Any], _: dict[str, Any]) -> Sequence[Item]:
        first, second = inputs
        if not isinstance(first, Value) and not isinstance(second, Value):
            _check_size(np.broadcast_shapes(np.shape(first), np.shape(second)))
            return [function(first, second)]
        widths = {item.width if isinstance(item, Value) else _row(item).shape[1] for item in inputs}
        if len(widths - {1}) > 1:
            raise _UnknownUseError(f"sizes {sorted(widths)} differ")
        if not isinstance(first, Value) and kind == "Div":
            raise _UnknownUseError("a constant is divided by a value")
        if not isinstance(first, Value) and kind == "Sub":
            negative = graph.apply("Mul", second.name, graph.constant(-1.0))
            return [Value(graph.apply("Add", negative, graph.constant(_row(first))), max(widths))]
        if not isinstance(first, Value):
            first, second = second, first
        other = second.name if isinstance(second, Value) else graph.constant(_row(second))
        return [Value(graph.apply(kind, first.name, other), max(widths))]

    return apply


def _gemm(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    if attributes.get("transA"):
        raise _UnknownUseError("transA is set")
    weight = _constant(inputs[1]).astype(np.float64) * attributes.get("alpha", 1.0)
    weight = weight.T if attributes.get("transB") else weight
    offset = None
    if len(inputs) > 2 and inputs[2] is not None:
        offset = np.broadcast_to(_row(_constant(inputs[2])) * attributes.get("beta", 1.0), (1, weight.shape[1]))[0]
    return [_linear(graph, inputs[0], weight, offset)]


def _linear(graph: Graph, value: Any, weight: Array, offset: Array | None = None) -> Value:
    if weight.ndim != 2 or weight.shape[0] != _value(value).width:
        raise _UnknownUseError(f"weights {weight.shape} do not fit {_value(value).width} numbers")
    return graph.linear(value.name, weight, offset)


def _same(graph: Graph, inputs: list[Any], _: dict[str, Any]) -> Sequence[Item]:
    return [_value(inputs[0])]


def _reshaped(function: Callable[..., Any]) -> Operator:
    """Return the translation of an operator that rearranges axes: it leaves values unchanged, but acts on constants."""

    def apply(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
        return [inputs[0] if isinstance(inputs[0], Value) else function(*inputs, **attributes)]

    return apply


def _axis_is_last(axis: int) -> None:
    # Values have rank 2, or 3 inside a recurrent network.
    if axis not in (-1, 1, 2):
        raise _UnknownUseError(f"axis {axis} is not the column axis")


def _concat(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    if not any(isinstance(item, Value) for item in inputs):
        _check_size((sum(np.size(item) for item in inputs),))
        return [np.concatenate([np.atleast_1d(_constant(item)) for item in inputs], attributes.get("axis", 0))]
    _axis_is_last(attributes.get("axis", 1))
    return [graph.join([_value(item) for item in inputs])]


def _slice(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    names = ("starts", "ends", "axes", "steps")
    options = dict(zip(names, inputs[1:], strict=False)) | attributes
    arrays = {
        name: np.atleast_1d(options[name]).astype(int).tolist() for name in names if options.get(name) is not None
    }
    count = len(arrays["starts"])
    axes, steps = arrays.get("axes", [*range(count)]), arrays.get("steps", [1] * count)
    item = inputs[0]
    for axis, start, end, step in zip(axes, arrays["starts"], arrays["ends"], steps, strict=True):
        if not isinstance(item, Value):
            index: list[Any] = [slice(None)] * np.ndim(item)
            index[axis] = slice(start, end, step)
            item = item[tuple(index)]
        elif axis in (0,) and start == 0 and end > 0 and step == 1:
            continue  # a slice of all rows
        else:
            _axis_is_last(axis)
            item = graph.select(item, range(item.width)[start:end:step])
    return [item]


def _gather(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    index, axis = _constant(inputs[1]).astype(int), attributes.get("axis", 0)
    if not isinstance(inputs[0], Value):
        shape = np.shape(inputs[0])
        _check_size((np.size(inputs[0]) // max(shape[axis], 1), np.size(index)))
        return [np.take(inputs[0], index, axis)]
    _axis_is_last(axis)
    return [graph.select(inputs[0], [range(inputs[0].width)[k] for k in np.atleast_1d(index)])]


def _split(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    _axis_is_last(attributes.get("axis", 0))
    sizes = inputs[1] if len(inputs) > 1 and inputs[1] is not None else attributes.get("split")
    value = _value(inputs[0])
    if sizes is None:  # equal parts; the last one has the remainder
        parts = int(attributes["num_outputs"])
        part = -(-value.width // parts)
        sizes = [part] * (parts - 1) + [value.width - part * (parts - 1)]
    ends = np.cumsum(np.asarray(sizes, int)).tolist()
    if min(sizes) < 1 or ends[-1] != value.width:
        raise _UnknownUseError(f"parts of {list(map(int, sizes))} of {value.width} numbers")
    return [graph.select(value, range(start, end)) for start, end in zip([0, *ends], ends, strict=False)]


def _clip(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    ends = [attributes.get("min", -math.inf), attributes.get("max", math.inf)]
    for k, item in enumerate(inputs[1:3]):
        if item is not None:
            ends[k] = float(_constant(item).reshape(()))
    return [Value(graph.clip(_value(inputs[0]).name, *ends), inputs[0].width)]


def _columns_of(inputs: list[Any], attributes: dict[str, Any]) -> Value:
    """Return the value of a reduction, which must be over the columns and keep its axis."""
    axes = attributes.get("axes", inputs[1] if len(inputs) > 1 else None)
    if axes is None or np.size(axes) != 1 or not attributes.get("keepdims", 1):
        raise _UnknownUseError("it is not only over the columns")
    _axis_is_last(int(np.ravel(axes)[0]))
    return _value(inputs[0])


def _norm(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    return [graph.norm(_columns_of(inputs, attributes))]


def _sum(scale: bool) -> Operator:
    def apply(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
        value = _columns_of(inputs, attributes)
        return [graph.linear(value.name, np.full((value.width, 1), 1.0 / value.width if scale else 1.0))]

    return apply


def _power(graph: Graph, inputs: list[Any], _: dict[str, Any]) -> Sequence[Item]:
    if float(_constant(inputs[1]).reshape(())) != 2.0:
        raise _UnknownUseError("only squares are supported")
    name = _value(inputs[0]).name
    return [Value(graph.apply("Mul", name, name), inputs[0].width)]


def _expand(graph: Graph, inputs: list[Any], _: dict[str, Any]) -> Sequence[Item]:
    value, width = _value(inputs[0]), int(np.ravel(_constant(inputs[1]))[-1])
    if width in (1, value.width):
        return [value]
    _check_size((width,))
    return [_linear(graph, value, np.ones((1, width)))]


def _layer_norm(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    if attributes.get("axis", -1) not in (-1, 1) or not math.isclose(
        attributes.get("epsilon", 1e-5), 1e-5, rel_tol=1e-3
    ):
        raise _UnknownUseError("its axis or epsilon is unusual")
    width = _value(inputs[0]).width
    scale = _row(_constant(inputs[1]))[0]
    offset = _row(_constant(inputs[2]))[0] if len(inputs) > 2 else np.zeros(width)
    name = graph.apply("LayerNormalization", inputs[0].name, graph.constant(scale), graph.constant(offset))
    return [Value(name, width)]


def _recurrent_inputs(inputs: list[Any], attributes: dict[str, Any]) -> tuple[Value, Array, Array, Array, Array]:
    """Return the input of a recurrent layer, its input and state weights (gates * H, ...), and both offsets."""
    forward = attributes.get("direction", b"forward") in (b"forward", "forward")
    if not forward or attributes.get("layout", 0) or attributes.get("activations") or attributes.get("clip"):
        raise _UnknownUseError("only standard forward layers are supported")
    weight, state = (_constant(item).astype(np.float64)[0] for item in inputs[1:3])
    size = len(weight)
    offset = np.zeros(2 * size) if len(inputs) < 4 or inputs[3] is None else _constant(inputs[3]).astype(np.float64)[0]
    if len(inputs) > 4 and inputs[4] is not None:
        raise _UnknownUseError("sequence lengths are not supported")
    return _value(inputs[0]), weight, state, offset[:size], offset[size:]


def _lstm(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    """Translate one time step of an LSTM layer, with ONNX's gate order i, o, f, c."""
    value, weight, state, offset, state_offset = _recurrent_inputs(inputs, attributes)
    hidden, cell = (_value(item) for item in inputs[5:7])
    if len(inputs) > 7 and inputs[7] is not None:
        raise _UnknownUseError("peepholes are not supported")
    size = hidden.width
    total = graph.apply(
        "Add",
        _linear(graph, value, weight.T, offset + state_offset).name,
        _linear(graph, hidden, state.T).name,
    )
    gates = [graph.select(Value(total, 4 * size), range(k * size, (k + 1) * size)).name for k in range(4)]
    put, out, keep = (graph.apply("Sigmoid", gate) for gate in gates[:3])
    new = graph.apply("Mul", put, graph.apply("Tanh", gates[3]))
    after = graph.apply("Add", graph.apply("Mul", keep, cell.name), new)
    result = Value(graph.apply("Mul", out, graph.apply("Tanh", after)), size)
    return [result, result, Value(after, size)]


def _gru(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    """Translate one time step of a GRU layer, with ONNX's gate order z, r, h."""
    value, weight, state, offset, state_offset = _recurrent_inputs(inputs, attributes)
    hidden = _value(inputs[5])
    size = hidden.width
    if not attributes.get("linear_before_reset", 0):
        raise _UnknownUseError("only linear_before_reset is supported, which torch uses")
    parts = []
    for k in range(3):
        rows = slice(k * size, (k + 1) * size)
        parts.append(
            (
                _linear(graph, value, weight[rows].T, offset[rows]).name,
                _linear(graph, hidden, state[rows].T, state_offset[rows]).name,
            )
        )
    update, reset = (graph.apply("Sigmoid", graph.apply("Add", *pair)) for pair in parts[:2])
    new = graph.apply("Tanh", graph.apply("Add", parts[2][0], graph.apply("Mul", reset, parts[2][1])))
    # h' = n + z (h - n)
    change = graph.apply("Mul", update, graph.apply("Sub", hidden.name, new))
    result = Value(graph.apply("Add", new, change), size)
    return [result, result]


def _constant_node(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    if "value" in attributes:
        return [numpy_helper.to_array(attributes["value"])]
    for name in ("value_float", "value_int", "value_floats", "value_ints"):
        if name in attributes:
            return [np.array(attributes[name])]
    raise _UnknownUseError("it has no numbers")


def _elu(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    return [Value(graph.elu(_value(inputs[0]).name, attributes.get("alpha", 1.0)), inputs[0].width)]


def _leaky_relu(graph: Graph, inputs: list[Any], attributes: dict[str, Any]) -> Sequence[Item]:
    return [Value(graph.leaky_relu(_value(inputs[0]).name, attributes.get("alpha", 0.01)), inputs[0].width)]


_OPERATORS: dict[str, Operator] = {
    "Constant": _constant_node,
    "Gemm": _gemm,
    "MatMul": lambda graph, inputs, _: [_linear(graph, inputs[0], _constant(inputs[1]).astype(np.float64))],
    "Add": _binary("Add", np.add),
    "Sub": _binary("Sub", np.subtract),
    "Mul": _binary("Mul", np.multiply),
    "Div": _binary("Div", np.divide),
    "Max": _binary("Max", np.maximum),
    "Min": _binary("Min", np.minimum),
    **{kind: _unary(kind) for kind in ("Relu", "Tanh", "Selu", "Sigmoid", "Sqrt")},
    "Neg": lambda graph, inputs, _: [
        Value(graph.apply("Mul", _value(inputs[0]).name, graph.constant(-1.0)), inputs[0].width)
    ],
    "Elu": _elu,
    "LeakyRelu": _leaky_relu,
    "Clip": _clip,
    "Pow": _power,
    "ReduceL2": _norm,
    "ReduceSum": _sum(False),
    "ReduceMean": _sum(True),
    "Expand": _expand,
    "LayerNormalization": _layer_norm,
    "Concat": _concat,
    "Slice": _slice,
    "Gather": _gather,
    "Split": _split,
    "LSTM": _lstm,
    "GRU": _gru,
    **{kind: _same for kind in ("Identity", "Dropout")},
    "Cast": _reshaped(lambda array, to, **_: array.astype(helper.tensor_dtype_to_np_dtype(to))),
    "Flatten": _reshaped(lambda array, axis=1: array.reshape(math.prod(array.shape[:axis]), -1)),
    "Reshape": _reshaped(lambda array, shape, **_: array.reshape(shape)),
    "Squeeze": _reshaped(lambda array, axes=None: np.squeeze(array, None if axes is None else tuple(np.ravel(axes)))),
    "Unsqueeze": _reshaped(lambda array, axes: np.expand_dims(array, tuple(np.ravel(axes)))),
    "Transpose": _reshaped(lambda array, perm=None: np.transpose(array, perm)),
}
"""Translations of ONNX operators."""
