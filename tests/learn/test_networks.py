"""Networks of a run, and additional policy architectures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from rsl_rl.models import MLPModel
from torch import nn

from surefoot.learn import networks
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.gait_switch import GaitSwitchArchitecture
from surefoot.learn.networks import find_architecture
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.task.config import TaskConfig, load_task
from surefoot.world.sim_world import SimWorld


class Mean(nn.Module):
    """The mean of two networks."""

    def __init__(self, one: nn.Module, other: nn.Module) -> None:
        super().__init__()
        self.one, self.other = one, other

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        mean: torch.Tensor = 0.5 * (self.one(inputs) + self.other(inputs))
        return mean


class MeanArchitecture:
    """Architecture of policies for robots that can overheat."""

    setting = "thermal_protection"

    def applies_to(self, task: TaskConfig) -> bool:
        return task.thermal_protection

    def build(self, actor: MLPModel, columns: Sequence[str], make_mlp: Callable[[], nn.Module]) -> None:
        assert list(columns) == ["roll", "pitch", "roll_rate", "pitch_rate"]
        actor.mlp = Mean(actor.mlp, make_mlp())

    def initial_parameters(
        self, fresh: Mapping[str, torch.Tensor], single: Mapping[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        return dict(fresh)


def config(**task: Any) -> TrainConfig:
    preset = load_train_config("trot")
    counts = {"num_envs": 2, "steps_per_update": 4, "threads": 1, "learning_threads": 1}
    return replace(preset, **counts, task=replace(preset.task, **task))


def test_an_architecture_is_used_for_the_tasks_to_which_it_applies(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(networks, "ARCHITECTURES", (GaitSwitchArchitecture(), MeanArchitecture()))
    learner = PpoLearner(config(thermal_protection=True), SimWorld)
    assert isinstance(learner.policy.mlp, Mean)
    learner.update()
    assert PpoLearner(config(), SimWorld).policy.mlp[0].weight.shape == (125, 4)


def test_shipped_architectures():
    assert find_architecture(load_task("trot")[0]) is None
    assert find_architecture(load_task("terrain-seeing", "go2")[0]) is networks.ARCHITECTURES[0]


def test_the_first_policy_acts_near_the_middle_of_the_bounds():
    learner = PpoLearner(config(), SimWorld)
    observation = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    assert np.abs(learner.act(observation)).max() < 0.2
