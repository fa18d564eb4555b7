"""Figure of the reality gap: returns of policies or groups of policies in several worlds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from surefoot.evaluation.gap import PolicyGap
from surefoot.evaluation.statistics import CONFIDENCE, crossed_interval
from surefoot.report.figures.style import INK, QUIET, new_figure, place_labels, spread_dots
from surefoot.tables import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GROUP_WIDTH = 0.8
"""Total width of a policy's bars; policies are at a distance of 1."""
_BAR_ALPHA = 0.5
_MAX_DOTS = 100


def gap_figure(policies: Sequence[PolicyGap], path: str | Path, unit: str = "m", over_policies: bool = False) -> Path:
    """Draw the return of each policy, one bar per world, with one standard error and one dot per run.

    Runs with a fall are crosses, and their number is above the bar. The label of a policy contains its gap to each
    other world. All policies or groups must have run in the same worlds. `unit` is the unit of returns. With
    `over_policies`, error bars are confidence intervals over policies and robots, and each dot is a policy's mean.
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
            f"bars: mean and {CONFIDENCE:.0%} interval over policies and robots; dots: policies"
            if over_policies
            else "bars: mean and one standard error; dots: runs, crosses: runs that ended in a fall"
        )
        ax.set_xlabel(legend, color=QUIET, fontsize=8.0, labelpad=6.0)
        for number, name in enumerate(names):
            ax.bar(0, 0, color=f"C{number}", alpha=_BAR_ALPHA, label=name if number else f"{name} (home)")
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2, columnspacing=1.4)
    return Path(path)


def _return_bar(ax: Axes, place: int, number: int, count: int, policy: PolicyGap, over_policies: bool) -> None:
    world = policy.worlds[number]
    runs, wide, color = policy.in_world(world), _GROUP_WIDTH / count, f"C{number}"
    x = place + wide * (number - (count - 1) / 2)
    estimate, measured = policy.level(world, "return"), runs[runs["return"].notna()]
    error = estimate.error
    if over_policies:
        table = policy.table(world, "return")
        error = crossed_interval(table).high - estimate.mean
        measured = pd.DataFrame({"return": table.mean(axis=1), "fell": False})
    top, notes = 0.0, []
    if len(measured):
        error = error if math.isfinite(error) else 0.0
        ax.bar(x, estimate.mean, 0.9 * wide, color=color, alpha=_BAR_ALPHA, linewidth=0)
        ax.errorbar(x, estimate.mean, error, color=INK, linewidth=1.3, capsize=4.0, zorder=3)
        if 1 < len(measured) <= _MAX_DOTS:
            across = x + spread_dots(len(measured), 0.5 * wide)
            for some, marker in ((~measured.fell, "o"), (measured.fell, "x")):
                ax.plot(across[some], measured["return"][some], marker, color=color, markersize=3.6, alpha=0.9)
        top = max(estimate.mean + error, float(measured["return"].max()), 0.0)
    else:
        notes = ["return\nunknown"]
    if runs.fell.any():
        notes.append(f"{runs.fell.sum()} of {len(runs)}\nfell")
    text, offset = "\n".join(notes), (0, 4)
    ax.annotate(text, (x, top), offset, textcoords="offset points", ha="center", va="bottom", fontsize=7.5, color=INK)


def _label(policy: PolicyGap, unit: str) -> str:
    """Return a label with a policy's name and its gap to each other world."""
    away, lines = policy.worlds[1:], []
    for world in away:
        gap = policy.gap(world).mean
        where = f"gap to {world}" if len(away) > 1 else "gap"
        lines.append(f"{where} {gap:+.2f} {unit}".rstrip() if math.isfinite(gap) else f"{where} -")
    return "\n".join([*policy.name.split(", "), *lines])
