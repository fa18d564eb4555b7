"""Learning curves: the log of a training as a table, and curves of groups of trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.report.figures.style import heading, new_figure, humanize
from surefoot.robot.commands import COMMANDS
from surefoot.tables import with_unit

_BINS = 40


def learning_curve(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Return the curve of a training's log, an update a row.

    Returns:
        control steps so far, mean return [m] and speed [m/s] of the episodes that ended, the share that fell [%] (NaN
        where none ended), and how many ended (`episodes`); of a task with commands, their errors by name too.
    """
    log = pd.DataFrame(rows, columns=["steps", "return_mean", "speed_mean", "falls", "episodes"]).astype(np.float64)
    if rows[0].get("rmse"):
        log = log.join(pd.DataFrame([row["rmse"] for row in rows], dtype=np.float64))
    log["falls"] *= 100 / log.episodes.where(log.episodes > 0)
    return log.rename(columns={"return_mean": "return", "speed_mean": "speed"})


def bin_curve(curve: pd.DataFrame, name: str, edges: ArrayLike) -> Array:
    """Return means of a column between steps `edges` (B + 1,), each with its upper end; NaN where no episode ended.

    Each update counts by its episodes: in most updates only the falls end, and all the others end together.
    """
    ended = curve[np.isfinite(curve[name]) & (curve.episodes > 0)]
    bins = pd.cut(ended.steps, np.asarray(edges))
    total, weight = (x.groupby(bins, observed=False).sum() for x in (ended[name] * ended.episodes, ended.episodes))
    return np.asarray(total / weight.where(weight > 0), np.float64)


def learning_curves(groups: Mapping[str, Sequence[pd.DataFrame]], path: str | Path, unit: str = "m") -> Path:
    """Draw the `learning_curve` of trainings by group: mean over a group, band from the least to the greatest.

    Tasks with commands have their errors in place of the speed. `unit` is that of returns.
    """
    steered = all(set(COMMANDS) <= set(curve) for curves in groups.values() for curve in curves)
    errors = [(name, with_unit(f"Error of {humanize(name)}", error_unit)) for name, error_unit in COMMANDS.items()]
    parts = [
        ("return", with_unit("Return of an episode", unit)),
        *(errors if steered else [("speed", "Speed (m/s)")]),
        ("falls", "Episodes with a fall (%)"),
    ]
    ends = [max(float(curve.steps.max()) for curve in curves) for curves in groups.values()]
    scale, count = (1e6, "million ") if max(ends) >= 2e5 else (1.0, "")
    with new_figure(path, (11.0 if len(parts) == 3 else 16.0, 3.7), columns=len(parts)) as (figure, axes):
        for ax, (name, title) in zip(axes, parts, strict=True):
            for number, (label, curves) in enumerate(groups.items()):
                # Every group has its own bins, so that each curve reaches the end of its training.
                edges = np.linspace(0.0, ends[number], _BINS + 1)
                binned = np.array([bin_curve(curve, name, edges) for curve in curves])
                reached = np.isfinite(binned).any(axis=0)
                color, x = f"C{number}", edges[1:][reached] / scale
                mean, low, high = (f(binned[:, reached], axis=0) for f in (np.nanmean, np.nanmin, np.nanmax))
                ax.fill_between(x, low, high, color=color, alpha=0.16, linewidth=0)
                ax.plot(x, mean, color=color, label=label)
            ax.set_title(title)
            ax.set_xlabel(f"{count}control steps")
            ax.set_xlim(0.0, max(ends) / scale)
        axes[-1].set_ylim(0.0, max(axes[-1].get_ylim()[1], 1.0))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
        heading(figure, "Training: mean over seeds, band from the least to the greatest seed")
    return Path(path)
