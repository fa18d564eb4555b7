"""Episodes with a progress bar on stderr, so that stdout holds only the result."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from surefoot.evaluate.rollout import Policy, run_episodes
from surefoot.task.config import TaskConfig
from surefoot.task.trace import EpisodeTrace
from surefoot.world.interface import SimulationFactory


def run_with_progress(
    policy: Policy,
    task: TaskConfig,
    episodes: int,
    make_world: SimulationFactory,
    seed: int,
    threads: int = 0,
    *,
    world_name: str = "mujoco",
    policy_name: str = "",
    what: str = "",
) -> list[EpisodeTrace]:
    """Run `run_episodes` with a bar of control steps and running robots; `what` is its label."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} control steps"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        before = f"{what}: " if what else ""
        row = bar.add_task(f"{before}{episodes} running", total=task.max_steps)

        def show(step: int, going: int) -> None:
            if step % 20 == 0 or not going:
                bar.update(row, completed=step, description=f"{before}{going} running")

        return run_episodes(
            policy,
            task,
            episodes,
            make_world,
            seed,
            threads,
            show,
            world_name=world_name,
            policy_name=policy_name,
        )
