"""PPO on a batch of robots: rollout, advantages, update, and the state for an exact resume."""

from __future__ import annotations

import gc
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import nn

from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig
from surefoot.learn.symmetry import MirrorSamples
from surefoot.learn.two_gaits import TwoGaits, with_first_gait
from surefoot.policy.export import export_policy
from surefoot.robot.commands import COMMANDS
from surefoot.task.contract_mapping import make_contract
from surefoot.task.env import LocomotionEnv, SimulationFactory
from surefoot.task.gait import HybridGait
from surefoot.task.height_scan import AROUND, MAP
from surefoot.task.observation import OVER_HOLES


@dataclass(frozen=True)
class UpdateFigures:
    """Figures of one update."""

    steps: int
    """Control steps so far, all robots together."""
    episodes: int
    """Episodes that ended since the last update."""
    falls: int
    """Those that ended before their time."""
    return_mean: float
    """Mean return of episodes that ended, unscaled; NaN if none did."""
    speed_mean: float
    """Mean speed of episodes that ended [m/s]; NaN if none did."""
    reward_rate: float
    """Mean reward of a control step, unscaled."""
    std_mean: float
    """Mean standard deviation of the policy's actions."""
    learning_rate: float
    value_loss: float
    surrogate_loss: float
    entropy: float
    divergences: int
    """Robots whose simulation diverged, since the start."""
    rollout_seconds: float
    learn_seconds: float
    reward: dict[str, float]
    """What each term adds to the reward, unscaled and weighted, per second."""
    rmse: dict[str, float] | None = None
    """Root mean square error of each command: mean speed [m/s] or rate [rad/s] over a control step less that which the
    gait follows; None without commands."""
    levels: dict[str, float] | None = None
    """Mean level of the robots on each kind of terrain; None without tiles."""


class PpoLearner:
    """PPO on a batch of robots.

    Args:
        config: the run.
        make_world: makes the simulation.
    """

    def __init__(self, config: TrainConfig, make_world: SimulationFactory) -> None:
        self.config = config
        torch.manual_seed(config.seed)
        self._threads = config.learning_threads or os.cpu_count() or 1
        self.env = LocomotionEnv(config.task, config.num_envs, make_world, config.seed, threads=config.threads)
        observation, _ = self.env.reset()
        self.observation = self._tensors(observation)
        self.algorithm = self._make_algorithm()
        self.update_count = 0
        # The collector would search the many objects of imported packages again and again; they stay anyway.
        gc.freeze()

    @property
    def steps(self) -> int:
        """Control steps so far, all robots together."""
        return self.update_count * self.config.samples_per_update

    @property
    def _has_two_gaits(self) -> bool:
        return self.config.task.reference.over_holes is not None

    @property
    def policy(self) -> MLPModel:
        """The policy network."""
        return self.algorithm.get_policy()

    def _make_algorithm(self) -> PPO:
        ppo, obs = self.config.ppo, self.observation
        groups = {"actor": ["policy"], "critic": ["policy", "privileged"] if ppo.privileged_critic else ["policy"]}
        actions = len(self.env.gait.action_names)
        actor = MLPModel(
            obs,
            groups,
            "actor",
            actions,
            ppo.policy_hidden,
            ppo.activation,
            obs_normalization=True,
            distribution_cfg={"class_name": "GaussianDistribution", "init_std": ppo.init_std, "std_type": "log"},
        )
        critic = MLPModel(obs, groups, "critic", 1, ppo.value_hidden, ppo.activation, obs_normalization=True)
        # The first policy acts near the middle of the bounds for any observation.
        with torch.no_grad():
            actor.mlp[-1].weight.mul_(0.1)
        if self._has_two_gaits:
            first = MLP(actor.obs_dim, actions, ppo.policy_hidden, ppo.activation)
            # Inputs are normalized as the first network knows them; its normalizer divides new ones by 1 + eps.
            normalizer = actor.obs_normalizer
            normalizer.until = 0
            actor.mlp = TwoGaits(
                first, actor.mlp, self.env.observer.columns.index(OVER_HOLES), 1.0 / (1.0 + normalizer.eps)
            )
        storage = RolloutStorage("rl", self.config.num_envs, self.config.steps_per_update, obs, [actions], "cpu")
        symmetry = None
        if ppo.symmetry:
            mirror = MirrorSamples(self.env)
            symmetry = {"env": self.env, "data_augmentation_func": mirror, "use_data_augmentation": True}
        algorithm = PPO(
            actor,
            critic,
            storage,
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
            symmetry_cfg=symmetry,
        )
        if algorithm.symmetry is not None:
            # rsl_rl would run the policy once more on each minibatch, for a figure that nobody reads.
            algorithm.symmetry.compute_loss = lambda *_: torch.zeros(())
        algorithm.train_mode()
        return algorithm

    def _tensors(self, observation: NDArray[np.float32]) -> TensorDict:
        groups = {"policy": torch.from_numpy(observation)}
        if self.config.ppo.privileged_critic:
            groups["privileged"] = torch.from_numpy(self.env.privileged())
        return TensorDict(groups, batch_size=[self.config.num_envs])

    def update(self) -> UpdateFigures:
        """Run one rollout and one update of the policy."""
        env, algorithm, config = self.env, self.algorithm, self.config
        start = time.perf_counter()
        # Threads of torch that spin between small products would take the cores from the physics.
        torch.set_num_threads(1)
        rewards, seconds, squares = 0.0, 0.0, np.zeros(3)
        terms = dict.fromkeys(config.task.reward, 0.0)
        episodes: list[NDArray[np.float64]] = [np.zeros((4, 0))]
        with torch.inference_mode():
            for _ in range(config.steps_per_update):
                actions = algorithm.act(self.observation)
                observation, reward, terminated, truncated, info = env.step(actions.numpy())
                gain = config.ppo.reward_scale * (reward - config.ppo.fall_cost * terminated)
                self.observation = self._tensors(observation)
                rewards += float(reward.mean())
                seconds += float(env.world.params.control_step.mean())
                for name, part in env.state.reward_terms.items():
                    terms[name] += float(part.mean())
                if config.task.commands.enabled:
                    squares += (env.state.command_error**2).mean(axis=0)
                if "figures" in info:
                    figures, rows = info["figures"], info["_figures"]
                    columns = [figures[key][rows] for key in ("return", "steps", "distance", "duration")]
                    episodes.append(np.array(columns))
                algorithm.process_env_step(
                    self.observation,
                    torch.from_numpy(gain.astype(np.float32)),
                    torch.from_numpy(terminated | truncated),
                    {"time_outs": torch.from_numpy(truncated.astype(np.float32))},
                )
            algorithm.compute_returns(self.observation)
        rollout_seconds = time.perf_counter() - start
        torch.set_num_threads(self._threads)
        parameters = list(self.policy.parameters()) if self.update_count < config.ppo.value_updates else []
        held = [one.detach().clone() for one in parameters]
        losses = algorithm.update()
        with torch.no_grad():
            for parameter, value in zip(parameters, held, strict=True):
                parameter.copy_(value)
        self.update_count += 1
        self._limit_std()
        returns, lengths, distances, durations = np.concatenate(episodes, axis=1)
        return UpdateFigures(
            steps=self.steps,
            episodes=len(returns),
            falls=int(np.sum(lengths < config.task.max_steps)),
            return_mean=float(np.mean(returns)) if len(returns) else float("nan"),
            speed_mean=float(np.mean(distances / durations)) if len(returns) else float("nan"),
            reward_rate=rewards / config.steps_per_update,
            std_mean=float(self.policy.output_std.detach().mean()),
            learning_rate=algorithm.learning_rate,
            value_loss=losses["value"],
            surrogate_loss=losses["surrogate"],
            entropy=losses["entropy"],
            divergences=env.world.divergences,
            rollout_seconds=rollout_seconds,
            learn_seconds=time.perf_counter() - start - rollout_seconds,
            reward={name: total / seconds for name, total in terms.items()},
            rmse=None
            if not config.task.commands.enabled
            else dict(zip(COMMANDS, map(float, np.sqrt(squares / config.steps_per_update)), strict=True)),
            levels=env.metrics().get("levels"),
        )

    def _limit_std(self) -> None:
        """Keep the exploration under a limit that falls during the run, if the configuration has one."""
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

    def export(self, path: str | Path, figures: Mapping[str, Any] | None = None, created: str = "") -> Path:
        """Write the present policy as a policy file; see `make_contract` and `export_policy`."""
        contract = make_contract(self.env, self.config, figures, created)
        network = nn.Sequential(self.policy.obs_normalizer, self.policy.mlp)
        return export_policy(network, contract, path, robot=self.env.robot.archive)

    def load_networks(self, algorithm: dict[str, Any], other: LocomotionEnv, best_actor: Mapping[str, Any]) -> None:
        """Load only the networks of another run's state, so that actions stay what they were.

        Args:
            algorithm: its part of the state.
            other: its environment. Inputs are matched by the names of observations and their age in control steps. New
                ones get weights of 0, and the normalization of an input of that name, where one is known. What only
                the value network observes may be missing. Bounds of the feedback may differ: the output is scaled.
            best_actor: its policy that was evaluated best, if any: where this run alone has a gait over holes, that
                one is the first gait, as it does not learn any more.

        Raises:
            SurefootError: networks of other layers or actions, or an observation that is not made any more.
        """
        own, former = _policy_inputs(self.env), _policy_inputs(other)
        for age, name in former:
            if (age, name) not in own:
                raise SurefootError(
                    f"start_from: the other run's policy observes {name}, {age} control steps old, which this run's "
                    "does not; keep its observations and history, and add to them"
                )
        inputs = {"actor": (own, former), "critic": (own, former)}
        if self.config.ppo.privileged_critic:
            true = [[(_TRUE, name) for name in env.privileged_columns] for env in (self.env, other)]
            inputs["critic"] = (own + true[0], former + true[1])
        networks, critic = self.algorithm.save(), algorithm["critic_state_dict"]
        adds_gait = self._has_two_gaits and other.task.reference.over_holes is None
        actor = (best_actor if adds_gait else {}) or algorithm["actor_state_dict"]
        if other.gait.action_names == self.env.gait.action_names:
            actor = _scale_output(actor, other.gait, self.env.gait)
        if adds_gait:
            actor = with_first_gait(networks["actor_state_dict"], actor)
        algorithm = {**algorithm, "actor_state_dict": actor}
        for network, (new, old) in inputs.items():
            key = f"{network}_state_dict"
            moved = _move_inputs(algorithm[key], networks[key], new, old, critic, inputs["critic"][1])
            algorithm = {**algorithm, key: moved}
        try:
            self.algorithm.load(algorithm, {"actor": True, "critic": True}, strict=True)
        except RuntimeError as error:
            raise SurefootError(
                f"start_from: the other run's networks do not fit this run: {_first_mismatch(error)}"
            ) from None
        if self.config.ppo.start_std:
            with torch.no_grad():
                self.policy.distribution.log_std_param.fill_(math.log(self.config.ppo.start_std))

    def get_state(self) -> dict[str, Any]:
        """Return the state for an exact resume."""
        return {
            "algorithm": self.algorithm.save(),
            "learning_rate": self.algorithm.learning_rate,
            "torch": torch.get_rng_state(),
            "env": self.env.get_state(),
            "observation": {key: value.numpy().copy() for key, value in self.observation.items()},
            "update_count": self.update_count,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`, exactly.

        Raises:
            SurefootError: the state of another number of robots, or of networks of other shapes.
        """
        num_envs = len(state["observation"]["policy"])
        if num_envs != self.config.num_envs:
            raise SurefootError(f"it has the states of {num_envs} robots; num_envs is {self.config.num_envs}")
        try:
            self.algorithm.load(state["algorithm"], None, strict=True)
        except (RuntimeError, ValueError) as error:
            raise SurefootError(f"its networks do not fit the configuration: {_first_mismatch(error)}") from None
        self.algorithm.learning_rate = state["learning_rate"]
        self.env.set_state(state["env"])
        self.observation = TensorDict(
            {key: torch.from_numpy(value) for key, value in state["observation"].items()},
            batch_size=[self.config.num_envs],
        )
        self.update_count = state["update_count"]
        torch.set_rng_state(state["torch"])


def _scale_output(actor: Mapping[str, torch.Tensor], old: HybridGait, new: HybridGait) -> dict[str, torch.Tensor]:
    """Return a policy network whose normalized actions mean the same feedback between other bounds."""
    half, wide = 0.5 * (old.high - old.low), 0.5 * (new.high - new.low)
    scale = np.divide(half, wide, out=np.ones_like(half), where=wide > 0)
    shift = np.divide(old.low + half - new.low - wide, wide, out=np.zeros_like(half), where=wide > 0)
    factor, offset = torch.from_numpy(scale).float(), torch.from_numpy(shift).float()
    last: dict[str, int] = {}
    for name in actor:
        if name.startswith("mlp.") and name.endswith(".weight"):
            network, number, _ = name.rsplit(".", 2)
            last[network] = max(int(number), last.get(network, 0))
    scaled = dict(actor)
    for network, layer in last.items():
        weight, bias = f"{network}.{layer}.weight", f"{network}.{layer}.bias"
        scaled |= {weight: actor[weight] * factor[:, None], bias: actor[bias] * factor + offset}
    return scaled


_Input = tuple[int, str]
"""Age [control steps] and name of a number that a network sees."""
_TRUE = -1
"""Age of what only the value network sees."""


def _policy_inputs(env: LocomotionEnv) -> list[_Input]:
    return [(age, name) for age in range(env.task.history) for name in env.observer.columns]


def _move_inputs(
    network: Mapping[str, torch.Tensor],
    fresh: Mapping[str, torch.Tensor],
    new: Sequence[_Input],
    old: Sequence[_Input],
    critic: Mapping[str, torch.Tensor],
    seen: Sequence[_Input],
) -> dict[str, torch.Tensor]:
    """Return a network's parameters for other inputs; unchanged, where its layers are others anyway.

    Args:
        network: its parameters.
        fresh: those of a network with the new inputs.
        new: the inputs.
        old: its inputs until now.
        critic: parameters of the old value network, which normalizes more inputs.
        seen: the inputs of that.
    """
    places = {one: k for k, one in enumerate(old)}
    named = {name: k for k, (_, name) in enumerate(seen)} if critic["mlp.0.weight"].shape[1] == len(seen) else {}
    kept = [k for k, one in enumerate(new) if one in places]
    taken = [places[new[k]] for k in kept]
    near = MAP.nearest(AROUND)
    alike = {k: name if name in named else near.get(name, name) for k, (_, name) in enumerate(new)}
    normalized = [k for k, name in alike.items() if name in named]
    shared = [named[alike[k]] for k in normalized]
    moved = dict(network)
    for key, start in fresh.items():
        normalizes = key.startswith("obs_normalizer") and start.dim() == 2
        if not (normalizes or key.endswith(".0.weight")) or network[key].shape != (len(start), len(old)):
            continue
        moved[key] = start.clone() if normalizes else torch.zeros_like(start)
        if normalizes:
            moved[key][:, normalized] = critic[key][:, shared]
        moved[key][:, kept] = network[key][:, taken]
    return moved


def _first_mismatch(error: Exception) -> str:
    """Return the first parameter that does not fit, from torch's message, which has a line for each."""
    lines = str(error).split("\n")
    return " ".join(lines[min(1, len(lines) - 1)].split())
