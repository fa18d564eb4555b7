"""Evaluation of policies under conditions, shared by `import surefoot` and the commands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.api.policies import Candidate, run_policy
from surefoot.api.results import Evaluation, Policy
from surefoot.configuration import Count, Duration, Seed, Threads, from_mapping
from surefoot.progress import ProgressBar
from surefoot.robot import RobotDescription
from surefoot.world.registry import WORLDS, find_world

if TYPE_CHECKING:
    import pandas as pd

    from surefoot.evaluation.conditions import Condition
    from surefoot.evaluation.sensitivity import Sensitivity
    from surefoot.task.commands import CommandConfig
    from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True)
class _RunArguments:
    """Numbers of a run, with the bounds of the commands' options."""

    episodes: Count = 1
    seed: Seed = 1
    duration: Duration | None = None
    threads: Threads = 0


def check_arguments(**values: Any) -> None:
    """Check episodes, seed, duration [s] and threads of a run, those that are given.

    Raises:
        SurefootError: with the first one that is not a number within its bounds.
    """
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
    from_mapping(_RunArguments, plain)


def run_evaluation(policy: Policy, episodes: int, world: str, seed: int, threads: int = 0) -> Evaluation:
    """Run a policy on its task with a progress bar, and compute its metrics."""
    title = f"{episodes} episodes"
    traces = run_policy(policy.controller, policy.task, episodes, world, seed, threads, policy.name, title)
    return Evaluation.from_traces(traces, policy.robot)


def run_conditions(
    candidates: Sequence[Candidate],
    conditions: Sequence[Condition],
    robot: RobotDescription,
    episodes: int,
    seed: int,
    threads: int = 0,
) -> Iterator[tuple[Candidate, Condition, list[EpisodeTrace]]]:
    """Run every policy under every condition, each with a progress bar; yield the traces.

    Args:
        candidates: policies to run.
        conditions: changes of the policies' tasks.
        robot: robot of the policies.
        episodes: number of episodes per policy and condition.
        seed: seed of robots, commands and pushes, the same for all policies and conditions.
        threads: threads of the simulation; 0: one per core.
    """
    for candidate in candidates:
        name = candidate.name
        for condition in conditions:
            task, title = condition.apply(candidate.task, robot), f"{name}, {condition.name}: {episodes} episodes"
            traces = run_policy(candidate.policy, task, episodes, condition.world, seed, threads, name, title)
            yield candidate, condition, traces


def compare_policies(
    candidates: Sequence[Candidate],
    conditions: Sequence[Condition],
    robot: RobotDescription,
    commands: CommandConfig,
    episodes: int,
    seed: int,
    threads: int = 0,
) -> pd.DataFrame:
    """Return the metrics of policies with the same commands, one row per policy and condition; columns as `COLUMNS`."""
    import pandas as pd

    from surefoot.evaluation.policy_table import measure, with_commands

    commanded = [one._replace(task=with_commands(one.task, commands)) for one in candidates]
    rows = [
        {"policy": one.name, "world": condition.world, "condition": condition.name, **measure(traces, robot.weight)}
        for one, condition, traces in run_conditions(commanded, conditions, robot, episodes, seed, threads)
    ]
    return pd.DataFrame(rows)


def run_test_worlds(
    candidates: Sequence[Candidate], condition: Condition, robot: RobotDescription, **options: Any
) -> list[Sensitivity]:
    """Run policies in the test worlds of a sensitivity analysis around a condition, each with a progress bar.

    For `options` see `run_sensitivity`.
    """
    from surefoot.evaluation.sensitivity import run_sensitivity

    make_world, max_robots, results = find_world(condition.world), WORLDS[condition.world].robots_per_batch, []
    for one in candidates:
        task = condition.apply(one.task, robot)
        with ProgressBar(one.name) as bar:
            result = run_sensitivity(
                one.policy, task, make_world, policy_name=one.name, robots=max_robots, progress=bar.advance, **options
            )
        results.append(result)
    return results
