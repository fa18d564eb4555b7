"""Plots that compare policies and groups: learning curves, and results with confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from surefoot.evaluation.statistics import Interval
from surefoot.report.figures.style import QUIET, capital, heading, new_figure, place_labels, spoken
from surefoot.robot.commands import COMMANDS
from surefoot.studies.comparison import Comparison, bin_curve
from surefoot.tables import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BINS = 40


def learning_curves(groups: Mapping[str, Sequence[pd.DataFrame]], path: str | Path, unit: str = "m") -> Path:
    """Draw the `learning_curve` of trainings by group: mean over a group, band from the least to the greatest.

    Tasks with commands have their errors in place of the speed. `unit` is that of returns.
    """
    steered = all(set(COMMANDS) <= set(curve) for curves in groups.values() for curve in curves)
    errors = [(name, with_unit(f"Error of {spoken(name)}", error_unit)) for name, error_unit in COMMANDS.items()]
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


def group_figure(comparison: Comparison, path: str | Path, names: Sequence[str]) -> Path:
    """Draw the figures in `names` of every group as bars: mean over seeds, its interval of 95 %, each seed as a dot."""
    figures = [figure for figure in comparison.figures if figure.name in names]
    groups = comparison.groups
    with new_figure(path, (3.4 * len(figures), 1.5 + 0.55 * len(groups)), columns=len(figures)) as (picture, axes):
        for ax, figure in zip(axes, figures, strict=True):
            for row, group in enumerate(groups):
                values = comparison.of_group(group)[figure.name]
                _group_bar(ax, row, comparison.interval(group, figure), values, f"C{row}")
            ax.set_title(capital(figure.heading))
            ax.set_ylim(len(groups) - 0.4, -0.6)
            place_labels(
                ax, [comparison.study.label(group) if ax is axes[0] else "" for group in groups], vertical=True
            )
            ax.axvline(0.0, color=QUIET, linewidth=0.8)
            if figure.unit == "%":
                # Room for the dot of a share of 100 %.
                ax.set_xlim(0.0, min(max(ax.get_xlim()[1], 5.0), 103.0))
        heading(picture, "Mean over seeds, 95 % confidence interval, and each seed as a dot")
    return Path(path)


def _group_bar(ax: Axes, row: int, interval: Interval, values: pd.Series, color: str) -> None:
    ax.barh(row, interval.mean, height=0.62, color=color, alpha=0.28, linewidth=0)
    if interval.is_finite:
        half = [[interval.mean - interval.low], [interval.high - interval.mean]]
        ax.errorbar(interval.mean, row, xerr=half, fmt="|", color=color, capsize=4.0, markersize=9.0, linewidth=1.6)
    lane = np.full(len(values), row + 0.2)
    ax.plot(values, lane, "o", color=color, markersize=4.5, markeredgecolor="white", markeredgewidth=0.6, clip_on=False)
