"""Learning curves: the log of a training as a table, and a figure of groups of trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.report.figures.style import heading, humanize, new_figure
from surefoot.robot.commands import COMMANDS
from surefoot.tables import with_unit

_BINS = 40


def learning_curve(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Convert a training's log to a learning curve, one row per update.

    Returns:
        Columns: `steps` so far; `return` [m], `speed` [m/s] and `falls` [%] of the episodes that ended in the update
        (NaN if none ended); their number `episodes`; for a task with commands also the tracking errors, by name.
    """
    log = pd.DataFrame(rows, columns=["steps", "return_mean", "speed_mean", "falls", "episodes"]).astype(np.float64)
    if rows[0].get("rmse"):
        log = log.join(pd.DataFrame([row["rmse"] for row in rows], dtype=np.float64))
    log["falls"] *= 100 / log.episodes.where(log.episodes > 0)
    return log.rename(columns={"return_mean": "return", "speed_mean": "speed"})


def bin_curve(curve: pd.DataFrame, name: str, edges: ArrayLike) -> Array:
    """Return the means of a column in bins of steps with `edges` (B + 1,), including upper edges; NaN for empty bins.

    Updates are weighted by their number of episodes, because in most updates only falls end an episode, while all
    other episodes end together.
    """
    rows = curve[np.isfinite(curve[name]) & (curve.episodes > 0)]
    bins = pd.cut(rows.steps, np.asarray(edges))
    total, weight = (x.groupby(bins, observed=False).sum() for x in (rows[name] * rows.episodes, rows.episodes))
    return np.asarray(total / weight.where(weight > 0), np.float64)


def learning_curves(groups: Mapping[str, Sequence[pd.DataFrame]], path: str | Path, unit: str = "m") -> Path:
    """Draw the `learning_curve` of trainings by group: mean over the group, with a band from minimum to maximum.

    For tasks with commands, tracking errors are drawn instead of the speed. `unit` is the unit of returns.
    """
    has_commands = all(set(COMMANDS) <= set(curve) for curves in groups.values() for curve in curves)
    errors = [(name, with_unit(f"Error of {humanize(name)}", error_unit)) for name, error_unit in COMMANDS.items()]
    parts = [
        ("return", with_unit("Return of an episode", unit)),
        *(errors if has_commands else [("speed", "Speed (m/s)")]),
        ("falls", "Episodes with a fall (%)"),
    ]
    ends = [max(float(curve.steps.max()) for curve in curves) for curves in groups.values()]
    scale, count = (1e6, "million ") if max(ends) >= 2e5 else (1.0, "")
    with new_figure(path, (11.0 if len(parts) == 3 else 16.0, 3.7), columns=len(parts)) as (figure, axes):
        for ax, (name, title) in zip(axes, parts, strict=True):
            for number, (label, curves) in enumerate(groups.items()):
                # Each group has its own bins, so that each curve ends with its training.
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
        heading(figure, "Training: mean over seeds, band from minimum to maximum")
    return Path(path)
