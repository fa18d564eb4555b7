"""Tuning of the balance of a gait over holes: CMA-ES over its gains, on the gaps and stones of the task.

As in `tune`, all candidates of a generation run side by side. Without a network between them and the legs there are
few parameters, and no noise on the feet: over gaps feet must land where the reference has them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Annotated, Any

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import Seed, Threads, Within
from surefoot.errors import SurefootError, choices
from surefoot.evaluation.policy_table import prepare_task
from surefoot.evaluation.rollout import run_to_end
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS
from surefoot.seeding import generator
from surefoot.studies.handcrafted import OpenLoop
from surefoot.task.balance_gains import BalanceConfig, PhaseGains
from surefoot.task.commanded_way import has_kept_up
from surefoot.task.commands import CommandConfig
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.terrain import TerrainConfig
from surefoot.world.interface import SimulationFactory
from surefoot.world.terrain import nearest_size

_FALL_COST = 0.4
"""Cost of a fall; 1 is that of a robot that does not move."""
_OVERRUN = 1.2
"""Way over the commanded one from which more of it costs."""
_POWER_COST = 0.05
"""Cost of the mean power over weight and commanded speed: of a cost of transport of 1."""
_START = 0.92
"""Share of the commanded way that a robot covers that starts from rest."""

HOLES = ("gaps", "stones")
"""Kinds of terrain with holes."""
GAINS = (
    *(f"{phase}.{item.name}" for phase in ("stance", "swing") for item in fields(PhaseGains)),
    *(item.name for item in fields(BalanceConfig) if item.name not in ("stance", "swing")),
)
"""Names of the gains."""


@dataclass(frozen=True)
class BalanceTuneConfig:
    """Settings of a tuning."""

    speed: Annotated[float, Within(0.05, 10)] = 0.5
    """Speed forward that is commanded [m/s]."""
    difficulty: Annotated[float, Within(0, 1)] = 0.7
    """Of gaps and stones as the task has them, 0 to 1."""
    generations: Annotated[int, Within(1, 10_000)] = 20
    """Generations of the search."""
    population: Annotated[int, Within(4, 1000)] = 15
    """Candidates of a generation."""
    robots: Annotated[int, Within(1, 1000)] = 8
    """Robots of each candidate on each kind of terrain."""
    duration: Annotated[float, Within(0.5, 60)] = 5.0
    """Length of an episode [s]."""
    sigma: Annotated[float, Within(0, 1, above=True)] = 0.08
    """First standard deviation of the gains."""
    seed: Seed = 0
    threads: Threads = 0
    """Threads of the simulation; 0 means one a core. The result does not depend on it."""


def gains_vector(gains: BalanceConfig) -> Array:
    """Return gains in the order of `GAINS` (K,)."""
    return np.array(attrgetter(*GAINS)(gains))


def gains_config(values: Array) -> BalanceConfig:
    """Return gains from numbers in the order of `GAINS` (K,), or of N robots (K, N, 1)."""
    named: dict[str, Any] = dict(
        zip(GAINS, values if np.ndim(values) > 1 else np.asarray(values).tolist(), strict=True)
    )
    stance, swing = (
        PhaseGains(**{item.name: named.pop(f"{phase}.{item.name}") for item in fields(PhaseGains)})
        for phase in ("stance", "swing")
    )
    return BalanceConfig(stance=stance, swing=swing, **named)


class BalanceTuner:
    """A tuning; `step` runs a generation, `task` has the gains in the middle of the search.

    Args:
        config: its settings.
        task: with a gait over holes, gaps and stones. Its own gains are where the search begins.
        make_world: makes the simulation.

    Raises:
        SurefootError: a task without a gait over holes, or without gaps and stones.
    """

    def __init__(self, config: BalanceTuneConfig, task: TaskConfig, make_world: SimulationFactory) -> None:
        over_holes = task.reference.over_holes
        self.kinds = {kind: sizes for kind, sizes in task.terrain.sizes.items() if kind in HOLES}
        """Kinds of the task's terrain that have holes."""
        if over_holes is None or not self.kinds:
            raise SurefootError(
                f"task '{task.name}' has {'no' if over_holes is None else 'a'} reference.over_holes and "
                f"{len(self.kinds)} kinds of terrain with holes; balance is tuned for it on {choices(HOLES)}"
            )
        self.config, self.start, self.robot = config, task, RobotDescription.load(task.robot)
        limits = {key: getattr(task.commands, key) for key in COMMANDS}
        commands = CommandConfig(**limits, relative=task.commands.relative, each=((config.speed, 0.0, 0.0),))
        base = prepare_task(task, commands, config.duration, self.robot)
        share = config.difficulty
        self.grounds = {
            kind: f"{kind}:{nearest_size(kind, (1.0 - share) * low + share * high):.4g}"
            for kind, (low, high) in self.kinds.items()
        }
        """The terrain of each kind."""
        seed = int(generator(config.seed, "tune").integers(1, 2**31))
        options = {"popsize": config.population, "seed": seed, "verbose": -9}
        # The import takes seconds; errors of the user come before.
        import cma

        self._search = cma.CMAEvolutionStrategy(gains_vector(over_holes.balance), config.sigma, options)
        count = (config.population + 1) * config.robots
        self._envs = {
            kind: LocomotionEnv(
                replace(base, terrain=TerrainConfig(ground=ground, heading=180.0, scan=task.terrain.scan)),
                count,
                make_world,
                config.seed,
                autoreset=False,
                threads=config.threads,
            )
            for kind, ground in self.grounds.items()
        }
        self.generation = 0

    @property
    def task(self) -> TaskConfig:
        """The task with the gains in the middle of the search."""
        values = np.round(np.clip(np.asarray(self._search.mean, float), -10.0, 10.0), 3)
        reference = self.start.reference
        assert reference.over_holes is not None
        return replace(
            self.start,
            reference=replace(reference, over_holes=replace(reference.over_holes, balance=gains_config(values))),
        )

    def step(self) -> dict[str, float]:
        """Run a generation.

        Returns:
            the `cost` of the middle of the search before it, and for each kind of terrain the share of its robots that
            covered .7 of their way without a fall.
        """
        points = self._search.ask()
        everyone = np.array([*points, self._search.mean])
        gains = np.repeat(np.clip(everyone, -10.0, 10.0), self.config.robots, axis=0).T[..., None]
        costs, kept = [], {}
        for kind, env in self._envs.items():
            cost, up = self._run(env, gains_config(gains))
            costs.append(cost)
            kept[kind] = float(up[-1])
        mean = np.mean(costs, axis=0)
        self._search.tell(points, mean[:-1].tolist())
        self.generation += 1
        return {"cost": float(mean[-1]), **kept}

    def _run(self, env: LocomotionEnv, gains: BalanceConfig) -> tuple[Array, Array]:
        """Return the costs of all candidates (C,), and the shares of their robots that kept up."""
        config, policy = self.config, OpenLoop(len(env.gait.action_names))
        observation, _ = env.reset(seed=config.seed + self.generation)
        assert env.follower is not None
        assert env.follower.balance is not None
        env.follower.balance.gains = gains
        runs = run_to_end(lambda rows: env.gait.action(policy.feedback(rows)), env, observation)
        balanced = runs.balanced.to_numpy()
        way = np.linalg.norm((env.truth.base_position_world - env.start_position)[:, :2], axis=1)
        way = np.nan_to_num(way) / (_START * config.speed * config.duration)
        energy = runs.power.to_numpy() * runs.steps.to_numpy() * env.world.params.control_step
        spent = energy / (self.robot.weight * config.speed * config.duration)
        cost = 1.0 - np.clip(way, 0.0, 1.0) + _FALL_COST * ~balanced
        cost += np.maximum(way - _OVERRUN, 0.0) + _POWER_COST * spent
        kept = has_kept_up(np.ones(len(way)), way, balanced)
        costs, shares = (part.reshape(-1, config.robots).mean(axis=1) for part in (cost, kept.astype(float)))
        return costs, shares
