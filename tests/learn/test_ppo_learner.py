"""PPO learner: rewards, exploration noise, presets and threads."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch

from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.robot.randomization import load_ranges
from surefoot.world.sim_world import SimWorld


def rewards_of_an_update(fall_cost: float) -> tuple[torch.Tensor, torch.Tensor, PpoLearner]:
    """Return rewards and ends of episodes (T, N) of one update of robots that fall at once, and the learner."""
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
    learner = PpoLearner(config, SimWorld)
    samples: list[tuple[torch.Tensor, torch.Tensor]] = []
    process = learner.algorithm.process_env_step

    def keep(observation: Any, rewards: torch.Tensor, dones: torch.Tensor, extras: Any) -> None:
        samples.append((rewards.clone(), dones.clone()))
        process(observation, rewards, dones, extras)

    learner.algorithm.process_env_step = keep  # type: ignore[method-assign]
    metrics = learner.update()
    assert metrics.falls > 0
    rewards, dones = zip(*samples, strict=True)
    return torch.stack(rewards), torch.stack(dones), learner


def test_a_fall_costs_fall_cost_once_and_no_other_reward_changes():
    rewards, fell, _ = rewards_of_an_update(0.0)
    with_cost, fell_too, learner = rewards_of_an_update(2.5)
    assert torch.equal(fell, fell_too)
    assert 0 < int(fell.sum()) < fell.numel()
    torch.testing.assert_close(with_cost, rewards - 10.0 * 2.5 * fell.float())
    # Metrics do not include the cost.
    assert float(learner.env.state.returns.min()) > -1.0


def test_the_exploration_noise_stays_under_a_decreasing_limit():
    preset = load_train_config("trot")
    config = replace(
        preset,
        num_envs=4,
        steps_per_update=10,
        steps=80,
        threads=1,
        learning_threads=1,
        ppo=replace(preset.ppo, init_std=0.4, final_std=0.1),
    )
    learner = PpoLearner(config, SimWorld)
    for limit in (0.25, 0.1, 0.1):  # half of the run is over after an update of 4 x 10 steps
        learner.update()
        assert float(learner.policy.distribution.log_std_param.detach().exp().max()) <= limit + 1e-6
    assert float(learner.policy.distribution.log_std_param.detach().exp().min()) > 0.08
    with pytest.raises(SurefootError, match=r"ppo.final_std is 0.5; it must be at most ppo.init_std, 0.4"):
        replace(config.ppo, final_std=0.5)


def test_the_critic_learns_before_the_policy():
    preset = load_train_config("trot")
    config = replace(preset, num_envs=4, steps_per_update=10, threads=1, learning_threads=1)
    learner = PpoLearner(replace(config, ppo=replace(preset.ppo, value_updates=2)), SimWorld)
    policies, values = [], []
    for _ in range(4):
        # The statistics of its normalization also change what a policy does.
        parts = [*learner.policy.parameters(), *learner.policy.buffers()]
        policies.append(torch.cat([one.detach().flatten().float().clone() for one in parts]))
        values.append(torch.cat([one.detach().flatten().clone() for one in learner.algorithm.critic.parameters()]))
        learner.update()
    assert [torch.equal(before, after) for before, after in pairwise(policies)] == [True, True, False]
    assert not any(torch.equal(before, after) for before, after in pairwise(values))


def test_a_state_for_resuming_is_not_changed_by_later_updates():
    preset = load_train_config("trot")
    learner = PpoLearner(replace(preset, num_envs=4, steps_per_update=10, threads=1, learning_threads=1), SimWorld)
    state = learner.get_state()
    next_metrics = learner.update()
    learner.update()
    learner.set_state(state)
    again = learner.update()
    assert again.value_loss == next_metrics.value_loss
    assert again.std_mean == next_metrics.std_mean


@pytest.mark.parametrize("preset", ["trot-robust", "gallop-robust"])
def test_robust_presets_randomize_table_1_and_contact_stiffness(preset):
    config: TrainConfig = load_train_config(preset)
    stiffness = {"contact_stiffness": (3000.0, 30000.0)}
    assert config.task.randomize == load_ranges("table1") | stiffness


def test_idle_threads_of_torch_sleep() -> None:
    words = [sys.executable, "-c", "import surefoot.learn.ppo_learner"]
    # OpenMP prints its settings when it is loaded.
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    environment["OMP_DISPLAY_ENV"] = "true"
    printed = subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stderr
    assert re.findall(r"OMP_WAIT_POLICY\s*=\s*'(\w+)'", printed) == ["PASSIVE"]
