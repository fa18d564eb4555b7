"""Export of a policy to a single ONNX file with normalizer, network, bounds, contract and digest."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.files import atomic_write
from surefoot.policy.contract import MEMORY_RANGE, Contract
from surefoot.policy.digest import add_digest, read_parts
from surefoot.policy.graph import Graph
from surefoot.policy.network import INPUT, OUTPUT, check_network
from surefoot.policy.runtime import PolicyRuntime
from surefoot.policy.torch_graph import trace_module

if TYPE_CHECKING:
    from torch import nn

_SAMPLES = 64
_TOLERANCE = 1e-4
"""Maximum difference between network and file, relative to the half width of the bounds."""


def export_policy(
    network: nn.Module,
    contract: Contract,
    path: str | Path,
    output: Literal["action", "feedback"] = "action",
    robot: bytes = b"",
) -> Path:
    """Write a network as a policy file, atomically.

    If the network returns actions, the file computes feedback = low + (a + 1) / 2 (high - low) with
    a = clip(network(observation), -1, 1). If it returns feedback, the file computes
    clip(network(observation), low, high).

    Args:
        network: network from raw observations (N, O * history) in SI units as 32-bit floats to outputs (N, A).
        contract: contract of the policy; its bounds become constants of the file.
        path: .onnx file to write.
        output: output of the network: actions, as environments take them, or feedback in leg space.
        robot: archive of a robot that is not built in (`RobotDescription.archive`), to include in the file.

    Raises:
        SurefootError: the path does not end in .onnx, the network does not fit the contract or can't be exported, or
            it has non-finite numbers.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise SurefootError(f"policy file {path}: the name must end in .onnx")
    modes = {module: module.training for module in network.modules()}
    network.eval()
    try:
        data = _build_model(network, contract, output, robot)
        check_network(read_parts(data).graph)
        content = add_digest(data)
        _compare_outputs(network, PolicyRuntime.parse(content), output)
    except SurefootError as error:
        raise SurefootError(f"policy file {path}: {error}; it is not written") from error
    finally:
        for module, mode in modes.items():
            module.training = mode
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, content)
    return path


def _build_model(network: nn.Module, contract: Contract, output: str, robot: bytes) -> bytes:
    """Return the ONNX model of a network, without its digest."""
    low, high = np.array(contract.low), np.array(contract.high)
    half, middle = (high - low)[None] / 2, (high + low)[None] / 2
    graph = Graph()
    value = trace_module(network, graph, INPUT, contract.width, len(contract.action_names)).name
    offset = graph.constant(middle, "middle")
    if output == "feedback":
        value = graph.apply("Sub", value, offset)
        value = graph.apply("Div", value, graph.constant(np.where(half > 0, half, 1.0)))
    value = graph.apply("Clip", value, graph.constant(-1.0, "minus_one"), graph.constant(1.0, "one"))
    value = graph.apply("Mul", value, graph.constant(half, "half_width"))
    graph.apply("Add", value, offset, result=OUTPUT)
    return graph.to_model(contract, robot)


def _compare_outputs(network: nn.Module, policy: PolicyRuntime, output: str) -> None:
    """Reject a file that computes other outputs than its network, such as for a network that mixes rows of a batch."""
    low, high = np.array(policy.contract.low), np.array(policy.contract.high)
    observation = np.random.default_rng(0).normal(size=(_SAMPLES, policy.contract.width)).astype(np.float32)
    device = next((one.device for one in network.parameters()), torch.device("cpu"))
    with torch.no_grad():
        raw: Array = network(torch.from_numpy(observation).to(device)).cpu().numpy()
    expected = np.clip(raw, low, high) if output == "feedback" else low + (np.clip(raw, -1, 1) + 1) / 2 * (high - low)
    # The bounds of memory are far outside of its values.
    scale = np.where(high - low >= MEMORY_RANGE, np.maximum(np.abs(expected), 1.0), (high - low) / 2)
    difference = np.abs(policy.feedback(observation) - expected) / np.where(scale > 0, scale, 1.0)
    if not difference.max() <= _TOLERANCE:
        raise SurefootError(
            f"the file would return other actions than the network, by up to {difference.max():.2g}: does the network "
            "mix the robots of a batch, or change between calls?"
        )
