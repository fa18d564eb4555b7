"""Measure which pushes a gait survives: the share of episodes that end in a fall, over the force of the pushes.

    python examples/falls_over_force.py trot trot-robust trot-steady

Every push that is due is given (every 1.2 s, for .06 s, in a random direction), all with the same force, on the nominal
robot in MuJoCo. Prints a table and draws pushes.png.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.cli.policies import find_policy, load_policy
from surefoot.evaluate.gap import away_task
from surefoot.evaluate.rollout import run_episodes
from surefoot.report.style import COLORS, MARKERS, new_figure
from surefoot.task.pushes import PushConfig
from surefoot.world.sim_world import SimWorld


@dataclass(frozen=True)
class Command:
    """Count falls over the force of pushes."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="POLICY [POLICY ...]")]
    """Policy files, or names of policies that ship."""
    forces: tuple[float, ...] = (0, 5, 10, 15, 20, 25, 30, 40, 60, 90, 130, 220)
    """Forces [N]."""
    episodes: int = 40
    """Episodes of each."""
    seed: int = 1
    """The one seed."""
    out: Path = Path("pushes.png")
    """The figure."""


def run(command: Command) -> None:
    """Measure, print, draw."""
    print(f"{'policy':<14} " + " ".join(f"{force:>4g} N" for force in command.forces))
    with new_figure(command.out, (6.6, 3.8)) as (figure, (ax,)):
        for number, name in enumerate(command.policies):
            policy, _, task = load_policy(find_policy(name), None)
            falls = []
            for force in command.forces:
                pushes = PushConfig(enabled=True, force=(force, force))
                pushed = replace(away_task(task), pushes=pushes)
                traces = run_episodes(policy, pushed, command.episodes, SimWorld, command.seed)
                falls.append(sum(trace.meta["ended"] != "time" for trace in traces))
            print(f"{name:<14} " + " ".join(f"{fell:>6}" for fell in falls), flush=True)
            shares = [100 * fell / command.episodes for fell in falls]
            ax.plot(command.forces, shares, color=COLORS[number], marker=MARKERS[number], label=name)
        ax.set_xscale("symlog", linthresh=10)
        ax.set_xticks(command.forces, [f"{force:g}" for force in command.forces])
        ax.set_xlabel("force of every push (N)")
        ax.set_ylabel(f"falls in 6 s (% of {command.episodes} episodes)")
        figure.legend(loc="outside lower center", ncols=4)
    print(f"of {command.episodes} episodes each; wrote {command.out}")


if __name__ == "__main__":
    run(tyro.cli(Command))
