"""Evaluations, as `import surefoot` and the commands run them: policies under conditions, measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from surefoot.api.policies import Candidate, run_policy
from surefoot.api.results import Evaluation, Policy
from surefoot.progress import ProgressBar
from surefoot.robot import RobotDescription
from surefoot.world.registry import WORLDS, find_world

if TYPE_CHECKING:
    import pandas as pd

    from surefoot.evaluation.conditions import Condition
    from surefoot.evaluation.sensitivity import Sensitivity
    from surefoot.task.commands import CommandConfig
    from surefoot.task.trace import EpisodeTrace


def run_evaluation(policy: Policy, episodes: int, world: str, seed: int, threads: int = 0) -> Evaluation:
    """Run a policy on its task with a progress bar, and measure it."""
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
    """Run every policy under every condition, each with a progress bar.

    Args:
        candidates: the policies.
        conditions: what differs from the policies' tasks, one condition after the other.
        robot: the policies'.
        episodes: of each policy under each condition.
        seed: of robots, commands and pushes, the same everywhere.
        threads: threads of the simulation; 0: one a core.
    """
    for one in candidates:
        for condition in conditions:
            task, title = condition.apply(one.task, robot), f"{one.name}, {condition.name}: {episodes} episodes"
            yield (
                one,
                condition,
                run_policy(one.policy, task, episodes, condition.world, seed, threads, one.name, title),
            )


def compare_policies(
    candidates: Sequence[Candidate],
    conditions: Sequence[Condition],
    robot: RobotDescription,
    commands: CommandConfig,
    episodes: int,
    seed: int,
    threads: int = 0,
) -> pd.DataFrame:
    """Return the measures of policies that follow the same commands, a row a policy and condition, see `COLUMNS`."""
    import pandas as pd

    from surefoot.evaluation.policy_table import measure, with_commands

    told = [one._replace(task=with_commands(one.task, commands)) for one in candidates]
    rows = [
        {"policy": one.name, "world": condition.world, "condition": condition.name, **measure(traces, robot.weight)}
        for one, condition, traces in run_conditions(told, conditions, robot, episodes, seed, threads)
    ]
    return pd.DataFrame(rows)


def run_test_worlds(
    candidates: Sequence[Candidate], condition: Condition, robot: RobotDescription, **options: Any
) -> list[Sensitivity]:
    """Run policies in test worlds around a condition, each with a progress bar; `options` as `run_sensitivity`."""
    from surefoot.evaluation.sensitivity import run_sensitivity

    make_world, most, results = find_world(condition.world), WORLDS[condition.world].robots_per_batch, []
    for one in candidates:
        task = condition.apply(one.task, robot)
        with ProgressBar(one.name) as bar:
            result = run_sensitivity(
                one.policy, task, make_world, policy_name=one.name, robots=most, progress=bar.advance, **options
            )
        results.append(result)
    return results
