"""Tracking errors over minutes of training, with and without randomization, with and without a reference gait.

    python benchmarks/velocity_curves.py results/steer/learning.csv

Reads the output of `velocity_tracking.py --every MINUTES --out FILE`, draws the curves next to it (.png), and prints
the minutes of training after which all three errors were first below given limits (-: never). For two groups of runs it
also prints the ratio of their geometric means, with Welch's 95 % interval over seeds. The resolution of the times is
the interval between two measured points.
"""

from __future__ import annotations

import math
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro

from surefoot.arrays import Array
from surefoot.evaluation.statistics import Interval, welch_interval
from surefoot.report.figures.style import COLORS, new_figure
from surefoot.robot.commands import COMMANDS
from surefoot.tables import print_table

LIMITS = {"": ((0.10, 0.08, 0.20), (0.05, 0.04, 0.08)), "_stride": ((0.04, 0.025, 0.02),)}
"""Limits of the forward and sideways [m/s] and yaw rate errors [rad/s], instantaneous and stride-averaged."""
WINDOW = 60.0
"""Training time at the end of a run over which errors are averaged [s]."""
_NAMES = ("forward (m/s)", "sideways (m/s)", "yaw rate (rad/s)")

Run = dict[str, Array]
"""Columns of one run, each (points,)."""


def read_runs(path: Path) -> dict[str, list[Run]]:
    """Return the runs grouped by all settings except the seed."""
    table = pd.read_csv(path, keep_default_na=False, na_values=[""])
    runs: dict[str, list[Run]] = {}
    for (robot, start, ranges, threads), group in table.groupby(["robot", "start", "randomize", "threads"], sort=False):
        parts = (robot, start, *([ranges] if ranges != "none" else []), *(["1 thread"] if threads == 1 else []))
        numbers = group.drop(columns=["robot", "start", "randomize"])
        runs[", ".join(parts)] = [
            {name: one[name].to_numpy(float) for name in one} for _, one in numbers.groupby("seed")
        ]
    return runs


def errors(run: Run, ending: str) -> Array:
    """Return instantaneous (ending "") or stride-averaged ("_stride") errors (points, 3)."""
    return np.stack([run[command + ending] for command in COMMANDS], axis=1)


def first_under(run: Run, ending: str, limit: tuple[float, ...]) -> float:
    """Return the minutes at the first point with all errors below their limits; NaN if there is none."""
    under = (errors(run, ending) < limit).all(axis=1)
    return float(run["seconds"][under.argmax()] / 60) if under.any() else math.nan


def factor(times: list[float], base: list[float]) -> Interval:
    """Return the ratio of geometric mean times, with its interval."""
    interval = welch_interval(np.log(times), np.log(base))
    return Interval(math.exp(interval.mean), math.exp(interval.low), math.exp(interval.high))


def draw(runs: dict[str, list[Run]], path: Path) -> None:
    """Plot the instantaneous errors of every run over minutes."""
    with new_figure(path, (10.0, 3.4), 1, len(_NAMES), sharex=True) as (_, axes):
        for k, (ax, name) in enumerate(zip(axes, _NAMES, strict=True)):
            for color, (start, group) in zip(COLORS, runs.items(), strict=False):
                for number, run in enumerate(group):
                    label = start if number == 0 else None
                    ax.loglog(run["seconds"] / 60, errors(run, "")[:, k], color=color, alpha=0.8, label=label)
            ax.set_title(f"error {name}")
            ax.set_xlabel("training (min)")
            ax.set_xticks(ticks := [0.5, 1, 2, 4, 8, 15, 30, 60], [f"{tick:g}" for tick in ticks])
            ax.set_yticks(ticks := [0.02, 0.05, 0.1, 0.2, 0.5], [f"{tick:g}" for tick in ticks])
            ax.minorticks_off()
        axes[0].legend()


def main(path: Annotated[Path, tyro.conf.Positional] = Path("results/steer/learning.csv")) -> None:
    """Print the tables and draw the figure."""
    runs = read_runs(path)
    table = []
    for ending, limits in LIMITS.items():
        for limit in limits:
            times = {start: [first_under(run, ending, limit) for run in group] for start, group in runs.items()}
            shown = {
                start: ", ".join(f"{time:.1f}" for time in group).replace("nan", "-") for start, group in times.items()
            }
            bounds = " ".join(f"{bound:g}" for bound in limit)
            row = {"errors under": bounds, "of": "strides" if ending else "every step"}
            if len(times) == 2:
                first, second = times.values()
                finite = all(map(math.isfinite, chain(first, second)))
                shown["factor"] = factor(second, first).text(1) if finite else ""
            table.append(row | shown)
    print_table(table, "Minutes of training to errors, for each seed", text_columns=2)
    table = []
    for start, group in runs.items():
        for run in group:
            late = run["seconds"] > run["seconds"][-1] - WINDOW
            means = {
                f"{command}{' over strides' if ending else ''}": f"{mean:.3f}"
                for ending in LIMITS
                for command, mean in zip(COMMANDS, errors(run, ending)[late].mean(axis=0), strict=True)
            }
            whole = {name: f"{run[name][0]:.0f}" for name in ("seed", "episodes")}
            minutes, falls = f"{run['seconds'][-1] / 60:.0f}", f"{run['falls'][late].sum():.0f}"
            table.append({"runs": start, **whole, "minutes": minutes, **means, "falls": falls})
    print_table(table, f"Mean errors of the last {WINDOW / 60:g} minutes of training", text_columns=1)
    draw(runs, path.with_suffix(".png"))


if __name__ == "__main__":
    tyro.cli(main)
