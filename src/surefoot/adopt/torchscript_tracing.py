"""Tracing of a TorchScript module into the operators that policy files may have; needs torch."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.fx.experimental.proxy_tensor import make_fx

from surefoot.errors import SurefootError
from surefoot.policy.graph import Graph, Value
from surefoot.policy.network import MAX_WIDTH
from surefoot.policy.torch_graph import ROWS, add_traced

_MAX_ACTIONS = 64
_MAX_TRIES = 40
"""Maximum number of observation widths that are tried if a module does not take the expected one."""
_STATES = ("hidden_state", "cell_state")
"""Buffers in which the exporters of rsl_rl and legged_gym store the state of a recurrent layer (1, 1, H)."""


class _Example(nn.Module):
    """A module that uses everything that torch may load lazily while it traces a policy."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(6, 4), nn.ELU(), nn.LayerNorm(4), nn.Linear(4, 4))
        self.rnn = nn.LSTM(4, 4)
        self.register_buffer("hidden_state", torch.zeros(1, 1, 4))
        self.register_buffer("cell_state", torch.zeros(1, 1, 4))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        value = nn.functional.normalize(self.layers(observation), p=2.0, dim=-1)
        result, (hidden, cell) = self.rnn(value.unsqueeze(0), (self.hidden_state, self.cell_state))
        self.hidden_state[:] = hidden  # type: ignore[operator]
        self.cell_state[:] = cell  # type: ignore[operator]
        return torch.cat([result.squeeze(0)[:, :2], observation[:, 2:4]], dim=-1)


def warm_up() -> None:
    """Load everything that torch loads on first use, because the sandbox later denies it."""
    torch.set_num_threads(1)
    # Without mkldnn, a recurrent layer consists of single operators that can be traced.
    torch.backends.mkldnn.set_flags(False)
    file = io.BytesIO()
    torch.jit.save(torch.jit.script(_Example()), file)
    file.seek(0)
    trace(file, 6, 2)


def trace(file: io.BytesIO, width: int, samples: int) -> tuple[bytes, bytes]:
    """Trace a module to ONNX, and return it with rows of random inputs and their outputs as 32-bit numbers.

    States of a recurrent layer become inputs after the observation and outputs after the action. A module that takes
    another observation width than `width` is traced with its own width; the caller compares it.

    Raises:
        SurefootError: the file is not TorchScript, or the network is not supported.
    """
    try:
        module: Any = torch.jit.load(file, map_location="cpu")
    except Exception as error:  # an untrusted file can raise anything
        reason = " ".join(str(error).split())[:200]
        raise SurefootError(f"is not TorchScript that torch {torch.__version__} loads: {reason}") from error
    module.eval()
    states = {name: buffer for name, buffer in module.named_buffers() if name in _STATES and buffer.numel()}
    if any(buffer.ndim != 3 or buffer.shape[:2] != (1, 1) for buffer in states.values()):
        shapes = ", ".join(f"{name} {tuple(buffer.shape)}" for name, buffer in states.items())
        raise SurefootError(f"the network has states {shapes}; one recurrent layer (1, 1, H) can be adopted")

    def step(observation: torch.Tensor, *before: torch.Tensor) -> tuple[torch.Tensor, ...]:
        for name, state in zip(states, before, strict=True):
            setattr(module, name, state)
        action = module(observation)
        return action, *(getattr(module, name) for name in states)

    width = _taken_width(step, width, module, [buffer.shape[2] for buffer in states.values()])
    widths = [width, *(buffer.shape[2] for buffer in states.values())]
    rows = samples if not states else ROWS
    random = np.random.default_rng(0)
    inputs = [random.normal(size=(rows, one)).astype(np.float32) for one in widths]
    tensors = [torch.from_numpy(one) if k == 0 else torch.from_numpy(one)[None] for k, one in enumerate(inputs)]
    with torch.no_grad():
        try:
            results = step(*(tensor.clone() for tensor in tensors))
            examples = [torch.zeros(ROWS, width), *(torch.zeros(1, ROWS, one) for one in widths[1:])]
            traced = make_fx(torch.func.functionalize(step))(*examples)
        except Exception as error:
            raise SurefootError(f"the network can't take observations (N, {width}): {_last_line(error)}") from error
    action = results[0]
    if not isinstance(action, torch.Tensor) or action.ndim != 2 or not 0 < action.shape[1] <= _MAX_ACTIONS:
        raise SurefootError(f"the network gives {type(action).__name__}; it must give one row of actions")
    graph = Graph()
    ends = [Value(name, one) for name, one in zip(("observation", *states), widths, strict=True)]
    values = [value for value, _ in add_traced(traced, graph, ends)]
    model = graph.to_onnx(ends, values, "traced")
    columns = [*inputs, *(result.numpy().reshape(rows, -1).astype(np.float32) for result in results)]
    return model.SerializeToString(), np.concatenate(columns, axis=1).tobytes()


def _taken_width(step: Callable[..., Any], width: int, module: Any, hidden: list[int]) -> int:
    """Return the observation width that a module accepts: `width`, or else the width of one of its tensors."""
    tensors = (*module.parameters(), *module.buffers())
    others = dict.fromkeys(int(tensor.shape[-1]) for tensor in tensors if tensor.ndim)
    for one in (width, *[size for size in others if 0 < size <= MAX_WIDTH][:_MAX_TRIES]):
        try:
            with torch.no_grad():
                result = step(torch.zeros(1, one), *(torch.zeros(1, 1, size) for size in hidden))
        except Exception:  # an untrusted module can raise anything
            continue
        if isinstance(result[0], torch.Tensor) and result[0].ndim == 2:
            return one
    return width


def _last_line(error: Exception) -> str:
    """Return the message of a TorchScript error, which is preceded by a traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__
