"""Conversion of a torch module to an ONNX graph, with the few operators that policy files may have."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import fx, nn
from torch.fx.experimental.proxy_tensor import make_fx

from surefoot.errors import SurefootError
from surefoot.policy.graph import Graph, Value

ALLOWED = (
    "linear layers, ELU, SELU, ReLU, LeakyReLU, SiLU, Tanh, Sigmoid, Hardtanh, LayerNorm, BatchNorm, clamp, and sums, "
    "differences, products and quotients"
)
ROWS = 3
"""Number of rows of the example observations for tracing."""
_SELU = (1.6732632423543772, 1.0507009873554805)
_RESHAPE_OPERATORS = ("view", "_unsafe_view", "reshape", "squeeze", "unsqueeze", "expand", "slice", "select")
_IDENTITY_OPERATORS = ("detach", "alias", "clone", "contiguous", "_to_copy", "lift_fresh_copy")


def trace_module(module: nn.Module, graph: Graph, observation: str, width: int, outputs: int) -> Value:
    """Add the nodes of a module to a graph and return the value of its output.

    Values that do not depend on the observation, such as the scale of a normalizer, are computed once and stored as
    constants.

    Args:
        module: module from (N, width) to (N, outputs), independent for each row.
        graph: graph to which nodes are added.
        observation: name of the input.
        width: number of values in an observation.
        outputs: number of values in an output.

    Raises:
        SurefootError: the module has other widths, branches on the values of its inputs, or has an operator that is
            not allowed.
    """
    parameter = next(module.parameters(), torch.zeros(0))
    example = torch.zeros(ROWS, width, device=parameter.device)
    try:
        with torch.no_grad():
            traced = make_fx(module)(example)
    except Exception as error:  # a third-party module can raise anything
        reason = " ".join(str(error).split())[:200]
        raise SurefootError(f"the network can't take observations (N, {width}): {reason}") from error
    ((value, shape),) = add_traced(traced, graph, [Value(observation, width)])
    if shape != (ROWS, outputs):
        raise SurefootError(
            f"the network returns {_describe(shape)} for (N, {width}); its contract says (N, {outputs})"
        )
    return value


def add_traced(traced: fx.GraphModule, graph: Graph, inputs: list[Value]) -> list[tuple[Value, tuple[int, ...] | None]]:
    """Add the nodes of a function traced with `ROWS` rows; return its outputs and their shapes in the trace.

    Raises:
        SurefootError: an operator is not allowed, or an output does not depend on the inputs.
    """
    values: dict[fx.Node, Any] = {}
    remaining = iter(inputs)
    for node in traced.graph.nodes:
        if node.op == "placeholder":
            values[node] = next(remaining)
        elif node.op == "get_attr":
            values[node] = getattr(traced, node.target)
        elif node.op == "output":
            break
        else:
            values[node] = _apply(graph, node, values)
    (result,) = node.args
    outputs: list[tuple[Value, tuple[int, ...] | None]] = []
    for one in result if isinstance(result, list | tuple) else [result]:
        shape = tuple(one.meta["val"].shape) if isinstance(one, fx.Node) and "val" in one.meta else None
        value: Any = values.get(one)
        if shape is not None and not isinstance(value, Value):
            raise SurefootError("the network does not use the observation")
        outputs.append((value, shape))
    return outputs


def _describe(shape: tuple[int, ...] | None) -> str:
    return "no tensor" if shape is None else f"({', '.join('N' if size == ROWS else str(size) for size in shape)})"


def _apply(graph: Graph, node: fx.Node, values: dict[fx.Node, Any]) -> Any:
    """Return the value of a node: computed if it is constant, otherwise added to the graph."""
    args: Any = fx.map_arg(node.args, lambda one: values[one])
    kwargs = fx.map_arg(node.kwargs, lambda one: values[one])
    flat = [*args, *(part for one in args if isinstance(one, tuple | list) for part in one), *kwargs.values()]
    if not any(isinstance(one, Value) for one in flat):
        with torch.no_grad():
            return node.target(*args, **kwargs)  # type: ignore[operator]
    if node.target is operator.getitem:
        # Of operators with several results, such as a layer norm, only the first result is used.
        return args[0][operator.index(args[1])] if isinstance(args[0], list) else args[0] if args[1] == 0 else None
    name = str(getattr(node.target, "overloadpacket", node.target)).rpartition(".")[2].rstrip("_")
    shape = getattr(node.meta.get("val"), "shape", None)
    source = node.args[0]
    before = getattr(source.meta.get("val"), "shape", None) if isinstance(source, fx.Node) else None
    if name in _IDENTITY_OPERATORS or (
        name in _RESHAPE_OPERATORS and _squeezed_shape(shape) == _squeezed_shape(before)
    ):
        return args[0]
    try:
        result = _OPERATORS[name](graph, *args, **kwargs)
    except (KeyError, TypeError, NotImplementedError) as error:
        raise SurefootError(
            f"the network uses operator {name}, which is not supported or not with these arguments; allowed are "
            f"{ALLOWED}"
        ) from error
    if isinstance(result, list):
        return result
    width = next(one.width for one in flat if isinstance(one, Value)) if shape is None else int(shape[-1])
    return result if isinstance(result, Value) else Value(result, width)


def _squeezed_shape(shape: tuple[int, ...] | None) -> list[int] | None:
    """Return a shape without axes of length 1, which recurrent layers add around rows."""
    return None if shape is None else [size for size in shape if size != 1]


def _operand_name(graph: Graph, value: Any) -> str:
    """Return the name of an operand: a value of the graph, a number, or a row of numbers."""
    if isinstance(value, Value):
        return value.name
    array = np.asarray(value.detach().cpu() if isinstance(value, torch.Tensor) else value, np.float32)
    if array.size != array.shape[-1] if array.ndim else False:
        raise NotImplementedError
    return graph.constant(array.reshape(1, -1) if array.ndim else array)


def _linear(graph: Graph, bias: Any, value: Any, weight: Any) -> str:
    """Apply a linear layer with a weight (in, out)."""
    if not isinstance(value, Value) or isinstance(weight, Value) or isinstance(bias, Value):
        raise NotImplementedError
    transposed = weight.detach().cpu().numpy().T
    offset = np.zeros(len(transposed)) if bias is None else bias.detach().cpu().numpy()
    return graph.apply("Gemm", value.name, graph.constant(transposed), graph.constant(offset), transB=1)


def _binary(kind: str) -> Callable[..., str]:
    def apply(graph: Graph, first: Any, second: Any, alpha: float = 1.0) -> str:
        if alpha != 1.0:
            raise NotImplementedError
        if isinstance(first, Value):
            return graph.apply(kind, first.name, _operand_name(graph, second))
        if kind == "Div":
            raise NotImplementedError
        if kind == "Sub":
            negative = graph.apply("Mul", second.name, graph.constant(-1.0))
            return graph.apply("Add", negative, _operand_name(graph, first))
        return graph.apply(kind, second.name, _operand_name(graph, first))

    return apply


def _unary(kind: str) -> Callable[..., str]:
    return lambda graph, value: graph.apply(kind, value.name)


def _elu(graph: Graph, value: Value, alpha: float = 1.0, scale: float = 1.0, input_scale: float = 1.0) -> str:
    if input_scale != 1:
        raise NotImplementedError
    if math.isclose(alpha, _SELU[0]) and math.isclose(scale, _SELU[1]):
        return graph.apply("Selu", value.name)
    result = graph.elu(value.name, alpha)
    return result if scale == 1 else graph.apply("Mul", result, graph.constant(scale))


def _leaky_relu(graph: Graph, value: Value, slope: float = 0.01) -> str:
    return graph.leaky_relu(value.name, slope)


def _silu(graph: Graph, value: Value) -> str:
    return graph.apply("Mul", graph.apply("Sigmoid", value.name), value.name)


def _clamp(graph: Graph, value: Value, low: float | None = None, high: float | None = None) -> str:
    return graph.clip(value.name, -math.inf if low is None else low, math.inf if high is None else high)


def _require_columns(dim: int | list[int]) -> None:
    """Reject operations along other axes than the columns."""
    if (dim[0] if isinstance(dim, list) and len(dim) == 1 else dim) not in (1, -1):
        raise NotImplementedError


def _slice(graph: Graph, value: Value, dim: int = 0, start: Any = None, end: Any = None, step: int = 1) -> Value:
    _require_columns(dim)
    return graph.select(value, range(value.width)[start:end:step])


def _split(graph: Graph, value: Value, size: int, dim: int = 0) -> list[Value]:
    _require_columns(dim)
    starts = range(0, value.width, size)
    return [graph.select(value, range(start, min(start + size, value.width))) for start in starts]


def _single_element(graph: Graph, values: Any, dim: int = 0) -> Any:
    """Unpack a stack of one element, or make one; larger stacks are not supported."""
    if dim != 0 or (isinstance(values, list) and len(values) != 1):
        raise NotImplementedError
    return values[0] if isinstance(values, list) else [values]


def _source(graph: Graph, value: Any, source: Value, dim: int = 0, start: Any = None, end: Any = None) -> Value:
    """Return the source of a copy that overwrites a whole value."""
    if start is not None or end is not None or (isinstance(value, Value) and value.width != source.width):
        raise NotImplementedError
    return source


def _cat(graph: Graph, values: list[Any], dim: int = 0) -> Value:
    _require_columns(dim)
    if not all(isinstance(value, Value) for value in values):
        raise NotImplementedError
    return graph.join(values)


def _norm(graph: Graph, value: Value, order: float | None = 2, dim: Any = None, keep: bool = False) -> Value:
    _require_columns(dim)
    if order not in (None, 2) or not keep:
        raise NotImplementedError
    return graph.norm(value)


def _expand(graph: Graph, value: Value, shape: list[int]) -> Value:
    if value.width != 1:
        raise NotImplementedError
    return graph.linear(value.name, np.ones((1, shape[-1])))


def _power(graph: Graph, value: Value, exponent: float) -> str:
    if exponent != 2:
        raise NotImplementedError
    return graph.apply("Mul", value.name, value.name)


def _layer_norm(graph: Graph, value: Value, shape: list[int], weight: Any, bias: Any, epsilon: float) -> str:
    # The epsilon must be ONNX's default, so that the node needs no attribute.
    if len(shape) != 1 or not math.isclose(epsilon, 1e-5):
        raise NotImplementedError
    scale = np.ones(shape) if weight is None else weight.detach().cpu().numpy()
    offset = np.zeros(shape) if bias is None else bias.detach().cpu().numpy()
    return graph.apply("LayerNormalization", value.name, graph.constant(scale), graph.constant(offset))


def _batch_norm(
    graph: Graph, value: Value, weight: Any, bias: Any, mean: Any, variance: Any, training: bool, *rest: float
) -> str:
    if training:
        raise NotImplementedError
    scale = (1.0 if weight is None else weight) / torch.sqrt(variance + rest[-1])
    result = graph.apply("Mul", value.name, _operand_name(graph, scale))
    return graph.apply("Add", result, _operand_name(graph, (0.0 if bias is None else bias) - mean * scale))


_OPERATORS: dict[str, Callable[..., str | Value | list[Value]]] = {
    "addmm": _linear,
    "mm": lambda graph, value, weight: _linear(graph, None, value, weight),
    **{name: _binary(name.capitalize()) for name in ("add", "sub", "mul", "div")},
    **{name: _unary(name.capitalize()) for name in ("relu", "tanh", "sigmoid")},
    "rsub": lambda graph, first, second, alpha=1.0: _binary("Sub")(graph, second, first, alpha),
    "neg": lambda graph, value: graph.apply("Mul", value.name, graph.constant(-1.0)),
    "pow": _power,
    "elu": _elu,
    "silu": _silu,
    "leaky_relu": _leaky_relu,
    "clamp": _clamp,
    "clamp_min": lambda graph, value, low: _clamp(graph, value, low),
    "slice": _slice,
    "cat": _cat,
    **dict.fromkeys(("split", "unsafe_split"), _split),
    **dict.fromkeys(("stack", "unbind"), _single_element),
    **dict.fromkeys(("copy", "slice_scatter"), _source),
    "norm": _norm,
    "linalg_vector_norm": _norm,
    "expand": _expand,
    "hardtanh": lambda graph, value, low=-1.0, high=1.0: _clamp(graph, value, low, high),
    "native_layer_norm": _layer_norm,
    "native_batch_norm": _batch_norm,
}
"""Functions that add each torch operator to a graph; they raise `NotImplementedError` for unsupported arguments."""
