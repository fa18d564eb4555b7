"""Networks that surefoot could not have written are refused before onnxruntime reads them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surefoot.cli.helpers.policies import find_policy
from surefoot.errors import SurefootError
from surefoot.policy import runtime
from surefoot.policy.contract import METADATA_KEY
from surefoot.policy.digest import add_digest, read_parts
from surefoot.policy.network import MAX_BYTES, MAX_NODES
from surefoot.policy.protobuf import encode_field
from surefoot.policy.runtime import PolicyRuntime

onnx = pytest.importorskip("onnx")
make_node, make_tensor = onnx.helper.make_node, onnx.numpy_helper.from_array


@pytest.fixture
def never_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime.onnxruntime, "InferenceSession", lambda *_, **__: pytest.fail("it was run"))


def hostile(path: Path, edit: Callable[[Any], object]) -> Path:
    """The trot that ships after an edit, with a digest that matches."""
    model = onnx.load(find_policy("trot"))
    (contract,) = (prop for prop in model.metadata_props if prop.key == METADATA_KEY)
    onnx.helper.set_model_props(model, {METADATA_KEY: contract.value})
    edit(model.graph)
    path.write_bytes(add_digest(model.SerializeToString()))
    return path


def loop(graph: Any) -> None:
    """Do nothing, for ever."""
    ends = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.BOOL, []) for name in ("before", "after")]
    trip = onnx.helper.make_tensor_value_info("trip", onnx.TensorProto.INT64, [])
    body = onnx.helper.make_graph([make_node("Identity", ["before"], ["after"])], "body", [trip, ends[0]], ends[1:])
    graph.node.append(make_node("Loop", ["", ""], [], body=body))


def gigabytes(graph: Any) -> None:
    graph.node.append(make_node("ConstantOfShape", ["shape"], ["large"]))


def outer_sum(graph: Any) -> None:
    """Two constants of 64 kB each whose sum has a gigabyte."""
    graph.initializer.append(make_tensor(np.zeros((16384, 1), np.float32), "column"))
    graph.initializer.append(make_tensor(np.zeros((1, 16384), np.float32), "row"))
    graph.node.append(make_node("Add", ["column", "row"], ["large"]))


def outer_sum_with_the_observation(graph: Any) -> None:
    graph.initializer.append(make_tensor(np.zeros((16384, 1), np.float32), "column"))
    graph.node.append(make_node("Add", ["observation", "column"], ["large"]))


def deep(graph: Any) -> None:
    graph.initializer.append(make_tensor(np.zeros((1, 1, 1), np.float32), "deep"))


def wide(graph: Any) -> None:
    tensor = make_tensor(np.zeros(1, np.float32), "wide")
    tensor.dims[0] = 2**62
    graph.initializer.append(tensor)


def elsewhere(graph: Any) -> None:
    """Take the numbers of a constant from another file."""
    tensor = make_tensor(np.zeros(1, np.float32), "far")
    onnx.external_data_helper.set_external_data(tensor, "/etc/passwd")
    graph.initializer.append(tensor)


def whole_numbers(graph: Any) -> None:
    graph.initializer.append(make_tensor(np.zeros(1, np.int32), "whole"))


def empty_constant(graph: Any) -> None:
    graph.initializer[0].raw_data = b""


def not_finite(graph: Any) -> None:
    graph.initializer[2].raw_data = np.full(tuple(graph.initializer[2].dims), np.nan, np.float32).tobytes()


def many(graph: Any, count: int = MAX_NODES) -> None:
    for number in range(count):
        graph.node.append(make_node("Relu", ["feedback"], [f"more_{number}"]))


def very_many(graph: Any) -> None:
    many(graph, 2000)


def many_rows(graph: Any) -> None:
    """Multiply the batch with itself."""
    graph.node.append(make_node("Gemm", ["observation", "observation", "bias_0"], ["square"], transB=1))


def other_attribute(graph: Any) -> None:
    graph.node[2].attribute[0].name = "transA"


def attribute_of_elu(graph: Any) -> None:
    graph.node[3].attribute.append(onnx.helper.make_attribute("alpha", 2.0))


def other_domain(graph: Any) -> None:
    graph.node[3].domain = "com.microsoft"


def missing_input(graph: Any) -> None:
    del graph.node[-1].input[1]


def twice(graph: Any) -> None:
    graph.node.append(make_node("Relu", ["feedback"], ["feedback"]))


def constant_twice(graph: Any) -> None:
    graph.initializer.append(graph.initializer[0])


def sparse(graph: Any) -> None:
    graph.sparse_initializer.append(onnx.SparseTensorProto())


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (loop, "operator 'Loop'; allowed are Sub, Div"),
        (gigabytes, "operator 'ConstantOfShape'; allowed are Sub, Div"),
        (outer_sum, "a Add that surefoot could not have written"),
        (outer_sum_with_the_observation, "Add of 'column', which has more than one row"),
        (deep, r"constant 'deep' has shape \(1, 1, 1\); at most 2 dimensions of 1 to 16384"),
        (wide, "constant 'wide' has shape"),
        (elsewhere, "its constant has a field 13.2"),
        (whole_numbers, "constant 'whole' does not hold 32-bit numbers"),
        (empty_constant, "constant 'observation_mean' does not hold 32-bit numbers"),
        (not_finite, "constant 'weight_0' holds numbers that are not finite"),
        (many, f"has {MAX_NODES + 10} nodes; at most {MAX_NODES} are allowed"),
        (very_many, "field 1 more than 1024 times"),
        (many_rows, "Gemm of 'observation', which is not a value that it can take"),
        (other_attribute, "Gemm with other attributes"),
        (attribute_of_elu, "its attribute has a field 2.5"),
        (other_domain, "its node has a field 7.2"),
        (missing_input, "a Add that surefoot could not have written"),
        (twice, "value 'feedback' twice"),
        (constant_twice, "constant 'observation_mean' twice"),
        (sparse, "its graph has a field 15.2"),
    ],
)
@pytest.mark.usefixtures("never_run")
def test_a_hostile_network_is_refused_before_it_is_run(edit: Callable[[Any], None], message: str, tmp_path: Path):
    with pytest.raises(SurefootError, match=message) as caught:
        PolicyRuntime.load(hostile(tmp_path / "hostile.onnx", edit))
    assert str(caught.value).startswith(f"policy file {tmp_path / 'hostile.onnx'}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("never_run")
def test_a_stale_file_is_refused_before_it_is_run(tmp_path: Path):
    path = tmp_path / "stale.onnx"
    path.write_bytes(find_policy("trot").read_bytes().replace(b"weight_1", b"weight_7"))
    with pytest.raises(SurefootError, match="its digest does not match"):
        PolicyRuntime.load(path)


def test_a_file_of_onnxruntimes_own_format_inside_is_read_as_onnx(tmp_path: Path):
    """Bytes 4 to 8 would tell onnxruntime to read another model than the one that was checked."""
    data, producer = find_policy("trot").read_bytes(), b"\x12\x08surefoot"
    path = tmp_path / "both.onnx"
    path.write_bytes(encode_field(2, b"..ORTM") + data.replace(producer, b"", 1))
    assert path.read_bytes()[4:8] == b"ORTM"
    assert PolicyRuntime.load(path).contract == PolicyRuntime.load(find_policy("trot")).contract


def test_a_file_that_is_too_large_is_refused(tmp_path: Path):
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
def test_a_contract_that_does_not_fit_its_reader_is_refused(contract: bytes, message: str, tmp_path: Path):
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
    """On processors and devices that it does not know it prints warnings, with --json into the middle of an object."""
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
