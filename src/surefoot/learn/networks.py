"""Construction of the networks of a run, and of the rsl_rl PPO that trains them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import nn

from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig
from surefoot.learn.gait_switch import GaitSwitchArchitecture
from surefoot.learn.parallel_ppo import ParallelPPO
from surefoot.learn.symmetry import MirrorSamples
from surefoot.robot.mirror import is_symmetric
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv

FIRST_OUTPUT_SCALE = 0.1
"""Factor on the initial weights of the last layer, so that initial actions are near the middle of the bounds."""


class Architecture(Protocol):
    """Policy network other than a single MLP, for some tasks."""

    setting: str
    """Setting of a task that requires it, for messages."""

    def applies_to(self, task: TaskConfig) -> bool:
        """Return whether a task needs this architecture."""

    def build(self, actor: MLPModel, columns: Sequence[str], make_mlp: Callable[[], nn.Module]) -> None:
        """Build the architecture in a new actor.

        Args:
            actor: actor of rsl_rl with a single MLP; its network is replaced.
            columns: names of the columns of an observation (O,).
            make_mlp: factory of MLPs with the same layers.
        """

    def initial_parameters(
        self, fresh: Mapping[str, torch.Tensor], single: Mapping[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """Return the policy's initial parameters for a warm start from a policy with a single MLP.

        Args:
            fresh: parameters of a new policy with this architecture.
            single: parameters of the other policy.
        """


ARCHITECTURES: tuple[Architecture, ...] = (GaitSwitchArchitecture(),)
"""Architectures other than a single MLP. A task uses the first one that applies."""


def find_architecture(task: TaskConfig) -> Architecture | None:
    """Return the architecture of a task's policy network, or None for a single MLP."""
    return next((one for one in ARCHITECTURES if one.applies_to(task)), None)


def make_algorithm(config: TrainConfig, env: LocomotionEnv, observation: TensorDict) -> ParallelPPO:
    """Return PPO with new networks, initialized with torch's global random generator.

    With `ppo.symmetry`, the policy learns from mirror images too if the robot's sides are mirror images.

    Args:
        config: configuration of the run.
        env: the environment.
        observation: observations of the batch by group: `policy`, and `privileged` for a privileged critic.

    Raises:
        SurefootError: `ppo.symmetry` with a reference gait that is not symmetric.
    """
    ppo, actions = config.ppo, len(env.gait.action_names)
    groups = {"actor": ["policy"], "critic": ["policy", "privileged"] if ppo.privileged_critic else ["policy"]}
    actor = MLPModel(
        observation,
        groups,
        "actor",
        actions,
        ppo.policy_hidden,
        ppo.activation,
        obs_normalization=True,
        distribution_cfg={"class_name": "GaussianDistribution", "init_std": ppo.init_std, "std_type": "log"},
    )
    critic = MLPModel(observation, groups, "critic", 1, ppo.value_hidden, ppo.activation, obs_normalization=True)
    with torch.no_grad():
        actor.mlp[-1].weight.mul_(FIRST_OUTPUT_SCALE)
    if architecture := find_architecture(config.task):
        make_mlp = partial(MLP, actor.obs_dim, actions, ppo.policy_hidden, ppo.activation)
        architecture.build(actor, env.observer.columns, make_mlp)
    algorithm = ParallelPPO(
        actor,
        critic,
        RolloutStorage("rl", config.num_envs, config.steps_per_update, observation, [actions], "cpu"),
        num_learning_epochs=ppo.epochs,
        num_mini_batches=ppo.minibatches,
        clip_param=ppo.clip,
        gamma=ppo.gamma,
        lam=ppo.lam,
        value_loss_coef=ppo.value_coefficient,
        entropy_coef=ppo.entropy_coefficient,
        learning_rate=ppo.learning_rate,
        max_grad_norm=ppo.max_grad_norm,
        schedule=ppo.schedule,
        desired_kl=ppo.desired_kl,
        mirror=MirrorSamples(env) if ppo.symmetry and is_symmetric(env.robot) else None,
        threads=config.learning_threads or os.cpu_count() or 1,
    )
    algorithm.train_mode()
    return algorithm


def load_parameters(algorithm: PPO, state: dict[str, Any], parts: dict[str, bool] | None, message: str) -> None:
    """Load the state of an algorithm.

    Args:
        algorithm: algorithm with its networks.
        state: state from `algorithm.save`.
        parts: parts to load (see rsl_rl), or None for all.
        message: start of the error message.

    Raises:
        SurefootError: networks of other shapes; the message names the first parameter that does not fit.
    """
    try:
        algorithm.load(state, parts, strict=True)
    except (RuntimeError, ValueError) as error:
        # torch's message has one line per parameter.
        lines = str(error).split("\n")
        raise SurefootError(f"{message}: {' '.join(lines[min(1, len(lines) - 1)].split())}") from None
