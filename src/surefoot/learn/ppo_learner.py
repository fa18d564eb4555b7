"""PPO learner: rollouts, updates, export, and the state for an exact resume."""

from __future__ import annotations

import copy
import gc
import math
import time
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from surefoot.errors import SurefootError
from surefoot.learn.checkpoint_state import check_finite, check_like, check_optimizer
from surefoot.learn.config import TrainConfig
from surefoot.learn.networks import load_parameters, make_algorithm
from surefoot.learn.rollout_statistics import RolloutStatistics, UpdateMetrics
from surefoot.policy.export import export_policy
from surefoot.task.contract_mapping import make_contract
from surefoot.task.env import LocomotionEnv, SimulationFactory


class PpoLearner:
    """PPO on a batch of simulated robots.

    Args:
        config: configuration of the run.
        make_world: factory of the simulation.
    """

    def __init__(self, config: TrainConfig, make_world: SimulationFactory) -> None:
        self.config = config
        torch.manual_seed(config.seed)
        self.env = LocomotionEnv(config.task, config.num_envs, make_world, config.seed, threads=config.threads)
        observation, _ = self.env.reset()
        self.observation = self._tensors(observation)
        self.algorithm = make_algorithm(config, self.env, self.observation)
        self.update_count = 0
        # Exclude the many permanent objects of imported packages from garbage collection.
        gc.freeze()

    @property
    def steps(self) -> int:
        """Control steps so far, of all robots together."""
        return self.update_count * self.config.samples_per_update

    @property
    def policy(self) -> MLPModel:
        """The policy network."""
        return self.algorithm.get_policy()

    def _tensors(self, observation: NDArray[np.float32]) -> TensorDict:
        groups = {"policy": torch.from_numpy(observation)}
        if self.config.ppo.privileged_critic:
            groups["privileged"] = torch.from_numpy(self.env.privileged())
        return TensorDict(groups, batch_size=[self.config.num_envs])

    def update(self) -> UpdateMetrics:
        """Run one rollout and one PPO update, and return their metrics."""
        start = time.perf_counter()
        statistics = self._roll_out()
        rollout_seconds = time.perf_counter() - start
        losses = self._learn()
        self.update_count += 1
        self._limit_std()
        return UpdateMetrics(
            **statistics.summarize(),
            steps=self.steps,
            std_mean=float(self.policy.distribution.log_std_param.detach().exp().mean()),
            learning_rate=self.algorithm.learning_rate,
            value_loss=losses["value"],
            surrogate_loss=losses["surrogate"],
            entropy=losses["entropy"],
            rollout_seconds=rollout_seconds,
            learn_seconds=time.perf_counter() - start - rollout_seconds,
        )

    def _roll_out(self) -> RolloutStatistics:
        """Collect the samples of an update, and compute returns and advantages."""
        env, algorithm, ppo = self.env, self.algorithm, self.config.ppo
        statistics = RolloutStatistics(env)
        # With more threads, torch would spin between small matrix products and take the cores from the physics.
        torch.set_num_threads(1)
        with torch.inference_mode():
            for _ in range(self.config.steps_per_update):
                actions = algorithm.act(self.observation)
                observation, reward, terminated, truncated, info = env.step(actions.numpy())
                self.observation = self._tensors(observation)
                statistics.add(reward, info)
                gain = ppo.reward_scale * (reward - ppo.fall_cost * terminated)
                algorithm.process_env_step(
                    self.observation,
                    torch.from_numpy(gain.astype(np.float32)),
                    torch.from_numpy(terminated | truncated),
                    {"time_outs": torch.from_numpy(truncated.astype(np.float32))},
                )
            algorithm.compute_returns(self.observation)
        return statistics

    def _learn(self) -> dict[str, float]:
        """Update the networks (only the critic in the first `value_updates`), and return the losses by name."""
        is_frozen = self.update_count < self.config.ppo.value_updates
        state = copy.deepcopy(self.policy.state_dict()) if is_frozen else {}  # with the statistics of its normalizer
        losses: dict[str, float] = self.algorithm.update()
        if is_frozen:
            self.policy.load_state_dict(state)
        return losses

    def _limit_std(self) -> None:
        """Clip the policy's standard deviation to a limit that decreases during the run, if there is one."""
        ppo = self.config.ppo
        if ppo.final_std:
            limit = ppo.init_std + (ppo.final_std - ppo.init_std) * min(self.steps / self.config.steps, 1.0)
            with torch.no_grad():
                self.policy.distribution.log_std_param.clamp_(max=math.log(limit))

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the actions of the deterministic policy (N, A) for observations (N, O * history)."""
        with torch.inference_mode():
            mean: NDArray[np.float32] = self.policy(
                TensorDict({"policy": torch.from_numpy(observation)}, batch_size=[len(observation)])
            ).numpy()
        return mean

    def export(self, path: str | Path, metrics: Mapping[str, Any] | None = None, created: str = "") -> Path:
        """Write the current policy as a policy file; see `make_contract` and `export_policy`."""
        contract = make_contract(self.env, self.config, metrics, created)
        network = nn.Sequential(self.policy.obs_normalizer, self.policy.mlp)
        return export_policy(network, contract, path, robot=self.env.robot.archive)

    def get_state(self) -> dict[str, Any]:
        """Return the state for an exact resume; later updates do not change it."""
        return {
            "algorithm": deepcopy(self.algorithm.save()),
            "learning_rate": self.algorithm.learning_rate,
            "torch": torch.get_rng_state(),
            "env": self.env.get_state(),
            "observation": {key: value.numpy().copy() for key, value in self.observation.items()},
            "update_count": self.update_count,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `get_state`, to continue exactly from there.

        Raises:
            SurefootError: a state of another number of robots, of networks of other shapes, with numbers that are not
                finite, or with another structure.
        """
        num_envs = len(state["observation"]["policy"])
        if num_envs != self.config.num_envs:
            raise SurefootError(f"it has the states of {num_envs} robots; num_envs is {self.config.num_envs}")
        message = "its networks do not fit the configuration"
        load_parameters(self.algorithm, state["algorithm"], {"actor": True, "critic": True}, message)
        self._check_state(state)
        load_parameters(self.algorithm, state["algorithm"], None, message)
        self.algorithm.learning_rate = state["learning_rate"]
        self.env.set_state(state["env"])
        self.observation = TensorDict(
            {key: torch.from_numpy(value) for key, value in state["observation"].items()}, batch_size=[num_envs]
        )
        self.update_count = state["update_count"]
        torch.set_rng_state(state["torch"])

    def _check_state(self, state: dict[str, Any]) -> None:
        """Raise a `SurefootError` if a state can't come from `get_state`. Loaders check the shapes of networks."""
        own = self.get_state()
        algorithm, optimizer = own.pop("algorithm"), "optimizer_state_dict"
        check_like({key: value for key, value in state.items() if key != "algorithm"}, own, "learner")
        check_finite({key: state[key] for key in ("observation", "learning_rate")}, "learner")
        check_finite(state["env"]["history"], "learner.env.history")
        saved = state["algorithm"]
        check_like(dict.fromkeys(saved), dict.fromkeys(algorithm), "learner.algorithm")
        check_finite(saved, "learner.algorithm")
        parameters = [parameter for group in self.algorithm.optimizer.param_groups for parameter in group["params"]]
        where = f"learner.algorithm.{optimizer}"
        check_like(saved[optimizer]["param_groups"], algorithm[optimizer]["param_groups"], f"{where}.param_groups")
        check_optimizer(saved[optimizer]["state"], parameters, f"{where}.state")
