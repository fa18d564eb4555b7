"""Adapters for Stable-Baselines3: `LocomotionEnv` as its vector environment, and its actors as torch modules."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from gymnasium import Wrapper
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import nn

from surefoot.errors import SurefootError
from surefoot.task.env import LocomotionEnv

Indices = int | Iterable[int] | None


class SB3VecEnv(VecEnv):  # type: ignore[misc, unused-ignore]
    """A batch of robots as a vector environment of Stable-Baselines3.

    It differs from Gymnasium in a single flag `done` for terminations and truncations. `infos[i]` contains
    `terminal_observation`, the last observation of an episode; `TimeLimit.truncated`, true if the episode was truncated
    and its value must be bootstrapped; and `episode` with the return `r`, length `l` and wall time `t`.

    Args:
        env: environment with `autoreset`.

    Raises:
        SurefootError: an environment without `autoreset`.
    """

    def __init__(self, env: LocomotionEnv) -> None:
        if not env.autoreset:
            raise SurefootError("autoreset is off; Stable-Baselines3 requires it")
        self.env = env
        self._actions: NDArray[np.float32] = np.zeros(env.action_space.shape or (), np.float32)
        self._start = time.monotonic()
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> NDArray[np.float32]:
        """Reset all robots, with the seed that was set by `seed` since the last reset, if any."""
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Store the actions (N, A) for `step_wait`."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Run one control step."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(cut)} for cut in truncated]
        for i in np.flatnonzero(done):
            metrics = info["figures"]
            infos[i]["terminal_observation"] = info["final_obs"][i]
            infos[i]["episode"] = {
                "r": float(metrics["return"][i]),
                "l": int(metrics["steps"][i]),
                "t": time.monotonic() - self._start,
            }
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Release the environment's resources."""
        self.env.close()

    def _count(self, indices: Indices) -> int:
        return len(list(self._get_indices(indices)))

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the batch, once for each robot in `indices`."""
        return [getattr(self.env, attr_name)] * self._count(indices)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the batch, which is the same for all robots."""
        if self._count(indices) != self.num_envs:
            raise SurefootError(f"{attr_name} belongs to the whole batch; it can't be set for some robots")
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Indices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the batch once; return its result once for each robot in `indices`."""
        return [getattr(self.env, method_name)(*args, **kwargs)] * self._count(indices)

    def env_is_wrapped(self, wrapper_class: type[Wrapper], indices: Indices = None) -> list[bool]:
        """Return False for every robot, since none is wrapped."""
        return [False] * self._count(indices)


class Actor(nn.Module):
    """Deterministic actor of a model with its normalizer, from raw observations (N, O) to actions (N, A).

    Args:
        model: PPO, A2C, SAC, TD3 or DDPG.
        env: environment whose `VecNormalize` normalizes the observations, if it has one; defaults to the model's. A
            model that was loaded from a file has none.

    Raises:
        SurefootError: a model of another kind.
    """

    def __init__(self, model: Any, env: Any = None) -> None:
        super().__init__()
        self.mean: torch.Tensor
        self.scale: torch.Tensor
        self.policy = getattr(model, "policy", None)
        self.is_actor_critic = isinstance(self.policy, ActorCriticPolicy)
        if not self.is_actor_critic and not hasattr(self.policy, "actor"):
            raise SurefootError(
                f"model is a {type(model).__name__}; it must be a torch module, or PPO, A2C, SAC, TD3 or DDPG of "
                "Stable-Baselines3"
            )
        normalizer = model.get_vec_normalize_env()
        if isinstance(env, VecEnv):
            normalizer = unwrap_vec_normalize(env) or normalizer
        self.clip = None
        if normalizer is not None and normalizer.norm_obs:
            statistics, self.clip = normalizer.obs_rms, float(normalizer.clip_obs)
            scale = np.sqrt(statistics.var + normalizer.epsilon)
            self.register_buffer("mean", torch.tensor(statistics.mean, dtype=torch.float32))
            self.register_buffer("scale", torch.tensor(scale, dtype=torch.float32))
            self.to(model.device)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the actions (N, A), which may be outside [-1, 1]."""
        policy: Any = self.policy
        if self.clip is not None:
            observation = torch.clamp((observation - self.mean) / self.scale, -self.clip, self.clip)
        if self.is_actor_critic:
            features = policy.extract_features(observation, policy.pi_features_extractor)
            mean: torch.Tensor = policy.action_net(policy.mlp_extractor.forward_actor(features))
            return torch.tanh(mean) if policy.squash_output else mean
        if hasattr(policy.actor, "get_action_dist_params"):
            return torch.tanh(policy.actor.get_action_dist_params(observation)[0])
        action: torch.Tensor = policy.actor(observation)
        return action
