"""Export of policies, and the runtime of policy files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shipped_variants import modified_policy

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("rsl_rl")
pytest.importorskip("mujoco")

from torch import nn  # noqa: E402

from surefoot.errors import SurefootError  # noqa: E402
from surefoot.learn.config import PPOConfig, load_train_config  # noqa: E402
from surefoot.learn.ppo_learner import PpoLearner  # noqa: E402
from surefoot.policy.export import export_policy  # noqa: E402
from surefoot.policy.runtime import PolicyRuntime  # noqa: E402
from surefoot.task.contract_mapping import make_contract  # noqa: E402
from surefoot.world.sim_world import SimWorld  # noqa: E402


def make_learner(task: str, activation: str = "elu", history: int = 1) -> PpoLearner:
    """Return an untrained learner with a changed normalizer and last layer."""
    config, ppo = load_train_config(task), PPOConfig(policy_hidden=(16, 8), activation=activation)
    config = replace(config, task=replace(config.task, history=history), num_envs=2, threads=1, ppo=ppo)
    learner = PpoLearner(config, SimWorld)
    with torch.no_grad():
        learner.policy.mlp[-1].weight.mul_(20)
        for name, low, high in (("_mean", -1.0, 1.0), ("_std", 0.1, 3.0)):
            getattr(learner.policy.obs_normalizer, name).uniform_(low, high)
    return learner


@pytest.fixture(scope="module")
def learner() -> PpoLearner:
    return make_learner("trot")


@pytest.fixture(scope="module")
def policy_file(learner: PpoLearner, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return learner.export(tmp_path_factory.mktemp("policy") / "test.onnx", {"speed_mean": 0.1 + 0.2})


@pytest.mark.parametrize(
    ("task", "activation", "history"),
    [("trot", "elu", 1), ("gallop", "tanh", 3), ("trot", "relu", 2), ("gallop", "selu", 1), ("trot", "swish", 1)],
)
def test_a_policy_file_computes_the_feedback_of_network_and_environment(
    task: str, activation: str, history: int, tmp_path: Path, rng: np.random.Generator
):
    learner = make_learner(task, activation, history)
    runtime = PolicyRuntime.load(learner.export(tmp_path / "p.onnx"))
    observation = rng.normal(scale=3.0, size=(200, runtime.contract.width)).astype(np.float32)
    action = learner.act(observation)
    assert np.any(np.abs(action) > 1)
    assert np.any(np.abs(action) < 1)
    expected = learner.env.gait.feedback(action)
    assert np.allclose(runtime.feedback(observation), expected, rtol=0, atol=1e-5)


def test_a_policy_file_holds_the_contract_of_the_environment(policy_file: Path, learner: PpoLearner):
    contract = PolicyRuntime.load(policy_file).contract
    expected = make_contract(learner.env, learner.config, {"speed_mean": 0.1 + 0.2})
    assert contract == expected
    assert contract.columns == ("roll", "pitch", "roll_rate", "pitch_rate")
    assert (contract.low, contract.control_step, contract.control_latency) == ((-0.25,) * 8, 0.006, 0.02)
    assert [file.name for file in policy_file.parent.iterdir()] == ["test.onnx"]


def test_feedback_is_clipped_to_the_bounds_exactly(policy_file: Path):
    runtime = PolicyRuntime.load(policy_file)
    feedback = runtime.feedback(np.full((1, 4), 1e6))
    assert feedback.dtype == np.float64
    assert np.all(np.abs(feedback) <= 0.25)


def test_the_feedback_is_independent_of_the_batch(policy_file: Path, rng: np.random.Generator):
    runtime = PolicyRuntime.load(policy_file)
    observation = rng.normal(size=(7, 4))
    row_by_row = np.concatenate([runtime.feedback(row[None]) for row in observation])
    assert np.allclose(runtime.feedback(observation), row_by_row, atol=1e-6)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.zeros((1, 5)), r"shape \(1, 5\); this policy takes \(N, 4\)"),
        (np.zeros(4), r"shape \(4,\)"),
        (np.array([[0.0, np.nan, 0.0, 0.0]]), "observation 'pitch' is not finite"),
        (np.array([[0.0, 0.0, 0.0, np.inf]]), "observation 'pitch_rate' is not finite"),
    ],
)
def test_an_observation_that_does_not_fit_is_rejected(policy_file: Path, observation: np.ndarray, message: str):
    with pytest.raises(SurefootError, match=message):
        PolicyRuntime.load(policy_file).feedback(observation)


def rejected(path: Path, message: str) -> None:
    with pytest.raises(SurefootError, match=message) as caught:
        PolicyRuntime.load(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_rejected(tmp_path: Path):
    rejected(tmp_path / "none.onnx", "can't be read: No such file")
    rejected(tmp_path, "can't be read: Is a directory")


@pytest.mark.parametrize("part", [0.0, 0.001, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.999])
def test_a_truncated_file_is_rejected(policy_file: Path, tmp_path: Path, part: float):
    data = policy_file.read_bytes()
    path = tmp_path / "cut.onnx"
    path.write_bytes(data[: int(part * len(data))])
    rejected(path, "is empty|is damaged or not ONNX|has no contract")


def test_another_kind_of_file_is_rejected(tmp_path: Path):
    path = tmp_path / "text.onnx"
    path.write_text("I am no policy.\n" * 40)
    rejected(path, "is damaged or not ONNX")


def test_onnx_without_a_contract_is_rejected(policy_file: Path, tmp_path: Path):
    model = onnx.load(policy_file)
    model.ClearField("metadata_props")
    onnx.save(model, tmp_path / "p.onnx")
    rejected(tmp_path / "p.onnx", "has no contract")


def test_a_graph_of_another_width_than_its_contract_is_rejected(policy_file: Path, tmp_path: Path):
    path = modified_policy(tmp_path / "p.onnx", lambda contract: contract.update(history=2), policy_file)
    rejected(path, r"input is observation .*its contract says .*8\]")


def test_feedback_that_is_not_finite_is_rejected(policy_file: Path, tmp_path: Path):
    def enlarge(graph: Any) -> None:
        large = {"minus_one": 1.0, "half_width": 3e38, "middle": 3e38}
        for tensor in graph.initializer:
            if tensor.name in large:
                tensor.raw_data = np.full(tuple(tensor.dims), large[tensor.name], np.float32).tobytes()

    runtime = PolicyRuntime.load(modified_policy(tmp_path / "p.onnx", policy=policy_file, graph=enlarge))
    with pytest.raises(SurefootError, match="not finite"):
        runtime.feedback(np.zeros((1, 4)))


def test_a_network_that_could_not_be_loaded_is_not_written(learner: PpoLearner, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("surefoot.policy.network.MAX_WIDTH", 15)
    with pytest.raises(SurefootError, match=r"p\.onnx: constant 'constant_2' has shape \(16, 4\).*it is not written"):
        learner.export(tmp_path / "p.onnx")
    assert not list(tmp_path.iterdir())


def test_a_failed_export_leaves_the_old_file(policy_file: Path, tmp_path: Path):
    learner = make_learner("trot")
    path = tmp_path / "p.onnx"
    path.write_bytes(policy_file.read_bytes())
    with torch.no_grad():
        learner.policy.mlp[0].bias[0] = float("nan")
    with pytest.raises(SurefootError, match="not finite"):
        learner.export(path)
    assert path.read_bytes() == policy_file.read_bytes()
    assert [file.name for file in tmp_path.iterdir()] == ["p.onnx"]


def test_an_export_that_does_not_fit_is_rejected(learner: PpoLearner, tmp_path: Path):
    contract, network = make_contract(learner.env), nn.Linear(4, 8)
    for module, fitting, name, message in (
        (network, replace(contract, history=2), "p.onnx", r"can't take observations \(N, 8\)"),
        (nn.Linear(4, 7), contract, "p.onnx", r"the network returns \(N, 7\) for \(N, 4\); its contract says \(N, 8\)"),
        (network, contract, "p.pt", "must end in .onnx"),
        (nn.Sequential(network, nn.GELU()), contract, "p.onnx", "operator gelu, .*allowed are linear layers, ELU"),
        (nn.Sequential(nn.LayerNorm(4, eps=1e-3), network), contract, "p.onnx", "operator native_layer_norm"),
        (Decides(), contract, "p.onnx", "can't take observations .*control flow"),
        (nn.Sequential(network, MixesRows()), contract, "p.onnx", "operator mean"),
        (Changes(), contract, "p.onnx", "would return other actions than the network"),
    ):
        with pytest.raises(SurefootError, match=message):
            export_policy(module, fitting, tmp_path / name)
    assert not list(tmp_path.iterdir())


class Decides(nn.Module):
    def forward(self, x: Any) -> Any:
        return x.repeat(1, 2) if x.sum() > 0 else -x.repeat(1, 2)


class MixesRows(nn.Module):
    def forward(self, x: Any) -> Any:
        return x - x.mean(dim=0)


class Changes(nn.Module):
    """Module that returns another output at each call."""

    def __init__(self) -> None:
        super().__init__()
        self.layer, self.calls = nn.Linear(4, 8), 0

    def forward(self, x: Any) -> Any:
        self.calls += 1
        return self.layer(x) * self.calls


class Normalizes(nn.Module):
    """Normalizer with its parameters in buffers, written with functions."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor([0.1, -0.2, 0.3, 0.0]))
        self.register_buffer("variance", torch.tensor([1.0, 0.5, 2.0, 0.1]))

    def forward(self, x: Any) -> Any:
        return 1.0 - torch.clamp((x - self.mean) / torch.sqrt(self.variance + 1e-8), max=5.0)


NETWORKS = {
    "layer_norm": [nn.Linear(4, 16), nn.LayerNorm(16), nn.SiLU(), nn.Linear(16, 8)],
    "batch_norm": [nn.Linear(4, 16), nn.BatchNorm1d(16), nn.ReLU(inplace=True), nn.Dropout(), nn.Linear(16, 8)],
    "no_bias": [nn.Flatten(), nn.Linear(4, 16, bias=False), nn.LeakyReLU(0.2), nn.Linear(16, 8), nn.Tanh()],
    "functions": [Normalizes(), nn.Linear(4, 16), nn.ELU(alpha=0.5), nn.Linear(16, 8), nn.Hardtanh(-0.5, 0.9)],
    "selu": [nn.Linear(4, 16), nn.SELU(), nn.Linear(16, 16), nn.Sigmoid(), nn.Linear(16, 8)],
}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("output", ["action", "feedback"])
def test_any_module_gives_the_same_feedback_in_its_file(
    name: str, output: str, learner: PpoLearner, tmp_path: Path, rng: np.random.Generator
):
    torch.manual_seed(3)
    network = nn.Sequential(*NETWORKS[name])
    observation = rng.normal(scale=3.0, size=(200, 4)).astype(np.float32)
    network(torch.from_numpy(observation))  # updates the statistics of batch norm
    path = export_policy(network, make_contract(learner.env), tmp_path / "p.onnx", output)
    assert network.training
    with torch.no_grad():
        raw = network.eval()(torch.from_numpy(observation)).numpy()
    expected = np.clip(raw, -0.25, 0.25) if output == "feedback" else learner.env.gait.feedback(raw)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(PolicyRuntime.load(path).feedback(observation), expected, rtol=0, atol=2e-6)
