"""Measure the reference gait without feedback: speed and falls in each world.

    python examples/open_loop.py trot --out results/open_loop.csv

The paper's robot sat down immediately with only its reference gait; see results/open-loop/README.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.evaluation.conditions import data_sheet_task
from surefoot.evaluation.rollout import run_episodes
from surefoot.evaluation.runs import measure_runs
from surefoot.robot import RobotDescription
from surefoot.tables import print_table, write_csv
from surefoot.task.config import load_task
from surefoot.task.handcrafted import OpenLoop
from surefoot.world.registry import WORLDS, find_world


@dataclass(frozen=True)
class Command:
    """Run a task's reference without feedback."""

    task: Annotated[str, tyro.conf.Positional] = "trot"
    """Name of a preset, or a task's YAML file."""
    worlds: tuple[str, ...] = tuple(WORLDS)
    """Worlds to run in."""
    episodes: int = 20
    """Episodes per world; in an ensemble of robots, one per robot."""
    seed: int = 1
    """Seed of all random numbers."""
    out: Path = Path("open_loop.csv")
    """Table to write."""


def run(command: Command) -> None:
    """Run, print and write."""
    task, _ = load_task(command.task)
    robot = RobotDescription.load(task.robot)
    rows = []
    for world in command.worlds:
        policy = OpenLoop(len(task.gait(robot).action_names))
        episodes = len(WORLDS[world].seeds or range(command.episodes))
        runs = measure_runs(run_episodes(policy, data_sheet_task(task), episodes, find_world(world), command.seed))
        speeds = {f"speed_{how}": getattr(runs.speed, how)() for how in ("mean", "min", "max")}
        ends = {"upright": runs.balanced.sum(), "falls": runs.fell.sum(), "episodes": len(runs)}
        rows.append({"world": world, **speeds, **ends})
    print_table([{k: f"{v:.2f}" if isinstance(v, float) else str(v) for k, v in row.items()} for row in rows])
    write_csv(command.out, rows)


if __name__ == "__main__":
    run(tyro.cli(Command))
