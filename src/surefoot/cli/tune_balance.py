"""`surefoot tune-balance`: find the gains of a task's balance on its terrain."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro
import yaml

from surefoot.cli.helpers.options import check_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.files import atomic_write
from surefoot.progress import ProgressBar
from surefoot.studies.handcrafted import task_mapping
from surefoot.studies.tune_balance import BalanceTuneConfig, BalanceTuner
from surefoot.task.config import load_task


@dataclass(frozen=True)
class TuneBalanceCommand(BalanceTuneConfig):
    """Tune the balance of a task's gait over holes on gaps and stones, with CMA-ES and without a policy.

    The file that is written is a task: `surefoot train FILE --start-from RUN` gives a policy its gait over holes.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")] = "terrain-seeing"
    """Task with a gait over holes, gaps and stones: a name, or the path of a YAML file. Its gains are where the
    search begins."""
    robot: str | None = None
    """Name of the robot, or the folder of its description; the task's, if not given."""
    out: Path | None = None
    """File (.yaml) that the task with its gains is written to after every generation; TASK-balance.yaml, if not
    given."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(TuneBalanceCommand, argv, "surefoot tune-balance")
    check_suffix("task", command.out, ".yaml")
    config = BalanceTuneConfig(**{item.name: getattr(command, item.name) for item in fields(BalanceTuneConfig)})
    task, train = load_task(command.task, command.robot)
    from surefoot.world.sim_world import SimWorld

    tuner = BalanceTuner(config, task, SimWorld)
    path = command.out or Path(f"{Path(command.task).stem}-balance.yaml")
    with ProgressBar(f"{config.generations} generations") as bar:
        for generation in range(config.generations):
            shares = tuner.step()
            atomic_write(path, yaml.safe_dump({**task_mapping(tuner.task, path), "train": train}, sort_keys=False))
            bar.advance((generation + 1) / config.generations)
    kept = ", ".join(f"{tuner.grounds[kind]} {share:.2f}" for kind, share in shares.items() if kind != "cost")
    print(f"share of robots that kept up, last generation: {kept}\nwrote {path}")
    return 0
