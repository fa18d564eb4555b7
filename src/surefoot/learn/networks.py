"""The networks of a run, and the PPO of rsl_rl that trains them."""

from __future__ import annotations

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
from surefoot.learn.symmetry import MirrorAugmentation
from surefoot.robot.mirror import is_symmetric
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv

FIRST_OUTPUT_SCALE = 0.1
"""Factor of the last layer's first weights: the first policy acts near the middle of the bounds for any observation."""


class Architecture(Protocol):
    """Structure of the policy network of some tasks, made of the single MLP that rsl_rl builds."""

    setting: str
    """Setting of a task that requires it, for messages."""

    def applies_to(self, task: TaskConfig) -> bool:
        """Return whether a task's policy has it."""

    def build(self, actor: MLPModel, columns: Sequence[str], make_mlp: Callable[[], nn.Module]) -> None:
        """Change the network of a new actor.

        Args:
            actor: of rsl_rl, with one MLP.
            columns: names of the numbers in an observation (O,).
            make_mlp: makes another MLP of the same layers.
        """

    def adopt(self, fresh: Mapping[str, torch.Tensor], single: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the policy's parameters for a warm start from a policy whose network is a single MLP.

        Args:
            fresh: parameters of a new policy of this architecture.
            single: those of the other policy.
        """


ARCHITECTURES: tuple[Architecture, ...] = (GaitSwitchArchitecture(),)
"""Policy networks other than a single MLP; the first one that serves a task is taken."""


def find_architecture(task: TaskConfig) -> Architecture | None:
    """Return the architecture of a task's policy network; None for a single MLP."""
    return next((one for one in ARCHITECTURES if one.applies_to(task)), None)


def make_algorithm(config: TrainConfig, env: LocomotionEnv, observation: TensorDict) -> PPO:
    """Return PPO with new networks, drawn from torch's stream of random numbers.

    Args:
        config: the run.
        env: its robots.
        observation: a batch of its observations, by group: `policy`, and `privileged` where the critic has that.

    Raises:
        SurefootError: `ppo.symmetry`, and a reference gait that is not its own mirror image. A robot whose sides
            differ learns without mirrored samples.
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
    algorithm = PPO(
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
    )
    if ppo.symmetry and is_symmetric(env.robot):
        algorithm.symmetry = MirrorAugmentation(env)
    algorithm.train_mode()
    return algorithm


def load_parameters(algorithm: PPO, state: dict[str, Any], parts: dict[str, bool] | None, message: str) -> None:
    """Load the state of an algorithm.

    Args:
        algorithm: with networks.
        state: as `algorithm.save` returns it.
        parts: what to load, as rsl_rl has it; None: everything.
        message: first words of the error.

    Raises:
        SurefootError: networks of other shapes, with the first parameter that does not fit.
    """
    try:
        algorithm.load(state, parts, strict=True)
    except (RuntimeError, ValueError) as error:
        # torch's message has a line for each.
        lines = str(error).split("\n")
        raise SurefootError(f"{message}: {' '.join(lines[min(1, len(lines) - 1)].split())}") from None
