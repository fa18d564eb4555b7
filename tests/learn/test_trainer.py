"""What the learning algorithm is given."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest
import torch

from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.trainer import Trainer
from surefoot.robot.randomization import load_ranges
from surefoot.world.sim_world import SimWorld


def rewards_given(fall_cost: float) -> tuple[torch.Tensor, torch.Tensor, Trainer]:
    """What is learned from in one update of robots that fall at once: rewards and ends of episodes, (T, N)."""
    preset = load_train_config("trot")
    config = replace(
        preset,
        num_envs=8,
        steps_per_update=40,
        threads=1,
        learning_threads=1,
        task=replace(preset.task, fall_angle=0.03),
        ppo=replace(preset.ppo, fall_cost=fall_cost, reward_scale=10.0, init_std=1.0),
    )
    trainer = Trainer(config, SimWorld)
    taken: list[tuple[torch.Tensor, torch.Tensor]] = []
    process = trainer.algorithm.process_env_step

    def keep(observation: Any, rewards: torch.Tensor, dones: torch.Tensor, extras: Any) -> None:
        taken.append((rewards.clone(), dones.clone()))
        process(observation, rewards, dones, extras)

    trainer.algorithm.process_env_step = keep  # type: ignore[method-assign]
    figures = trainer.update()
    assert figures.falls > 0
    rewards, dones = zip(*taken, strict=True)
    return torch.stack(rewards), torch.stack(dones), trainer


def test_a_fall_costs_its_price_once_and_nothing_else_changes():
    free, fell, _ = rewards_given(0.0)
    dear, fell_too, trainer = rewards_given(2.5)
    assert torch.equal(fell, fell_too)
    assert 0 < int(fell.sum()) < fell.numel()
    torch.testing.assert_close(dear, free - 10.0 * 2.5 * fell.float())
    # Figures are the task's own: no price in them.
    assert float(trainer.env.returns.min()) > -1.0


@pytest.mark.parametrize("preset", ["trot-robust", "gallop-robust"])
def test_robust_presets_draw_table_1_and_feet_of_any_stiffness(preset):
    config: TrainConfig = load_train_config(preset)
    stiffness = {"contact_stiffness": (3000.0, 30000.0)}
    assert config.task.randomize == load_ranges("table1") | stiffness


def test_threads_of_torch_wait_asleep() -> None:
    words = [sys.executable, "-c", "import surefoot.learn.trainer"]
    # OpenMP prints its settings when it is loaded.
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    environment["OMP_DISPLAY_ENV"] = "true"
    printed = subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stderr
    assert re.findall(r"OMP_WAIT_POLICY\s*=\s*'(\w+)'", printed) == ["PASSIVE"]
