"""Policy network with one network per gait."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from surefoot.api.training import check_config
from surefoot.configuration import from_mapping, to_mapping
from surefoot.errors import SurefootError
from surefoot.learn.config import PPOConfig, TrainConfig
from surefoot.learn.gait_switch import GaitSwitchArchitecture, GaitSwitchNetwork
from surefoot.learn.run_folder import RunFolder
from surefoot.learn.training_loop import TrainingLoop
from surefoot.policy.graph import Graph
from surefoot.policy.network import INPUT
from surefoot.policy.torch_graph import trace_module
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.footholds import Footholds
from surefoot.world.sim_world import SimWorld


def both() -> GaitSwitchNetwork:
    """Return a network whose gaits output 1 + the second input and 10 times it; the first input blends them."""
    first, over = nn.Linear(2, 1), nn.Linear(2, 1)
    with torch.no_grad():
        for layer, weight, bias in ((first, 1.0, 1.0), (over, 10.0, 0.0)):
            layer.weight[:] = torch.tensor([0.0, weight])
            layer.bias.fill_(bias)
    return GaitSwitchNetwork(nn.Sequential(first), nn.Sequential(over), 0, 0.5)


def test_the_blend_weight_blends_both_gaits():
    given = torch.tensor([[0.0, 3.0], [0.25, 3.0], [0.5, 3.0]])
    np.testing.assert_allclose(both()(given).detach().numpy()[:, 0], [4.0, 17.0, 30.0])


def test_only_the_network_over_holes_learns():
    network = both()
    network(torch.tensor([[0.25, 1.0]])).sum().backward()
    learns = {name: one.grad is not None for name, one in network.named_parameters()}
    assert learns == {
        "first.0.weight": False,
        "first.0.bias": False,
        "over_holes.0.weight": True,
        "over_holes.0.bias": True,
    }


def test_the_network_can_be_exported():
    trace_module(both(), Graph(), INPUT, 2, 1)


@pytest.mark.parametrize("bias", [0.0, 2.0])
def test_a_single_gait_policy_becomes_the_first_network(bias: float):
    one = {"mlp.0.weight": torch.ones(1), "mlp.0.bias": torch.tensor([bias]), "distribution.std": torch.ones(1)}
    two = {f"mlp.{part}.0.{name}": torch.zeros(1) for part in ("first", "over_holes") for name in ("weight", "bias")}
    joined = GaitSwitchArchitecture().initial_parameters({**two, "distribution.std": torch.zeros(1)}, one)
    assert {name: float(value) for name, value in joined.items()} == {
        "mlp.first.0.weight": 1.0,
        "mlp.first.0.bias": bias,
        "mlp.over_holes.0.weight": 0.0,
        "mlp.over_holes.0.bias": 0.0,
        "distribution.std": 1.0,
    }


def config(task: TaskConfig, start_from: Path | None = None) -> TrainConfig:
    """Return a run of three small updates."""
    ppo = PPOConfig(policy_hidden=(8, 8), value_hidden=(8,), minibatches=1, epochs=1, init_std=0.1)
    counts = {"num_envs": 4, "steps_per_update": 4, "steps": 48, "evaluate_every": 16, "evaluation_episodes": 1}
    start = None if start_from is None else str(start_from)
    return TrainConfig(task, "small", ppo=ppo, threads=1, learning_threads=1, start_from=start, **counts)


def run(config: TrainConfig, folder: Path) -> TrainingLoop:
    loop = TrainingLoop.create(config, RunFolder.create(config, folder), SimWorld)
    loop.run(lambda *_: None)
    return loop


def test_a_warm_start_adds_a_gait_over_holes_and_trains_only_that(tmp_path: Path) -> None:
    blind = load_task("terrain", "go2")[0]
    blind = replace(blind, terrain=replace(blind.terrain, sizes={}, shares={}, ground="gaps:0.15"), max_steps=50)
    before = run(config(blind), tmp_path / "blind")
    reference = {"foothold_radius": 0.5, "over_holes": {"foot": to_mapping(blind.reference.foot)}}
    observations = [*blind.observations, "footholds", "over_holes"]
    reward = {**blind.reward, "foothold_error": -0.1}
    data = {"reference": reference, "observations": observations, "reward": reward}
    task = from_mapping(TaskConfig, data, base=blind)
    with pytest.raises(SurefootError, match=r"over_holes is given, but start_from is not"):
        check_config(config(task))

    def actions(loop: TrainingLoop, share: float, seen: dict[str, float]) -> np.ndarray:
        columns, history = loop.learner.env.observer.columns, loop.config.task.history
        row = np.array([share if name == "over_holes" else seen.get(name, 0.3) for name in columns], np.float32)
        return loop.learner.act(np.tile(row, history)[None])

    # The first gait has the policy with the best evaluation, which may not be the last one.
    rng = np.random.default_rng(0)
    seen = {name: float(rng.normal()) for name in before.learner.env.observer.columns}
    before.learner.policy.load_state_dict(before.best_actor)
    walks = actions(before, 0.0, seen)
    seeing = TrainingLoop.create(config(task, before.folder.path), RunFolder.create(config(task), tmp_path), SimWorld)
    np.testing.assert_allclose(actions(seeing, 0.0, seen), walks, atol=1e-5)
    over = actions(seeing, 1.0, seen)
    assert np.abs(over - walks).max() > 1e-3
    seeing.learner.env.component(Footholds).over_holes[:] = 1.0  # as if there were holes
    seeing.run(lambda *_: None)
    np.testing.assert_allclose(actions(seeing, 0.0, seen), walks, atol=1e-5)
    assert np.abs(actions(seeing, 1.0, seen) - over).max() > 1e-4
    # Another warm start keeps both networks.
    last = seeing.learner.policy.state_dict()
    again = config(task, seeing.folder.path)
    third = TrainingLoop.create(again, RunFolder.create(again, tmp_path / "3"), SimWorld)
    assert all(torch.equal(value, last[name]) for name, value in third.learner.policy.state_dict().items())
    # A run without a gait over holes can't start from it.
    walking = config(replace(task, reference=replace(task.reference, over_holes=None)), seeing.folder.path)
    with pytest.raises(SurefootError, match=r"has the networks of reference\.over_holes, which this run's task lacks"):
        TrainingLoop.create(walking, RunFolder.create(walking, tmp_path / "4"), SimWorld)
