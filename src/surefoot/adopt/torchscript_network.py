"""Reader of TorchScript networks, which torch loads in a sandboxed process without rights (`sandbox.py`).

The process traces the module into the operators that policy files may have, and returns it as ONNX with samples of
inputs and outputs. Its output is treated as untrusted data, like any other ONNX file.
"""

from __future__ import annotations

import io
import signal
import sys
from importlib.util import find_spec
from typing import Any

import numpy as np

from surefoot import sandbox
from surefoot.adopt.onnx_network import OnnxNetwork, check_translation, run_model
from surefoot.errors import SurefootError
from surefoot.policy.network import MAX_BYTES

_LIMITS = sandbox.Limits(memory=16 * 2**30, time=60.0, timeout=180.0)
"""Limits of the process: torch reserves about 5 GiB of address space and takes some seconds to load."""
_SAMPLES = 16
_TRUSTED = "trusted"


def load(data: bytes, width: int, trusted: bool = False) -> OnnxNetwork:
    """Load the network of a TorchScript file.

    Args:
        data: the file.
        width: expected width of an observation.
        trusted: load it with all rights, for systems without sandbox support.

    Raises:
        SurefootError: torch is missing, the file is not TorchScript, or the network is not supported.
    """
    if len(data) > MAX_BYTES:
        raise SurefootError(f"has over {MAX_BYTES >> 20} MiB; a policy is smaller")
    if not data.startswith(b"PK"):
        raise SurefootError("is not a TorchScript file; a checkpoint (model_1000.pt) has no network: export the policy")
    if not trusted and not sandbox.is_supported():
        raise SurefootError(
            "is TorchScript, which this machine can't load without rights to files and network; if you trust it, "
            "give --trust"
        )
    if find_spec("torch") is None:
        raise SurefootError("is TorchScript, which needs torch; export the policy to ONNX, or install torch")
    ending = sandbox.run_module(__name__, [str(width), *([_TRUSTED] if trusted else [])], _LIMITS, data)
    if ending.code == -signal.SIGKILL:
        raise SurefootError(f"torch did not load it within {_LIMITS.timeout:g} s")
    if ending.code:
        raise SurefootError(ending.message or f"torch ended with code {ending.code} as it loaded it")
    result = ending.output
    sizes = np.frombuffer(result[:16], "<u8").tolist()
    if len(sizes) != 2 or sum(sizes) + 16 != len(result):
        raise SurefootError("torch gave no network")
    network = OnnxNetwork(result[16 : 16 + sizes[0]])
    _check_samples(network, np.frombuffer(result[16 + sizes[0] :], "<f4"), result[16 : 16 + sizes[0]])
    return network


def _check_samples(network: OnnxNetwork, samples: Any, model: bytes) -> None:
    """Reject a network whose outputs differ from the module's samples."""
    ends, names = [network.inputs, *network.hidden], [one.name for one in network.model.graph.input]
    widths = [*ends, network.outputs, *network.hidden]
    if samples.size % sum(widths) or not np.isfinite(samples).all():
        raise SurefootError("the network gives numbers that are not finite")
    columns = np.split(samples.reshape(-1, sum(widths)), np.cumsum(widths)[:-1], axis=1)
    results = run_model(model, dict(zip(names, columns, strict=False)))
    for mine, theirs in zip(results, columns[len(ends) :], strict=True):
        check_translation(mine, theirs)


def main(words: list[str]) -> int:
    """Entry point of the process: read TorchScript from standard input, write ONNX and samples to standard output."""
    from surefoot.adopt.torchscript_tracing import trace, warm_up

    data, width = sys.stdin.buffer.read(), int(words[0])
    output = sandbox.claim_stdout()
    warm_up()
    try:
        if _TRUSTED not in words:
            sandbox.enter_sandbox(_LIMITS)
        model, samples = trace(io.BytesIO(data), width, _SAMPLES)
    except SurefootError as error:
        print(error, file=sys.stderr)
        return 2
    sizes = np.array([len(model), len(samples)], "<u8").tobytes()
    with output:
        output.write(sizes + model + samples)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
