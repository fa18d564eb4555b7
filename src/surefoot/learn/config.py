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
"""Where a training logs its scalars; wandb: to both."""
Steps = Annotated[int, Within(1, 10**12)]
"""Control steps of all robots together."""


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimization (Schulman et al. 2017), as rsl_rl has it."""

    policy_hidden: Layers = (185, 95)
    """Hidden layers of the policy network; the paper's for the gallop."""
    value_hidden: Layers = (128, 128)
    """Hidden layers of the value network."""
    activation: Literal["elu", "relu", "tanh", "selu", "swish"] = "elu"
    """Activation of the hidden layers."""
    privileged_critic: bool = True
    """Let the value network see the simulation's true state; it is not needed once training is over."""
    symmetry: bool = False
    """Learn from every sample's mirror image too: for reference gaits that are left-right symmetric. A robot whose
    sides differ by more than 0.5 % of its legs' length learns without, and a note says so."""
    init_std: Annotated[float, Within(0, 100, exclusive=True)] = 0.6
    """Standard deviation of the first policy's normalized actions, which go from -1 to 1."""
    final_std: Annotated[float, Within(0, 100)] = 0.0
    """Greatest standard deviation at the end of the run; the limit falls linearly from init_std. 0: no limit."""
    start_std: Annotated[float, Within(0, 100)] = 0.0
    """Standard deviation of a run's first actions whose networks come from another run; 0: what that one ended with."""
    value_updates: Annotated[int, Within(0, 1_000_000)] = 0
    """First updates in which the value network alone learns: one of another run is wrong where robots see anything new,
    and a policy that follows it forgets what it can do."""
    epochs: Annotated[int, Within(1, 1000)] = 5
    """Passes over the samples of an update."""
    minibatches: Annotated[int, Within(1, 1_000_000)] = 4
    """Parts that a pass is split into."""
    learning_rate: Annotated[float, Within(0, 1, exclusive=True)] = 1e-3
    """Adam's learning rate at the start."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """adaptive: the learning rate follows the Kullback-Leibler divergence of the updates."""
    desired_kl: Annotated[float, Within(0, 100, exclusive=True)] = 0.01
    """Divergence that the adaptive schedule aims at."""
    gamma: Annotated[float, Within(0, 1)] = 0.99
    """Discount factor for a control step."""
    lam: Annotated[float, Within(0, 1)] = 0.95
    """Lambda of the generalized advantage estimate."""
    clip: Annotated[float, Within(0, 100, exclusive=True)] = 0.2
    """Clip range of the probability ratio, and of the value."""
    value_coefficient: Annotated[float, Within(0, 1e6)] = 1.0
    """Weight of the value loss."""
    entropy_coefficient: Annotated[float, Within(0, 1e6)] = 0.003
    """Weight of the entropy bonus."""
    max_grad_norm: Annotated[float, Within(0, 1e6, exclusive=True)] = 1.0
    """Gradients are clipped to this norm."""
    fall_cost: Annotated[float, Within(0, 1e6)] = 0.0
    """Return [m] that a fall takes away in learning, besides what could have come after it; the paper's is 0. Figures
    are reported without it."""
    reward_scale: Annotated[float, Within(0, 1e6, exclusive=True)] = 50.0
    """Rewards are multiplied by this for learning; figures are reported unscaled."""

    def __post_init__(self) -> None:
        """Refuse numbers out of bounds."""
        check_bounds(self, "ppo")
        if self.final_std > self.init_std:
            raise SurefootError(
                f"ppo.final_std is {self.final_std:g}; it must be at most ppo.init_std, {self.init_std:g}"
            )


@dataclass(frozen=True)
class TrainConfig:
    """Configuration of a training run: task and learning."""

    task: TaskConfig = field(default_factory=TaskConfig)
    """Configuration of a task."""
    name: str = "run"
    """Name of the run; its folder carries it."""
    world: str = "mujoco"
    """World to train and evaluate in: mujoco or bullet."""
    seed: Seed = 0
    """The one seed of the run."""
    steps: Steps = 7_000_000
    """Control steps of all robots together; the paper's budget."""
    num_envs: Annotated[int, Within(1, 100_000)] = 128
    """Robots that are simulated side by side."""
    steps_per_update: Annotated[int, Within(1, 100_000)] = 64
    """Control steps of each robot between two updates of the policy."""
    evaluate_every: Steps = 500_000
    """Control steps between two evaluations of the deterministic policy."""
    evaluation_episodes: Annotated[int, Within(1, 10_000)] = 8
    """Episodes of such an evaluation."""
    evaluation_reward: Annotated[dict[str, float], Within(-1e6, 1e6)] = field(default_factory=dict)
    """Weights of reward terms in the returns of evaluations; the task's, if there are none."""
    checkpoint_every: Steps = 1_000_000
    """Control steps between two checkpoints that are kept."""
    threads: Threads = 0
    """Threads of the simulation; 0 means one a core. The result does not depend on it."""
    learning_threads: Threads = 0
    """Threads of the learning; 0 means one a core. Sums are rounded in an order that depends on it: with a number,
    machines with more or fewer cores learn the same."""
    start_from: str | None = None
    """Folder of another run, whose networks as it left them are this run's first ones: the same layers and legs;
    everything else may differ. Observations, matched by name, and history may be added to, which changes no action.
    Where bounds of the feedback differ, it stays what it was. With reference.over_holes, which the other run had not,
    its policy as its file has it stays the one away from holes. With other ranges, pushes or terrain the value network
    gets inputs for them, and loses those of former ones."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learning algorithm."""

    def __post_init__(self) -> None:
        """Refuse values out of bounds."""
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
        """Number of policy updates: the fewest that reach `steps`."""
        return -(-self.steps // self.samples_per_update)


def load_train_config(task: str, robot: str | None = None) -> TrainConfig:
    """Return the training configuration of a task's file: its `train` table over the defaults.

    Args:
        task: as of `load_task`.
        robot: another robot than the file's.

    Raises:
        SurefootError: no such task, or a file that does not fit.
    """
    task_config, train = load_task(task, robot)
    with prefix_errors(f"{task}: train"):
        if not isinstance(train, Mapping):
            raise SurefootError(f"it is {quote(train)}; it must be a table of keys and values")
        data: dict[str, Any] = {"name": task_config.name, **train}
        return from_mapping(TrainConfig, data, base=TrainConfig(task=task_config))
