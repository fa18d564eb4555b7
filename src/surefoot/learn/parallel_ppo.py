"""PPO's update for small networks on few cores: samples are prepared once, and policy and critic learn side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from queue import SimpleQueue
from typing import Any, Self

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.modules import MLP
from tensordict import TensorDict
from torch import nn

from surefoot.learn.normalization import update_normalizer
from surefoot.learn.symmetric_network import PolicySymmetry
from surefoot.learn.symmetry import MirrorSamples

_LEARNING_RATES = (1e-5, 1e-2)
"""Bounds of the adaptive learning rate, as in rsl_rl."""
_LEARNING_RATE_FACTOR = 1.5
"""Change of the learning rate when the divergence leaves half to twice its target, as in rsl_rl."""

_NO_DIVERGENCE = 1e-6
"""Divergence that may come from rounding: in the first minibatch of an update the policy is still the old one."""


@dataclass(frozen=True)
class _Samples:
    """Samples of a rollout, B rows in each field."""

    def shuffle(self, order: torch.Tensor) -> Self:
        """Return the samples in another order (B',)."""
        return type(self)(*(getattr(self, field.name)[order] for field in fields(self)))

    def batches(self, size: int) -> Iterator[Self]:
        """Yield consecutive minibatches, as views."""
        columns = (getattr(self, field.name).split(size) for field in fields(self))
        return (type(self)(*values) for values in zip(*columns, strict=True))


@dataclass(frozen=True)
class _PolicySamples(_Samples):
    """Samples for the policy. M is 2 with mirror images, which follow each sample, and otherwise 1."""

    inputs: torch.Tensor
    """Normalized inputs (B, M, O)."""
    actions: torch.Tensor
    """Actions (B, M, A)."""
    log_prob: torch.Tensor
    """Logarithm of the old policy's density at the actions (B, 1)."""
    advantages: torch.Tensor
    """Advantages (B, 1)."""
    mean: torch.Tensor
    """Means of the old policy (B, A), without mirror images."""
    std: torch.Tensor
    """Standard deviations of the old policy (B, A)."""


@dataclass(frozen=True)
class _ValueSamples(_Samples):
    """Samples for the critic, without mirror images."""

    inputs: torch.Tensor
    """Normalized inputs (B, O)."""
    values: torch.Tensor
    """Values of the old critic (B, 1)."""
    returns: torch.Tensor
    """Returns (B, 1)."""


class ParallelPPO(PPO):
    """PPO of rsl_rl, faster for small networks on a CPU: an update of `steer` takes about a third of the time.

    Policy and critic share neither parameters nor a loss, so they learn on two threads. Each operation uses one thread,
    so results do not depend on the number of cores. Observations are normalized once per update, because the
    normalizers change only after it. With mirror images a new policy is symmetric by its weights, and learns from them
    without running them (`PolicySymmetry`); one that is not, such as an older run's, runs them. The critic learns
    without: twice the samples cost time, and policies were not better.

    Args:
        mirror: mirror images of samples, or None for none.
        threads: threads of the learning; with 1, policy and critic learn one after the other.
        settings: arguments of rsl_rl's PPO. The policy's distribution must be Gaussian, with a standard deviation that
            does not depend on the observation and is learned as its logarithm.
    """

    learning_rate: float

    def __init__(self, *args: Any, mirror: MirrorSamples | None = None, threads: int = 1, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.mirror = mirror
        self._own_symmetry = None
        if mirror is not None and isinstance(self.actor.mlp, MLP):
            self._own_symmetry = PolicySymmetry(self.actor, mirror)
            self._own_symmetry.impose()
        self.policy_symmetry = self._own_symmetry
        """Symmetry of the policy by its weights. Without it, the policy learns from mirror images, if there are any."""
        self._time_outs = torch.zeros_like(self.storage.rewards)
        """Whether an episode ended by its time (T, N, 1)."""
        self._pool = None
        if threads > 1:
            self._pool = ThreadPoolExecutor(1, "critic", initializer=torch.set_num_threads, initargs=(1,))
        # Both threads step their parameters in the one optimizer's state, which checkpoints hold.
        self._optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), self.learning_rate, fused=True),
            "critic": torch.optim.Adam(self.critic.parameters(), self.learning_rate, fused=True),
        }
        self._share_optimizer_state()

    def _share_optimizer_state(self) -> None:
        for optimizer in self._optimizers.values():
            optimizer.state = self.optimizer.state

    def load(self, loaded_dict: dict[str, Any], load_cfg: dict[str, bool] | None, strict: bool) -> bool:
        """Load models and optimizer, see rsl_rl."""
        loaded: bool = super().load(loaded_dict, load_cfg, strict)
        for moments in self.optimizer.state.values():
            # The fused step relies on each moment having its numbers in order in memory, which a file need not.
            moments.update(
                {name: value.clone(memory_format=torch.contiguous_format) for name, value in moments.items()}
            )
        self._share_optimizer_state()
        self.policy_symmetry = None
        if self._own_symmetry is not None:
            self._own_symmetry.mirror_unused_inputs()
            if self._own_symmetry.holds():
                self.policy_symmetry = self._own_symmetry
        return loaded

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions (N, A) and store them with the observations.

        `compute_returns` adds densities and values, at once for the whole rollout.
        """
        store = self.storage
        mean = self.actor.mlp(self.actor.get_latent(obs))
        std = self._log_std().exp()
        if store.distribution_params is None:
            store.distribution_params = (torch.zeros_like(store.actions), torch.zeros_like(store.actions))
        store.observations[store.step].copy_(obs)
        store.distribution_params[0][store.step] = mean
        store.distribution_params[1][store.step] = std
        actions = store.actions[store.step]
        return torch.addcmul(mean, torch.randn_like(mean), std, out=actions)

    def process_env_step(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, torch.Tensor]
    ) -> None:
        """Store the results of a control step: rewards (N,), `dones` (N,), and `time_outs` (N,) in `extras`."""
        store = self.storage
        store.rewards[store.step, :, 0] = rewards
        store.dones[store.step, :, 0] = dones
        self._time_outs[store.step, :, 0] = extras["time_outs"]
        store.step += 1

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute values, densities, returns and advantages of a complete rollout, whose last observation is `obs`."""
        store = self.storage
        store.values.copy_(self.critic(store.observations.flatten(0, 1)).view_as(store.values))
        store.rewards.addcmul_(self._time_outs, store.values, value=self.gamma)  # episodes would have gone on
        assert store.distribution_params is not None
        mean = store.distribution_params[0]
        store.actions_log_prob.copy_(_log_density(store.actions, mean, self._log_std()).unsqueeze(-1))
        super().compute_returns(obs)

    def _log_std(self) -> torch.Tensor:
        """Return the logarithm of the policy's standard deviations (A,)."""
        distribution = self.actor.distribution
        log_std: torch.Tensor = distribution.log_std_param.clamp(*distribution.log_std_range)
        return log_std

    def update(self) -> dict[str, float]:
        """Run the epochs of an update on the stored rollout, and return the mean losses by name."""
        torch.set_num_threads(1)
        store, minibatches = self.storage, self.num_mini_batches
        size = store.num_envs * store.num_transitions_per_env // minibatches
        order = torch.randperm(minibatches * size)
        with torch.no_grad():
            policy, value = self._policy_samples().shuffle(order), self._value_samples().shuffle(order)
        rates: SimpleQueue[float | None] = SimpleQueue()
        pending = self._pool.submit(self._learn_values, value, size, rates) if self._pool else None
        try:
            surrogate, entropy = self._learn_policy(policy, size, rates)
        finally:
            rates.put(None)  # ends the critic's learning, also if the policy's was interrupted
        value_loss = pending.result() if pending else self._learn_values(value, size, rates)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        observations, symmetry = store.observations.flatten(0, 1), self.policy_symmetry
        mirrored = None if symmetry is None else symmetry.observations
        for model, reflection in ((self.actor, mirrored), (self.critic, None)):
            inputs = torch.cat([observations[group] for group in model.obs_groups], -1)
            update_normalizer(model.obs_normalizer, inputs, reflection)
        if symmetry is not None:
            symmetry.remove_rounding()
        store.clear()
        steps = self.num_learning_epochs * minibatches
        return {"value": value_loss / steps, "surrogate": surrogate / steps, "entropy": entropy / steps}

    def _policy_samples(self) -> _PolicySamples:
        store, normalize = self.storage, self.actor.obs_normalizer
        observations, actions = store.observations["policy"].flatten(0, 1), store.actions.flatten(0, 1)
        inputs = [normalize(observations)]
        chosen = [actions]
        if self.mirror is not None and self.policy_symmetry is None:
            inputs.append(normalize(self.mirror.mirror("policy", observations)))
            chosen.append(self.mirror.mirror("actions", actions))
        mean, std = (one.flatten(0, 1) for one in store.distribution_params or ())
        log_prob, advantages = store.actions_log_prob.flatten(0, 1), store.advantages.flatten(0, 1)
        return _PolicySamples(torch.stack(inputs, 1), torch.stack(chosen, 1), log_prob, advantages, mean, std)

    def _value_samples(self) -> _ValueSamples:
        store = self.storage
        inputs = self.critic.get_latent(store.observations.flatten(0, 1))
        return _ValueSamples(inputs, store.values.flatten(0, 1), store.returns.flatten(0, 1))

    def _learn_policy(
        self, samples: _PolicySamples, size: int, rates: SimpleQueue[float | None]
    ) -> tuple[float, float]:
        """Run the policy's epochs and pass on each learning rate; return the sums of losses and of entropies."""
        network, losses, entropies = self.actor.mlp, 0.0, 0.0
        constant = 0.5 * samples.actions.shape[-1] * (1.0 + math.log(2 * math.pi))
        for _ in range(self.num_learning_epochs):
            for batch in samples.batches(size):
                mean = network(batch.inputs.flatten(0, 1)).unflatten(0, batch.inputs.shape[:2])
                log_std = self._log_std()
                if self.schedule == "adaptive":
                    with torch.no_grad():
                        self._adapt_learning_rate(batch, mean[:, 0], torch.exp(-log_std))
                rates.put(self.learning_rate)
                ratio = torch.exp(_log_density(batch.actions, mean, log_std) - batch.log_prob)
                clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
                surrogate = -torch.min(batch.advantages * ratio, batch.advantages * clipped).mean()
                entropy = log_std.sum() + constant
                self._step("actor", surrogate - self.entropy_coef * entropy, self.learning_rate)
                losses += surrogate.item()
                entropies += entropy.item()
        return losses, entropies

    def _adapt_learning_rate(self, batch: _PolicySamples, mean: torch.Tensor, inverse: torch.Tensor) -> None:
        """Adapt the learning rate to the divergence of the old policy from the new one.

        Args:
            batch: samples of the old policy.
            mean: means of the new policy (B, A).
            inverse: inverse of its standard deviations (A,).
        """
        ratio = batch.std * inverse
        distance = ((batch.mean - mean) * inverse).square()
        divergence = float((0.5 * (ratio.square() + distance - 1.0) - ratio.log()).sum(-1).mean())
        if divergence <= _NO_DIVERGENCE:
            return
        if divergence > 2.0 * self.desired_kl:
            self.learning_rate = max(_LEARNING_RATES[0], self.learning_rate / _LEARNING_RATE_FACTOR)
        elif divergence < 0.5 * self.desired_kl:
            self.learning_rate = min(_LEARNING_RATES[1], self.learning_rate * _LEARNING_RATE_FACTOR)

    def _learn_values(self, samples: _ValueSamples, size: int, rates: SimpleQueue[float | None]) -> float:
        """Run the critic's epochs with the learning rates of the policy's steps, and return the sum of losses."""
        losses = 0.0
        for _ in range(self.num_learning_epochs):
            for batch in samples.batches(size):
                if (rate := rates.get()) is None:
                    return losses
                values = self.critic.mlp(batch.inputs)
                clipped = batch.values + (values - batch.values).clamp(-self.clip_param, self.clip_param)
                errors = torch.max((values - batch.returns).square(), (clipped - batch.returns).square())
                loss = errors.mean()
                self._step("critic", self.value_loss_coef * loss, rate)
                losses += loss.item()
        return losses

    def _step(self, name: str, loss: torch.Tensor, rate: float) -> None:
        """Update the parameters of the network `name`."""
        network: nn.Module = getattr(self, name)
        optimizer = self._optimizers[name]
        optimizer.zero_grad()
        loss.backward()
        if name == "actor" and self.policy_symmetry is not None:
            self.policy_symmetry.symmetrize_gradients()
        nn.utils.clip_grad_norm_(network.parameters(), self.max_grad_norm)
        optimizer.param_groups[0]["lr"] = rate
        optimizer.step()


def _log_density(actions: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Return the logarithm of a Gaussian policy's density (...) at actions (..., A)."""
    squares = ((actions - mean) * torch.exp(-log_std)).square().sum(-1)
    return -0.5 * squares - log_std.sum() - 0.5 * len(log_std) * math.log(2 * math.pi)
