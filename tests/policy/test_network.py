"""Networks that surefoot could not have written are rejected before onnxruntime reads them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shipped_variants import modified_policy

from surefoot.api.policies import find_policy
from surefoot.errors import SurefootError
from surefoot.policy import runtime
from surefoot.policy.digest import add_digest, read_parts
from surefoot.policy.network import MAX_BYTES, MAX_NODES
from surefoot.policy.protobuf import encode_field
from surefoot.policy.runtime import PolicyRuntime

onnx = pytest.importorskip("onnx")
make_node = onnx.helper.make_node


@pytest.fixture
def never_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime.onnxruntime, "InferenceSession", lambda *_, **__: pytest.fail("it was run"))


def add(*items: Any) -> Callable[[Any], None]:
    """Return an edit that adds nodes and constants."""

    def edit(graph: Any) -> None:
        for item in items:
            (graph.node if isinstance(item, onnx.NodeProto) else graph.initializer).append(item)

    return edit


def loop(graph: Any) -> None:
    """Add an endless loop."""
    ends = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.BOOL, []) for name in ("before", "after")]
    trip = onnx.helper.make_tensor_value_info("trip", onnx.TensorProto.INT64, [])
    body = onnx.helper.make_graph([make_node("Identity", ["before"], ["after"])], "body", [trip, ends[0]], ends[1:])
    graph.node.append(make_node("Loop", ["", ""], [], body=body))


def wide(graph: Any) -> None:
    graph.initializer.append(constant("wide"))
    graph.initializer[-1].dims[0] = 2**62


def in_another_file(graph: Any) -> None:
    graph.initializer.append(constant("far"))
    onnx.external_data_helper.set_external_data(graph.initializer[-1], "/etc/passwd")


def not_finite(graph: Any) -> None:
    graph.initializer[2].raw_data = np.full(tuple(graph.initializer[2].dims), np.nan, np.float32).tobytes()


def constant(name: str, shape: tuple[int, ...] = (1,), kind: type = np.float32) -> Any:
    return onnx.numpy_helper.from_array(np.zeros(shape, kind), name)


COLUMN, ROW = constant("column", (16384, 1)), constant("row", (1, 16384))
"""Two constants of 64 kB each whose broadcast sum has a gigabyte."""


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (loop, "operator 'Loop'; allowed are Sub, Div"),
        (add(make_node("ConstantOfShape", ["shape"], ["large"])), "operator 'ConstantOfShape'; allowed are Sub, Div"),
        (
            add(COLUMN, ROW, make_node("Add", ["column", "row"], ["x"])),
            "a Add with inputs that surefoot could not have",
        ),
        (
            add(COLUMN, make_node("Add", ["observation", "column"], ["x"])),
            "Add of 'column', which has more than one row",
        ),
        (
            add(constant("deep", (1, 1, 1))),
            r"constant 'deep' has shape \(1, 1, 1\); at most 2 dimensions of size 1 to 16384",
        ),
        (wide, "constant 'wide' has shape"),
        (in_another_file, "its constant has a field 13.2"),
        (add(constant("whole", kind=np.int32)), "constant 'whole' does not hold 32-bit floats"),
        (
            lambda graph: setattr(graph.initializer[0], "raw_data", b""),
            "constant 'constant_0' does not hold 32-bit floats",
        ),
        (not_finite, "constant 'constant_2' holds numbers that are not finite"),
        (
            add(*(make_node("Relu", ["feedback"], [f"more_{number}"]) for number in range(MAX_NODES))),
            f"has {MAX_NODES + 10} nodes; at most {MAX_NODES} are allowed",
        ),
        (add(*[make_node("Relu", ["feedback"], ["x"])] * 2000), "field 1 more than 1024 times"),
        (
            add(make_node("Gemm", ["observation", "observation", "constant_3"], ["square"], transB=1)),
            "Gemm of 'observation', which is not an allowed input",
        ),
        (lambda graph: setattr(graph.node[2].attribute[0], "name", "transA"), "Gemm with other attributes"),
        (
            lambda graph: graph.node[3].attribute.append(onnx.helper.make_attribute("alpha", 2.0)),
            "its attribute has a field 2.5",
        ),
        (lambda graph: setattr(graph.node[3], "domain", "com.microsoft"), "its node has a field 7.2"),
        (lambda graph: graph.node[-1].input.pop(), "a Add with inputs that surefoot could not have"),
        (add(make_node("Relu", ["feedback"], ["feedback"])), "value 'feedback' twice"),
        (lambda graph: graph.initializer.append(graph.initializer[0]), "constant 'constant_0' twice"),
        (lambda graph: graph.sparse_initializer.append(onnx.SparseTensorProto()), "its graph has a field 15.2"),
    ],
)
@pytest.mark.usefixtures("never_run")
def test_a_hostile_network_is_rejected_before_it_is_run(edit: Callable[[Any], object], message: str, tmp_path: Path):
    with pytest.raises(SurefootError, match=message) as caught:
        PolicyRuntime.load(modified_policy(tmp_path / "hostile.onnx", policy="trot", graph=edit))
    assert str(caught.value).startswith(f"policy file {tmp_path / 'hostile.onnx'}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("never_run")
def test_a_stale_file_is_rejected_before_it_is_run(tmp_path: Path):
    path = tmp_path / "stale.onnx"
    path.write_bytes(find_policy("trot").read_bytes().replace(b"constant_4", b"constant_Z"))
    with pytest.raises(SurefootError, match="its digest does not match"):
        PolicyRuntime.load(path)


def test_a_file_of_onnxruntimes_own_format_inside_is_read_as_onnx(tmp_path: Path):
    """Bytes 4 to 8 would make onnxruntime read another model than the checked one."""
    data, producer = find_policy("trot").read_bytes(), b"\x12\x08surefoot"
    path = tmp_path / "both.onnx"
    path.write_bytes(encode_field(2, b"..ORTM") + data.replace(producer, b"", 1))
    assert path.read_bytes()[4:8] == b"ORTM"
    assert PolicyRuntime.load(path).contract == PolicyRuntime.load(find_policy("trot")).contract


def test_a_file_that_is_too_large_is_rejected(tmp_path: Path):
    path = tmp_path / "large.onnx"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(SurefootError, match="has over 64 MiB; a policy is smaller"):
        PolicyRuntime.load(path)


TROT = read_parts(find_policy("trot").read_bytes())


@pytest.mark.parametrize(
    ("contract", "message"),
    [
        (b'{"kind": ' + b"[" * 100_000, "recursion"),
        (b"\xff{}", "utf-8"),
        (b'{"kind": "surefoot-policy", "schema": 2, "low": [1' + b"0" * 400 + b"]}", "000; numbers must be finite"),
        (
            TROT.contract.replace(b'"reference": {', b'"reference": {"file": "/dev/zero.npz", ', 1),
            "contract.reference names a file",
        ),
    ],
)
def test_a_contract_that_does_not_fit_its_reader_is_rejected(contract: bytes, message: str, tmp_path: Path):
    path = tmp_path / "p.onnx"
    entry = encode_field(14, encode_field(1, b"surefoot") + encode_field(2, contract))
    path.write_bytes(add_digest(encode_field(7, TROT.graph) + encode_field(8, b"\x10\x11") + entry))
    with pytest.raises(SurefootError, match=message) as caught:
        PolicyRuntime.load(path)
    assert "\n" not in str(caught.value)


CHATTY = """
import ctypes, os, sys
def say(what):
    os.write(1, f"{what}, directly\\n".encode())
    ctypes.CDLL(None).printf(f"{what}, through C's buffer\\n".encode())
say("warning when it is loaded")
sys.path.remove(os.path.dirname(__file__))
del sys.modules["onnxruntime"]
import onnxruntime
make = onnxruntime.InferenceSession
def session(*args, **kwargs):
    say("warning when a model is loaded")
    return make(*args, **kwargs)
onnxruntime.InferenceSession = session
"""


def test_what_onnxruntime_prints_never_gets_to_stdout(tmp_path: Path):
    """It prints warnings on unknown processors and devices, which with --json would end up within a JSON object."""
    (tmp_path / "onnxruntime.py").write_text(CHATTY)
    script = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
from surefoot.policy.runtime import PolicyRuntime
PolicyRuntime.load({str(find_policy("trot"))!r})
print("{{}}")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "{}\n"
    assert done.stderr.count("warning when it is loaded") == 2
    assert done.stderr.count("warning when a model is loaded") == 2
