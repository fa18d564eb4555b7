"""Measure the reference gait without feedback: speed and falls in each world.

    python examples/open_loop.py trot

The paper's robot sat down at once with its reference gait alone; see docs/reality-gap.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from surefoot.evaluation.gap import away_task
from surefoot.evaluation.rollout import run_episodes
from surefoot.evaluation.runs import measure_runs
from surefoot.robot import RobotDescription
from surefoot.studies.handcrafted import OpenLoop
from surefoot.task.config import load_task
from surefoot.world.registry import WORLDS, find_world


@dataclass(frozen=True)
class Command:
    """Run a task's reference without feedback."""

    task: Annotated[str, tyro.conf.Positional] = "trot"
    """A preset, or a task's YAML file."""
    worlds: tuple[str, ...] = tuple(WORLDS)
    """Worlds to run in."""
    episodes: int = 20
    """Episodes in each: one on each robot of the ensemble."""
    seed: int = 1
    """The one seed."""


def run(command: Command) -> None:
    """Run and print."""
    task, _ = load_task(command.task)
    robot = RobotDescription.load(task.robot)
    print(f"{'world':<17} speed m/s (least to greatest)   falls   upright after 6 s")
    for world in command.worlds:
        policy = OpenLoop(len(robot.legs))
        traces = run_episodes(policy, away_task(task), command.episodes, find_world(world), command.seed)
        runs = measure_runs(traces)
        speed = f"{runs.speed.mean():.2f} ({runs.speed.min():.2f} to {runs.speed.max():.2f})"
        print(f"{world:<17} {speed:<31} {runs.fell.sum():>5}   {runs.balanced.sum()} of {len(runs)}", flush=True)


if __name__ == "__main__":
    run(tyro.cli(Command))
