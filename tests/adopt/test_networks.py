"""Third-party networks: the translation matches torch over time; malicious files are rejected and not run."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from third_party_policies import onnx_model, perceptron
from torch import nn

from surefoot.adopt import torchscript_network
from surefoot.adopt.builder import build_policy
from surefoot.adopt.onnx_network import OnnxNetwork, run_model
from surefoot.adopt.specification import ObservationTerm, PolicySpecification
from surefoot.errors import SurefootError
from surefoot.policy.graph import Graph, Value

INPUTS, STATE = 9, 5


class Recurrent(nn.Module):
    """A recurrent policy whose state is an input, as Isaac Lab and mjlab export it to ONNX."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind, self.rnn = kind, (nn.LSTM if kind == "lstm" else nn.GRU)(INPUTS, STATE)
        self.actor = nn.Sequential(nn.Linear(STATE, 8), nn.ELU(), nn.Linear(8, 12))

    def forward(self, obs, *state):
        state = state if self.kind == "lstm" else state[0]
        result, after = self.rnn(obs.unsqueeze(0), state)
        return self.actor(result.squeeze(0)), *(after if self.kind == "lstm" else (after,))


class Buffered(nn.Module):
    """The same policy with its state in buffers, as rsl_rl and legged_gym export it to TorchScript."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.rnn = nn.LSTM(INPUTS, STATE) if kind == "lstm" else nn.GRU(INPUTS, STATE)
        self.actor = nn.Sequential(nn.Linear(STATE, 8), nn.ELU(), nn.Linear(8, 12))
        self.register_buffer("hidden_state", torch.zeros(1, 1, STATE))
        if kind == "lstm":
            self.register_buffer("cell_state", torch.zeros(1, 1, STATE))


class BufferedLstm(Buffered):
    def forward(self, x):
        x, (h, c) = self.rnn(x.unsqueeze(0), (self.hidden_state, self.cell_state))
        self.hidden_state[:] = h
        self.cell_state[:] = c
        return self.actor(x.squeeze(0))


class BufferedGru(Buffered):
    def forward(self, x):
        x, h = self.rnn(x.unsqueeze(0), self.hidden_state)
        self.hidden_state[:] = h
        return self.actor(x.squeeze(0))


def saved(module: nn.Module) -> bytes:
    file = io.BytesIO()
    torch.jit.save(torch.jit.script(module), file)
    return file.getvalue()


def exported(module: nn.Module, count: int) -> bytes:
    file = io.BytesIO()
    states = [torch.zeros(1, 1, STATE) for _ in range(count)]
    names = [f"state_{k}" for k in range(count)]
    torch.onnx.export(
        module,
        (torch.zeros(1, INPUTS), *states),
        file,
        input_names=["obs", *names],
        output_names=["actions", *(f"{name}_out" for name in names)],
        dynamo=False,
    )
    return file.getvalue()


OBSERVED = PolicySpecification(
    joints=tuple(f"{leg}_{part}_joint" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf")),
    default_pose=(0.0, 0.8, -1.5) * 4,
    kp=20.0,
    kd=0.5,
    control_step=0.02,
    observations=(ObservationTerm("angular_velocity"), ObservationTerm("gravity"), ObservationTerm("command")),
)


def actions(network, go2, run_controller, readings) -> tuple[np.ndarray, np.ndarray]:
    """Return the actions of a network on a robot with these readings, and its observations."""
    # The last action is observed with weight 0, so that memory contains the raw action.
    last = ObservationTerm("last_action", scale=0.0, columns=(0,))
    specification = OBSERVED.__class__(**{**vars(OBSERVED), "observations": (*OBSERVED.observations, last)})

    class Ignoring:
        inputs, outputs, hidden = INPUTS + 1, network.outputs, network.hidden

        def add(self, graph: Graph, observation: Value, hidden: list[Value]):
            return network.add(graph, graph.select(observation, range(INPUTS)), hidden)

    data = build_policy(specification, Ignoring(), go2, "recurrent", {})
    _, feedback, commands = run_controller(data, readings)
    observations = []
    for one, command in zip(readings, commands, strict=True):
        (roll, pitch), (sin, cos) = one.roll_pitch_yaw[:2], (np.sin, np.cos)
        down = [sin(pitch), -sin(roll) * cos(pitch), -cos(roll) * cos(pitch)]
        observations.append([*one.angular_velocity_base, *down, *command])
    return feedback[:, 12:24], np.array(observations, np.float32)


@pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning")
@pytest.mark.parametrize("kind", ["lstm", "gru"])
def test_recurrent_onnx_matches_torch_over_time(kind, go2, run_controller, random_readings):
    torch.manual_seed(1)
    module = Recurrent(kind).eval()
    states = [torch.zeros(1, 1, STATE) for _ in range(2 if kind == "lstm" else 1)]
    network = OnnxNetwork(exported(module, len(states)))
    assert (network.inputs, network.outputs, network.hidden) == (INPUTS, 12, (STATE,) * len(states))
    mine, observations = actions(network, go2, run_controller, random_readings[:100])
    for k in range(100):
        with torch.no_grad():
            theirs, *states = module(torch.from_numpy(observations[k : k + 1]), *states)
        np.testing.assert_allclose(mine[k], theirs.numpy()[0], atol=1e-5)


@pytest.mark.parametrize("kind", [BufferedLstm, BufferedGru])
def test_recurrent_torchscript_matches_torch_over_time(kind, go2, run_controller, random_readings):
    torch.manual_seed(2)
    module = kind("lstm" if kind is BufferedLstm else "gru").eval()
    network = torchscript_network.load(saved(module), INPUTS)
    assert network.hidden == ((STATE, STATE) if kind is BufferedLstm else (STATE,))
    mine, observations = actions(network, go2, run_controller, random_readings[:50])
    for k in range(50):
        with torch.no_grad():
            theirs = module(torch.from_numpy(observations[k : k + 1]))
        np.testing.assert_allclose(mine[k], theirs.numpy()[0], atol=1e-5)


def test_a_network_with_all_supported_operators_is_translated():
    random, nodes, constants = np.random.default_rng(0), [], []

    def constant(values, kind=np.float32):
        constants.append(numpy_helper.from_array(np.asarray(values, kind), f"c{len(constants)}"))
        return constants[-1].name

    def node(kind, *inputs, outputs=1, **attributes):
        names = [f"v{len(nodes)}_{k}" for k in range(outputs)]
        nodes.append(helper.make_node(kind, inputs, names, **attributes))
        return names[0] if outputs == 1 else names

    first, second = node("Split", "obs", constant([2, 4], np.int64), outputs=2, axis=1)
    length = node("ReduceL2", second, axes=[-1], keepdims=1)
    unit = node("Div", second, node("Expand", node("Clip", length, constant(1e-12)), constant([1, 4], np.int64)))
    some = node("Gather", unit, constant([3, 0], np.int64), axis=1)
    value = node("Concat", first, some, node("Slice", "obs", *(constant([k], np.int64) for k in (1, 3, 1))), axis=1)
    value = node("MatMul", value, constant(random.normal(size=(6, 8))))
    value = node("Add", value, constant(random.normal(size=8)))
    value = node("Add", node("LeakyRelu", value, alpha=0.02), node("Elu", value, alpha=0.5))
    value = node("LayerNormalization", value, constant(np.ones(8)), constant(np.zeros(8)), axis=-1)
    value = node("Sub", constant(1.0), node("Mul", node("Sigmoid", value), value))
    value = node("Sub", value, node("ReduceMean", value, axes=[1], keepdims=1))
    value = node("Max", node("Tanh", value), constant(-0.9))
    value = node("Reshape", node("Unsqueeze", value, constant([0], np.int64)), constant([1, 8], np.int64))
    value = node("Neg", node("Pow", node("Identity", value), constant(2.0)))
    nodes.append(helper.make_node("Gemm", [value, constant(random.normal(size=(8, 3)))], ["actions"], alpha=0.5))
    data = onnx_model(nodes, constants, {"obs": 6}, {"actions": 3})
    network = OnnxNetwork(data)  # compares the translation with the file
    assert (network.inputs, network.outputs) == (6, 3)


def changed(change) -> bytes:
    """Return a network file with a change of its model."""
    model = onnx.load_model_from_string(perceptron(45))
    change(model)
    return model.SerializeToString()


def add_node(*args, **kwargs):
    return lambda model: model.graph.node.append(helper.make_node(*args, **kwargs))


def outside(model):
    model.graph.initializer[0].data_location = TensorProto.EXTERNAL
    entry = model.graph.initializer[0].external_data.add()
    entry.key, entry.value = "location", "/etc/passwd"


def huge(model):
    model.graph.initializer[0].dims[:] = [1 << 20, 1 << 20]


def branch(model):
    inner = helper.make_graph([], "inner", [], [])
    model.graph.node.append(helper.make_node("If", ["obs"], ["out"], then_branch=inner, else_branch=inner))


def cut(model):
    model.graph.initializer[0].raw_data = model.graph.initializer[0].raw_data[:-4]


def other_type(model):
    model.graph.initializer[0].data_type = 99


def outer_sum(model):
    for name, shape in (("row", (1, 5000)), ("column", (5000, 1))):
        model.graph.initializer.append(numpy_helper.from_array(np.zeros(shape, np.float32), name))
    add_node("Add", ["row", "column"], ["big"])(model)


def repeated(model):
    model.graph.initializer.append(numpy_helper.from_array(np.zeros((1, 5000), np.float32), "long"))
    model.graph.initializer.append(numpy_helper.from_array(np.zeros(5000, np.int64), "index"))
    add_node("Gather", ["long", "index"], ["big"])(model)


def many_slices(model):
    """A wide value, and parts of it, each of which takes a matrix of a million numbers."""
    for name, numbers in (("wide", [1, 1024]), ("from", [0]), ("to", [1024]), ("axis", [1])):
        model.graph.initializer.append(numpy_helper.from_array(np.array(numbers, np.int64), name))
    model.graph.initializer.append(numpy_helper.from_array(np.zeros((45, 1), np.float32), "one"))
    add_node("MatMul", ["obs", "one"], ["narrow"])(model)
    add_node("Expand", ["narrow", "wide"], ["broad"])(model)
    for k in range(40):
        add_node("Slice", ["broad", "from", "to", "axis"], [f"part{k}"])(model)


def many_sums(model):
    for name, shape in (("row", (1, 2000)), ("column", (2000, 1))):
        model.graph.initializer.append(numpy_helper.from_array(np.zeros(shape, np.float32), name))
    for k in range(20):
        add_node("Add", ["row", "column"], [f"sum{k}"])(model)


def endless_row(model):
    model.graph.initializer.append(numpy_helper.from_array(np.array([1, 10**13], np.int64), "wide"))
    model.graph.initializer.append(numpy_helper.from_array(np.zeros((45, 1), np.float32), "one"))
    add_node("MatMul", ["obs", "one"], ["narrow"])(model)
    add_node("Expand", ["narrow", "wide"], ["broad"])(model)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (changed(many_slices), "the network needs constants of over 16777216 numbers"),
        (changed(many_sums), "the network computes over 16777216 constant numbers"),
        (changed(endless_row), "operator Expand in an unsupported way: it makes 10000000000000 numbers"),
        (changed(cut), "of the network can't be read"),
        (changed(other_type), "of the network can't be read"),
        (changed(outer_sum), "operator Add in an unsupported way: it makes 25000000 numbers"),
        (changed(repeated), "operator Gather in an unsupported way: it makes 25000000 numbers"),
        (changed(add_node("Split", ["obs"], ["x"], num_outputs=0)), "uses operator Split in an unsupported way"),
        (b"", "is not ONNX"),
        (b"\x80\x04\x95 a pickle", "is not ONNX"),
        (changed(add_node("Loop", ["obs"], ["x"])), "the network has operator 'Loop'; known are"),
        (changed(add_node("Gemm", ["obs", "nothing", "bias0"], ["x"])), "a Gemm of 'nothing', which is not defined"),
        (changed(add_node("Shell", ["obs"], ["x"], domain="com.evil")), "operator 'Shell' of 'com.evil' is unknown"),
        (changed(branch), "operator 'If' contains a graph"),
        (changed(outside), "is in another file, which was not read"),
        (changed(huge), "have over 8000000 numbers"),
        (changed(add_node("Expand", ["obs", "bias0"], ["x"])), "uses operator Expand in an unsupported way"),
        (perceptron(45)[:-4000], "is not ONNX"),
    ],
)
def test_malicious_networks_are_rejected_in_one_line(data, message):
    with pytest.raises(SurefootError) as caught:
        OnnxNetwork(data)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_constant_that_would_expand_to_gigabytes_is_rejected():
    size = numpy_helper.from_array(np.array([1 << 30], np.int64), "size")
    nodes = [helper.make_node("ConstantOfShape", ["size"], ["big"]), helper.make_node("Identity", ["obs"], ["actions"])]
    with pytest.raises(SurefootError, match="operator 'ConstantOfShape'; known are"):
        OnnxNetwork(onnx_model(nodes, [size], {"obs": 3}, {"actions": 3}))


@pytest.mark.parametrize("data", [b"", b"\x80\x02}q\x00."], ids=["empty", "pickle"])
def test_files_that_are_not_torchscript_are_rejected(data):
    with pytest.raises(SurefootError, match="not a TorchScript file"):
        torchscript_network.load(data, 45)


def test_a_checkpoint_with_a_pickle_is_not_unpickled(tmp_path):
    """A file of torch.save contains a pickle, which torch.jit.load must not run."""

    class Evil:
        def __reduce__(self):
            return open, (str(tmp_path / "was here"), "w")

    file = io.BytesIO()
    torch.save({"model": Evil()}, file)
    assert zipfile.is_zipfile(file)
    with pytest.raises(SurefootError, match="is not TorchScript that torch"):
        torchscript_network.load(file.getvalue(), 45)
    assert not (tmp_path / "was here").exists()


def test_a_translation_is_compared_with_the_file(monkeypatch):
    monkeypatch.setattr("surefoot.adopt.onnx_network.Graph.elu", lambda graph, value, alpha: graph.apply("Relu", value))
    with pytest.raises(SurefootError, match="was not translated correctly: outputs differ"):
        OnnxNetwork(perceptron(45))
    assert run_model(perceptron(45), {"obs": np.zeros((1, 45), np.float32)})[0].shape == (1, 12)
