"""Trace a TorchScript module into the operators that policy files may have; needs torch."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import torch
from torch import nn

from surefoot.errors import SurefootError
from surefoot.policy.graph import Graph, Value
from surefoot.policy.torch_graph import trace_module

_MAX_ACTIONS = 64


class _Example(nn.Module):
    """A module that needs what the tracing of others may load."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(6, 4), nn.ELU(), nn.LayerNorm(4), nn.Linear(4, 4))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        value = nn.functional.normalize(self.layers(observation), p=2.0, dim=-1)
        return torch.cat([value[:, :2], observation[:, 2:4]], dim=-1)


def warm_up() -> None:
    """Load all that torch loads when it is first used: later there are no rights to."""
    torch.set_num_threads(1)
    file = io.BytesIO()
    torch.jit.save(torch.jit.script(_Example()), file)
    file.seek(0)
    trace(file, 6, 2)


def trace(file: io.BytesIO, width: int, samples: int) -> tuple[bytes, bytes]:
    """Return a module as ONNX, and rows of random inputs with their outputs as 32-bit numbers.

    Raises:
        SurefootError: no TorchScript, or a network that can't be adopted.
    """
    try:
        module: Any = torch.jit.load(file, map_location="cpu")
    except Exception as error:  # a file of somebody else can raise anything
        reason = " ".join(str(error).split())[:200]
        raise SurefootError(f"is no TorchScript that torch {torch.__version__} loads: {reason}") from error
    module.eval()
    random = np.random.default_rng(0)
    observation = random.normal(size=(samples, width)).astype(np.float32)
    graph = Graph()
    with torch.no_grad():
        try:
            action = module(torch.from_numpy(observation))
        except Exception as error:
            raise SurefootError(f"the network can't take observations (N, {width}): {_last_line(error)}") from error
        if not isinstance(action, torch.Tensor) or action.ndim != 2 or not 0 < action.shape[1] <= _MAX_ACTIONS:
            raise SurefootError(f"the network gives {type(action).__name__}; it must give one row of actions")
        value = trace_module(module, graph, "observation", width, action.shape[1])
    model = graph.to_onnx([Value("observation", width)], [value], "traced")
    rows = np.concatenate([observation, action.numpy().astype(np.float32)], axis=1)
    return model.SerializeToString(), rows.tobytes()


def _last_line(error: Exception) -> str:
    """Return what an error of TorchScript says, which has the traceback before it."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__
