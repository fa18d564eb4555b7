"""Reader of external weights, such as `policy.onnx.data`, which exporters write next to an ONNX file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import onnx
from onnx import TensorProto

from surefoot.errors import SurefootError, describe_os_errors, prefix_errors, quote
from surefoot.policy.network import MAX_BYTES


def read_network(path: Path) -> bytes:
    """Read a network file; external weights of an ONNX file are embedded in the returned bytes.

    Raises:
        SurefootError: a file is missing or too large, or the weights are not in the same folder.
    """
    data = _read(path)
    if path.suffix != ".onnx" or b"location" not in data:
        return data
    try:
        model = onnx.load_model_from_string(data)
    except Exception:  # the next parser reports the error
        return data
    total = 0
    files: dict[str, bytes] = {}
    with prefix_errors(path):
        for tensor in constant_tensors(model.graph):
            if tensor.data_location != TensorProto.EXTERNAL:
                continue
            entries = {entry.key: entry.value for entry in tensor.external_data}
            name = entries.get("location", "")
            if name not in files:
                files[name] = _read_weights(path, name)
            start, size = (_whole(entries.get(key), default) for key, default in (("offset", 0), ("length", -1)))
            end = len(files[name]) if size < 0 else start + size
            if end > len(files[name]):
                raise SurefootError(f"{name} has {len(files[name])} bytes; constant {quote(tensor.name)} ends at {end}")
            total += end - start
            if total > MAX_BYTES:
                raise SurefootError(f"its constants have over {MAX_BYTES >> 20} MiB; a policy is smaller")
            tensor.raw_data = files[name][start:end]
            tensor.ClearField("external_data")
            tensor.data_location = TensorProto.DEFAULT
    return bytes(model.SerializeToString()) if files else data


def constant_tensors(graph: onnx.GraphProto) -> Iterator[TensorProto]:
    """Yield the constants of a graph, including tensors in attributes of nodes."""
    yield from graph.initializer
    for node in graph.node:
        yield from (attribute.t for attribute in node.attribute if attribute.type == attribute.TENSOR)


def _whole(text: str | None, default: int) -> int:
    """Parse an offset or length [byte]."""
    if text is None:
        return default
    if not text.isascii() or not text.isdigit() or len(text) > 12:
        raise SurefootError(f"a constant begins or ends at {quote(text)}; it must be a number of bytes")
    return int(text)


def _read_weights(path: Path, name: str) -> bytes:
    """Read a file next to another one; its name must not have folders."""
    if not name or name in (".", "..") or any(letter in name for letter in "/\\\0"):
        raise SurefootError(f"its weights are in {quote(name)}; they must be in a file next to it")
    weights = path.parent / name
    if not weights.exists():
        raise SurefootError(f"the weights are in {name}, which is not next to it; copy it there")
    return _read(weights)


def _read(path: Path) -> bytes:
    with describe_os_errors(path):
        if path.exists() and not path.is_file():
            raise SurefootError(f"{path}: is no file")
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise SurefootError(f"{path}: has over {MAX_BYTES >> 20} MiB; a policy is smaller")
    return data
