"""Configuration of a training run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from surefoot.configuration import Seed, Threads, Within, check_bounds, from_mapping
from surefoot.errors import SurefootError, check_name, prefix_errors, quote
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.reward import check_reward

Layers = tuple[Annotated[int, Within(1, 10_000)], ...]
"""Units of the hidden layers of a network."""
LoggerName = Literal["tensorboard", "wandb"]
"""Logger of a training's scalars; wandb logs to both."""
Steps = Annotated[int, Within(1, 10**12)]
"""Control steps of all robots together."""


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimization (Schulman et al. 2017), as implemented in rsl_rl."""

    policy_hidden: Layers = (185, 95)
    """Hidden layers of the policy network. The default is the paper's network for the gallop."""
    value_hidden: Layers = (128, 128)
    """Hidden layers of the critic (value network)."""
    activation: Literal["elu", "relu", "tanh", "selu", "swish"] = "elu"
    """Activation of the hidden layers."""
    privileged_critic: bool = True
    """The critic also receives privileged observations: the true state of the simulation. Policies do not need it."""
    symmetry: bool = False
    """The policy also learns from the mirror image of each sample, for reference gaits that are left-right symmetric;
    a new policy is symmetric itself. For robots whose sides differ by more than 0.5 % of the leg length, mirrored
    samples are disabled with a note."""
    init_std: Annotated[float, Within(0, 100, exclusive=True)] = 0.6
    """Initial standard deviation of normalized actions (-1 to 1)."""
    final_std: Annotated[float, Within(0, 100)] = 0.0
    """Upper limit of the standard deviation at the end of the run. The limit decreases linearly from init_std. 0: no
    limit."""
    start_std: Annotated[float, Within(0, 100)] = 0.0
    """Initial standard deviation after a warm start (`start_from`); 0: final value of the other run."""
    value_updates: Annotated[int, Within(0, 1_000_000)] = 0
    """Number of initial updates that train only the critic. After a warm start, the other run's critic is wrong in new
    conditions, and a policy that follows it would unlearn."""
    epochs: Annotated[int, Within(1, 1000)] = 5
    """Epochs per update."""
    minibatches: Annotated[int, Within(1, 1_000_000)] = 4
    """Minibatches per epoch."""
    learning_rate: Annotated[float, Within(0, 1, exclusive=True)] = 1e-3
    """Adam's learning rate at the start."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """adaptive: the learning rate is adapted to the Kullback-Leibler divergence of updates."""
    desired_kl: Annotated[float, Within(0, 100, exclusive=True)] = 0.01
    """Target divergence of the adaptive schedule."""
    gamma: Annotated[float, Within(0, 1)] = 0.99
    """Discount factor per control step."""
    lam: Annotated[float, Within(0, 1)] = 0.95
    """Lambda of the generalized advantage estimate."""
    clip: Annotated[float, Within(0, 100, exclusive=True)] = 0.2
    """Clip range of the probability ratio, and of the value."""
    value_coefficient: Annotated[float, Within(0, 1e6)] = 1.0
    """Weight of the value loss."""
    entropy_coefficient: Annotated[float, Within(0, 1e6)] = 0.003
    """Weight of the entropy bonus."""
    max_grad_norm: Annotated[float, Within(0, 1e6, exclusive=True)] = 1.0
    """Maximum norm of gradients."""
    fall_cost: Annotated[float, Within(0, 1e6)] = 0.0
    """Penalty for a fall in learning, in units of the reward, in addition to the lost future reward; 0 in the paper.
    Reported returns do not include it."""
    reward_scale: Annotated[float, Within(0, 1e6, exclusive=True)] = 50.0
    """Factor on rewards in learning. Reported returns are unscaled."""

    def __post_init__(self) -> None:
        """Reject numbers out of bounds."""
        check_bounds(self, "ppo")
        if self.final_std > self.init_std:
            raise SurefootError(
                f"ppo.final_std is {self.final_std:g}; it must be at most ppo.init_std, {self.init_std:g}"
            )


@dataclass(frozen=True)
class TrainConfig:
    """Configuration of a training run: task, budget, evaluations and PPO."""

    task: TaskConfig = field(default_factory=TaskConfig)
    """Configuration of the task."""
    name: str = "run"
    """Name of the run, used in the name of its folder."""
    world: str = "mujoco"
    """World for training and evaluations: mujoco or bullet."""
    seed: Seed = 0
    """Seed of all random numbers of the run."""
    steps: Steps = 7_000_000
    """Control steps of all robots together. The default is the paper's budget."""
    num_envs: Annotated[int, Within(1, 100_000)] = 128
    """Number of robots that are simulated in parallel."""
    steps_per_update: Annotated[int, Within(1, 100_000)] = 64
    """Control steps of each robot between two updates of the policy."""
    evaluate_every: Steps = 500_000
    """Control steps of all robots between two evaluations of the deterministic policy."""
    evaluation_episodes: Annotated[int, Within(1, 10_000)] = 8
    """Episodes per evaluation."""
    evaluation_reward: Annotated[dict[str, float], Within(-1e6, 1e6)] = field(default_factory=dict)
    """Reward weights for the returns of evaluations. Defaults to the task's reward."""
    checkpoint_every: Steps = 1_000_000
    """Control steps of all robots between two permanent checkpoints."""
    threads: Threads = 0
    """Threads of the simulation; 0 means one per core. Results do not depend on it."""
    learning_threads: Threads = 0
    """Threads of the learning, of which at most two are used; 0 means one per core. Results do not depend on it."""
    start_from: str | None = None
    """Warm start: folder of another run, whose final networks initialize this run. Layers and legs must be the same.
    Observations (matched by name) and history may be extended without changing actions, and bounds of the feedback may
    differ, without changing the feedback. If this run adds reference.over_holes, the exported policy of the other run
    remains in use away from holes. If ranges, pushes or terrain differ, the critic gains and loses the corresponding
    inputs."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Parameters of the learning algorithm."""

    def __post_init__(self) -> None:
        """Reject values out of bounds."""
        check_name("name", self.name)
        check_bounds(self)
        if self.evaluation_reward:
            check_reward(self.evaluation_reward, self.task.reward_limits, "evaluation_reward")
        if self.samples_per_update < self.ppo.minibatches:
            raise SurefootError(
                f"num_envs {self.num_envs} x steps_per_update {self.steps_per_update} gives fewer samples than "
                f"ppo.minibatches {self.ppo.minibatches}; each minibatch needs one or more"
            )

    @property
    def samples_per_update(self) -> int:
        """Control steps of all robots between two updates."""
        return self.num_envs * self.steps_per_update

    @property
    def updates(self) -> int:
        """Number of policy updates: the smallest number that reaches `steps`."""
        return -(-self.steps // self.samples_per_update)


def load_train_config(task: str, robot: str | None = None) -> TrainConfig:
    """Load the training configuration of a task file: defaults, updated with the file's `train` table.

    Args:
        task: name or path of the task, see `load_task`.
        robot: robot, see `load_task`. Defaults to the file's robot.

    Raises:
        SurefootError: no such task, or an invalid file.
    """
    task_config, train = load_task(task, robot)
    with prefix_errors(f"{task}: train"):
        if not isinstance(train, Mapping):
            raise SurefootError(f"it is {quote(train)}; it must be a table of keys and values")
        data: dict[str, Any] = {"name": task_config.name, **train}
        return from_mapping(TrainConfig, data, base=TrainConfig(task=task_config))
