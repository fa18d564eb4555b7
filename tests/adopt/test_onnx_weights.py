"""ONNX files of exporters: external weights, and Split without sizes."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper
from onnx.external_data_helper import convert_model_to_external_data
from third_party_policies import onnx_model, perceptron

from surefoot.adopt.onnx_network import OnnxNetwork, run_model
from surefoot.adopt.onnx_weights import read_network
from surefoot.errors import SurefootError


@pytest.fixture
def beside(tmp_path):
    """A network with external weights in a file next to it."""
    model = onnx.load_model_from_string(perceptron(45))
    convert_model_to_external_data(model, location="policy.onnx.data", size_threshold=0)
    onnx.save(model, tmp_path / "policy.onnx")
    return tmp_path / "policy.onnx"


def test_external_weights_are_read(beside):
    row = {"obs": np.random.default_rng(0).normal(size=(1, 45)).astype(np.float32)}
    whole = read_network(beside)
    np.testing.assert_array_equal(run_model(whole, row)[0], run_model(perceptron(45), row)[0])
    assert OnnxNetwork(whole).inputs == 45


def test_missing_and_misplaced_weights_are_reported(beside, tmp_path):
    (tmp_path / "policy.onnx.data").rename(tmp_path / "moved")
    with pytest.raises(SurefootError, match=r"the weights are in policy.onnx.data, which is not next to it; copy it"):
        read_network(beside)
    (tmp_path / "policy.onnx.data").write_bytes((tmp_path / "moved").read_bytes()[:50])
    with pytest.raises(SurefootError, match=r"policy.onnx.data has 50 bytes; constant"):
        read_network(beside)


@pytest.mark.parametrize("place", ["../policy.onnx.data", "/etc/passwd", "..", "a\\b", ""])
def test_only_files_in_the_same_folder_are_opened(beside, place):
    model = onnx.load(beside, load_external_data=False)
    for tensor in model.graph.initializer:
        for entry in tensor.external_data:
            if entry.key == "location":
                entry.value = place
    beside.write_bytes(model.SerializeToString())
    with pytest.raises(SurefootError, match="they must be in a file next to it"):
        read_network(beside)


@pytest.mark.parametrize(("key", "value"), [("offset", "-4"), ("length", "1e9"), ("offset", "9" * 13)])
def test_weight_offsets_must_be_numbers_of_bytes(beside, key, value):
    model = onnx.load(beside, load_external_data=False)
    entry = next((one for one in model.graph.initializer[0].external_data if one.key == key), None)
    if entry is None:
        entry = model.graph.initializer[0].external_data.add()
        entry.key = key
    entry.value = value
    beside.write_bytes(model.SerializeToString())
    with pytest.raises(SurefootError, match="it must be a number of bytes"):
        read_network(beside)


@pytest.mark.parametrize(("opset", "extra"), [(11, {}), (13, {}), (18, {"num_outputs": 2})])
def test_a_split_without_sizes_has_equal_parts(opset, extra):
    weight = numpy_helper.from_array(np.random.default_rng(0).normal(size=(45, 24)).astype(np.float32) * 0.01, "w")
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["both"]),
        helper.make_node("Split", ["both"], ["mean", "spread"], axis=-1, **extra),
        helper.make_node("Tanh", ["mean"], ["action"]),
    ]
    model = onnx.load_model_from_string(onnx_model(nodes, [weight], {"obs": 45}, {"action": 12}))
    model.opset_import[0].version = opset
    assert OnnxNetwork(model.SerializeToString()).outputs == 12
