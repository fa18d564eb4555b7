"""Plots that compare policies and groups: learning curves, results with confidence intervals, and the reality gap."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from surefoot.evaluation.gap import PolicyGap
from surefoot.evaluation.statistics import CONFIDENCE, Interval, MeanEstimate, crossed_interval
from surefoot.report.figures.style import INK, QUIET, capital, heading, new_figure, place_labels, scattered, spoken
from surefoot.robot.commands import COMMANDS
from surefoot.studies.comparison import Comparison, bin_curve
from surefoot.tables import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BINS = 40
_GROUP = 0.8
"""Width of the bars of a policy's returns, where policies are 1 apart."""
_PALE = 0.5
_MAX_DOTS = 100


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


def gap_figure(policies: Sequence[PolicyGap], path: str | Path, unit: str = "m", over_policies: bool = False) -> Path:
    """Draw the return of each policy as bars, a bar a world, with one standard error and every run as a dot.

    Below each policy stands its gap to each other world; over a bar, how many of the runs fell, if any did: they are
    crosses. All policies or groups of policies ran in the same worlds. `unit` is that of returns. With `over_policies`
    the error is the interval over policies and robots, and each dot is a policy's mean.
    """
    names = policies[0].worlds
    width = max(5.2, 1.2 + len(policies) * max(1.6 if len(names) < 3 else 2.3, 0.62 * len(names)))
    with new_figure(path, (width, 3.9 + 0.16 * len(names))) as (_, (ax,)):
        for place, policy in enumerate(policies):
            for number in range(len(names)):
                _return_bar(ax, place, number, len(names), policy, over_policies)
        ax.axhline(0.0, color=QUIET, linewidth=0.8)
        place_labels(ax, [_label(policy, unit) for policy in policies])
        ax.set_xlim(-0.5, len(policies) - 0.5)
        ax.margins(y=0.12)
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.set_title(with_unit("Return of an episode", unit), fontweight="bold", pad=24.0)
        legend = (
            f"bars: mean and interval of {CONFIDENCE:.0%} over policies and robots; dots: policies"
            if over_policies
            else "bars: mean and one standard error; dots: runs, crosses: runs that ended in a fall"
        )
        ax.set_xlabel(legend, color=QUIET, fontsize=8.0, labelpad=6.0)
        for number, name in enumerate(names):
            ax.bar(0, 0, color=f"C{number}", alpha=_PALE, label=name if number else f"{name} (home)")
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2, columnspacing=1.4)
    return Path(path)


def _return_bar(ax: Axes, place: int, number: int, count: int, policy: PolicyGap, over_policies: bool) -> None:
    world = policy.worlds[number]
    runs, wide, color = policy.in_world(world), _GROUP / count, f"C{number}"
    x = place + wide * (number - (count - 1) / 2)
    estimate, measured = MeanEstimate.from_values(runs["return"]), runs[runs["return"].notna()]
    error = estimate.error
    if over_policies:
        table = policy.table(world, "return")
        error = crossed_interval(table).high - estimate.mean
        measured = pd.DataFrame({"return": table.mean(axis=1), "fell": False})
    top, notes = 0.0, []
    if len(measured):
        error = error if math.isfinite(error) else 0.0
        ax.bar(x, estimate.mean, 0.9 * wide, color=color, alpha=_PALE, linewidth=0)
        ax.errorbar(x, estimate.mean, error, color=INK, linewidth=1.3, capsize=4.0, zorder=3)
        if 1 < len(measured) <= _MAX_DOTS:
            across = x + scattered(len(measured), 0.5 * wide)
            for some, marker in ((~measured.fell, "o"), (measured.fell, "x")):
                ax.plot(across[some], measured["return"][some], marker, color=color, markersize=3.6, alpha=0.9)
        top = max(estimate.mean + error, float(measured["return"].max()), 0.0)
    else:
        notes = ["return\nnot known"]
    if runs.fell.any():
        notes.append(f"{runs.fell.sum()} of {len(runs)}\nfell")
    text, offset = "\n".join(notes), (0, 4)
    ax.annotate(text, (x, top), offset, textcoords="offset points", ha="center", va="bottom", fontsize=7.5, color=INK)


def _label(policy: PolicyGap, unit: str) -> str:
    """Return a policy's name, and below it its gap to each other world."""
    away, lines = policy.worlds[1:], []
    for world in away:
        gap = policy.gap(world).mean
        where = f"gap to {world}" if len(away) > 1 else "gap"
        lines.append(f"{where} {gap:+.2f} {unit}".rstrip() if math.isfinite(gap) else f"{where} -")
    return "\n".join([*policy.name.split(", "), *lines])
