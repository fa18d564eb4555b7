"""Figures of a study: learning curves, and groups side by side."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surefoot.evaluate.comparison import Comparison, Curve, GroupResult
from surefoot.report.style import QUIET, capital, heading, new_figure, place_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BINS = 40


def learning_curves(groups: Mapping[str, Sequence[Curve]], path: str | Path) -> Path:
    """Draw return, speed and falls of trainings: mean over the trainings of a group, from the least to the greatest.

    Args:
        groups: curves of one training or more, by the name of the group.
        path: PNG to write.
    """
    parts = (("returns", "Return of an episode (m)"), ("speed", "Speed (m/s)"), ("falls", "Episodes with a fall (%)"))
    ends = [max(float(curve.steps[-1]) for curve in curves) for curves in groups.values()]
    scale, unit = (1e6, "million ") if max(ends) >= 2e5 else (1.0, "")
    with new_figure(path, (11.0, 3.7), columns=3) as (figure, axes):
        for ax, (name, title) in zip(axes, parts, strict=True):
            for number, (label, curves) in enumerate(groups.items()):
                # Every group its own bins, so that each curve reaches to the end of its training.
                edges = np.linspace(0.0, ends[number], _BINS + 1)
                binned = np.array([curve.binned(name, edges) for curve in curves])
                known = np.isfinite(binned).any(axis=0)
                color, x = f"C{number}", edges[1:][known] / scale
                with warnings.catch_warnings():
                    # A place that no seed has reached is left open.
                    warnings.simplefilter("ignore", RuntimeWarning)
                    mean, low, high = (found(binned[:, known], axis=0) for found in (np.nanmean, np.nanmin, np.nanmax))
                ax.fill_between(x, low, high, color=color, alpha=0.16, linewidth=0)
                ax.plot(x, mean, color=color, label=label)
            ax.set_title(title)
            ax.set_xlabel(f"{unit}control steps")
            ax.set_xlim(0.0, max(ends) / scale)
        axes[2].set_ylim(0.0, max(axes[2].get_ylim()[1], 1.0))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
        heading(figure, "Training: mean over seeds, band from the least to the greatest seed")
    return Path(path)


def group_figure(comparison: Comparison, path: str | Path, names: Sequence[str]) -> Path:
    """Draw figures of every group as bars: mean over seeds, its interval of 95 %, and every seed as a dot.

    Args:
        comparison: the groups.
        path: PNG to write.
        names: figures to draw, a panel each; those that are not in the study are left out.
    """
    figures = [figure for figure in comparison.figures if figure.name in names]
    groups = comparison.groups
    with new_figure(path, (3.4 * len(figures), 1.5 + 0.55 * len(groups)), columns=len(figures)) as (picture, axes):
        for ax, figure in zip(axes, figures, strict=True):
            for row, group in enumerate(groups):
                _bar(ax, row, group, figure.name, f"C{row}")
            ax.set_title(capital(figure.heading))
            ax.set_ylim(len(groups) - 0.4, -0.6)
            place_labels(ax, [group.label if ax is axes[0] else "" for group in groups], vertical=True)
            ax.axvline(0.0, color=QUIET, linewidth=0.8)
            if figure.unit == "%":
                # Student's t knows no bounds; a share does.
                ax.set_xlim(0.0, min(max(ax.get_xlim()[1], 5.0), 103.0))
        heading(picture, "Mean over seeds, 95 % confidence interval, and each seed as a dot")
    return Path(path)


def _bar(ax: Axes, row: int, group: GroupResult, figure: str, color: str) -> None:
    """Draw a group's mean with its interval and its seeds."""
    interval, values = group.interval(figure), group.values(figure)
    ax.barh(row, interval.mean, height=0.62, color=color, alpha=0.28, linewidth=0)
    if interval.known:
        half = [[interval.mean - interval.low], [interval.high - interval.mean]]
        ax.errorbar(interval.mean, row, xerr=half, fmt="|", color=color, capsize=4.0, markersize=9.0, linewidth=1.6)
    lane = np.full(len(values), row + 0.2)
    ax.plot(values, lane, "o", color=color, markersize=4.5, markeredgecolor="white", markeredgewidth=0.6, clip_on=False)
