"""The parallel update of PPO against rsl_rl's own, on the samples of the same rollout."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.extensions import Symmetry
from tensordict import TensorDict

from surefoot.learn.config import load_train_config
from surefoot.learn.parallel_ppo import ParallelPPO
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.world.sim_world import SimWorld


def make_learner(symmetry: bool, threads: int = 1, **ppo: Any) -> PpoLearner:
    """Return a learner of steering with six robots, and minibatches of eight samples."""
    preset = load_train_config("steer", "go2")
    changed = replace(preset.ppo, symmetry=symmetry, epochs=2, minibatches=3, entropy_coefficient=0.01, **ppo)
    config = replace(preset, num_envs=6, steps_per_update=4, threads=1, learning_threads=threads, ppo=changed)
    return PpoLearner(config, SimWorld)


def reference_update(algorithm: ParallelPPO, mirrored: bool) -> tuple[PPO, dict[str, float]]:
    """Return rsl_rl's PPO after an update from the same state, and its losses."""
    pool, algorithm._pool = algorithm._pool, None  # a pool can't be copied
    copy = deepcopy(algorithm)
    algorithm._pool = pool
    if mirrored:
        mirror = copy.mirror
        assert mirror is not None

        def augment(env: Any, obs: TensorDict | None, actions: torch.Tensor | None) -> tuple[Any, Any]:
            if obs is not None:
                images = {"policy": mirror.mirror("policy", obs["policy"]), "privileged": obs["privileged"]}
                both = {key: torch.cat([obs[key], image]) for key, image in images.items()}
                obs = TensorDict(both, batch_size=[2 * obs.batch_size[0]])
            if actions is not None:
                actions = torch.cat([actions, mirror.mirror("actions", actions)])
            return obs, actions

        copy.symmetry = Symmetry(None, augment, use_data_augmentation=True)
    divergence = copy.actor.get_kl_divergence

    def without_rounding(*parameters: Any) -> torch.Tensor:
        """Return divergences, without the rounding by whose sign rsl_rl may change the rate before the first step."""
        kl = divergence(*parameters)
        return kl if kl.mean() > 1e-6 else torch.zeros_like(kl)

    copy.actor.get_kl_divergence = without_rounding
    return copy, PPO.update(copy)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("symmetry", [False, True])
@pytest.mark.parametrize("desired_kl", [0.02, 1e-7])
def test_an_update_is_that_of_rsl_rl(threads: int, symmetry: bool, desired_kl: float) -> None:
    learner = make_learner(symmetry, threads, desired_kl=desired_kl)
    algorithm = learner.algorithm
    assert (algorithm.mirror is not None) is symmetry
    learner.update()  # normalizers and optimizer have a past
    for _ in range(2):
        learner._roll_out()
        random = torch.get_rng_state()
        policy, losses = reference_update(algorithm, mirrored=symmetry)
        torch.set_rng_state(random)
        critic, value_losses = reference_update(algorithm, mirrored=False)
        torch.set_rng_state(random)
        found = algorithm.update()
        for key in ("surrogate", "entropy"):
            assert found[key] == pytest.approx(losses[key], abs=1e-5)
        if not symmetry:  # both have one learning rate, which follows the policy
            assert found["value"] == pytest.approx(value_losses["value"], rel=1e-4)
        assert algorithm.learning_rate == pytest.approx(policy.learning_rate)
        pairs = [("actor", policy)] if symmetry else [("actor", policy), ("critic", critic)]
        for name, expected in pairs:
            for one, other in zip(
                getattr(algorithm, name).parameters(), getattr(expected, name).parameters(), strict=True
            ):
                torch.testing.assert_close(one, other, atol=2e-5, rtol=1e-3)
        pairs = [("critic", critic)] if symmetry else [("actor", policy), ("critic", critic)]
        for name, expected in pairs:  # a symmetric policy's normalizer learns from mirror images too
            for one, other in zip(getattr(algorithm, name).buffers(), getattr(expected, name).buffers(), strict=True):
                torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)
    assert algorithm.learning_rate != learner.config.ppo.learning_rate


def test_returns_of_a_rollout_are_those_of_its_rewards(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = make_learner(True)
    algorithm, store = learner.algorithm, learner.algorithm.storage
    learner.env.task = replace(learner.env.task, max_steps=3)  # episodes end by time within the rollout
    steps: list[tuple[torch.Tensor, ...]] = []
    process = ParallelPPO.process_env_step

    def record(own: ParallelPPO, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: Any) -> None:
        extras["time_outs"][::2] = 0.0  # every other robot has fallen instead
        steps.append((rewards.clone(), dones.clone(), extras["time_outs"].clone()))
        process(own, obs, rewards, dones, extras)

    monkeypatch.setattr(ParallelPPO, "process_env_step", record)
    learner._roll_out()
    rewards, dones, time_outs = (torch.stack(parts) for parts in zip(*steps, strict=True))
    assert dones[:, ::2].any()
    assert torch.equal(time_outs.bool()[:, 1::2], dones[:, 1::2])
    with torch.no_grad():
        values = torch.stack([algorithm.critic(store.observations[k])[:, 0] for k in range(4)])
        following = algorithm.critic(learner.observation)[:, 0]
        algorithm.actor(store.observations.flatten(0, 1), stochastic_output=True)
        density = algorithm.actor.get_output_log_prob(store.actions.flatten(0, 1))
    advantage = torch.zeros(6)
    for k in reversed(range(4)):
        # rsl_rl continues an episode that ended by its time with the value of its last observation.
        reward = rewards[k] + algorithm.gamma * values[k] * time_outs[k]
        goes_on = 1.0 - dones[k].float()
        error = reward + algorithm.gamma * goes_on * following - values[k]
        advantage = error + algorithm.gamma * algorithm.lam * goes_on * advantage
        following = values[k]
        torch.testing.assert_close(store.returns[k, :, 0], advantage + values[k], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(store.actions_log_prob.flatten(), density, atol=1e-5, rtol=1e-5)
    spread = (store.actions - store.distribution_params[0]) / learner.config.ppo.init_std
    assert 0.8 < spread.std() < 1.2


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    parameters = []
    for threads in (1, 2):
        learner = make_learner(True, threads)
        for _ in range(3):
            learner.update()
        parameters.append([*learner.algorithm.actor.parameters(), *learner.algorithm.critic.parameters()])
    for one, two in zip(*parameters, strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize(("is_symmetric", "policy_samples"), [(True, 8), (False, 16)])
def test_a_minibatch_runs_mirror_images_only_through_a_policy_that_is_not_symmetric(
    is_symmetric: bool, policy_samples: int
) -> None:
    learner = make_learner(True)
    assert learner.algorithm.policy_symmetry is not None
    if not is_symmetric:
        learner.algorithm.load(make_learner(False).algorithm.save(), None, strict=True)
    assert (learner.algorithm.policy_symmetry is not None) is is_symmetric
    passes: dict[str, list[int]] = {"actor": [], "critic": []}
    for name, sizes in passes.items():
        network = getattr(learner.algorithm, name).mlp
        network.register_forward_hook(lambda _, inputs, __, sizes=sizes: sizes.append(len(inputs[0])))
    learner.update()
    # 4 steps of 6 robots: 24 samples in three minibatches, for two epochs. The critic runs once after the rollout.
    assert passes["actor"] == [6] * 4 + [policy_samples] * 6
    assert passes["critic"] == [24, 6] + [8] * 6


def test_an_interrupted_update_does_not_leave_the_critic_waiting() -> None:
    learner = make_learner(False, 2)
    learner._roll_out()
    calls = iter([None, KeyboardInterrupt()])

    def interrupt(*_: Any) -> None:
        if error := next(calls):
            raise error

    learner.algorithm.actor.mlp.register_forward_hook(interrupt)
    with pytest.raises(KeyboardInterrupt):
        learner.algorithm.update()
    pool = learner.algorithm._pool
    assert pool is not None
    assert pool.submit(lambda: True).result(timeout=10)


def test_moments_that_are_not_in_order_in_memory_are_loaded_as_numbers_in_order() -> None:
    learner, other = make_learner(True), make_learner(True)
    learner.update()
    state = learner.get_state()
    for moments in state["algorithm"]["optimizer_state_dict"]["state"].values():
        for name in ("exp_avg", "exp_avg_sq"):
            moments[name] = moments[name].T.contiguous().T if moments[name].dim() == 2 else moments[name]
    loaded = state["algorithm"]["optimizer_state_dict"]["state"].values()
    assert not all(moments["exp_avg"].is_contiguous() for moments in loaded)
    learner.update()
    other.set_state(state)
    assert all(value.is_contiguous() for one in other.algorithm.optimizer.state.values() for value in one.values())
    other.update()
    for one, two in zip(learner.algorithm.actor.parameters(), other.algorithm.actor.parameters(), strict=True):
        assert torch.equal(one, two)


def test_a_loaded_state_continues_like_the_saved_one() -> None:
    learner = make_learner(True, 2)
    learner.update()
    state = learner.get_state()
    later = [learner.update().value_loss for _ in range(2)]
    other = make_learner(True, 1)
    other.set_state(state)
    assert [other.update().value_loss for _ in range(2)] == later
    values = [learner.algorithm.critic.state_dict(), other.algorithm.critic.state_dict()]
    assert all(
        torch.equal(*pair) for one, two in pairwise(values) for pair in zip(one.values(), two.values(), strict=True)
    )
