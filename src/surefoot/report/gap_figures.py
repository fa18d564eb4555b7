"""The reality gap as a figure: the return of each policy at home and in other worlds, side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surefoot.errors import SurefootError
from surefoot.evaluate.gap import PolicyGap, Runs, plus_minus
from surefoot.report.figures import BLUE, GREEN, INK, ORANGE, QUIET, _figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = (BLUE, ORANGE, GREEN, "#7a4fa3", "#a8324a", "#1d8a99")
"""Home first, then one for each other world; more worlds begin anew."""
_GROUP = 0.8
_PALE = 0.5
_MOST_DOTS = 40


def gap_figure(policies: Sequence[PolicyGap], path: str | Path, pooled: PolicyGap | None = None) -> Path:
    """Draw the return of each policy as bars, a bar a world, with one standard error and every run as a dot.

    Below each policy stands its gap to each other world; over a bar, how many of the runs fell, if any did: they are
    crosses.

    Args:
        policies: one or more, run in the same worlds.
        path: PNG to write.
        pooled: all of them as one, drawn last.

    Raises:
        SurefootError: no policy, or policies that were run in different worlds.
    """
    groups = [*policies, *([pooled] if pooled is not None else [])]
    worlds = {tuple(runs.world for runs in (group.home, *group.away)) for group in groups}
    if len(worlds) != 1:
        raise SurefootError(f"gap figure: {len(groups)} policies in {len(worlds)} sets of worlds; it takes one set")
    (names,) = worlds
    lines = 1 + len(names[1:])
    width = max(5.2, 1.2 + len(groups) * max(1.6 if len(names) < 3 else 2.3, 0.62 * len(names)))
    with _figure(path, (width, 3.9 + 0.16 * lines)) as (_, (ax,)):
        for place, group in enumerate(groups):
            for number, runs in enumerate((group.home, *group.away)):
                _bar(ax, place, number, len(names), runs)
        if pooled is not None:
            ax.axvline(len(policies) - 0.5, color=QUIET, linewidth=0.8, linestyle=(0, (4, 3)))
        ax.axhline(0.0, color=QUIET, linewidth=0.8)
        ax.set_xticks(range(len(groups)), [_label(group) for group in groups])
        ax.set_xlim(-0.5, len(groups) - 0.5)
        ax.tick_params(axis="x", length=0)
        ax.grid(visible=False, axis="x")
        ax.margins(y=0.12)
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.set_title("Return of an episode (m)", fontweight="bold", pad=24.0)
        said = "bars: mean and one standard error; dots: runs, crosses: runs that ended in a fall"
        ax.set_xlabel(said, color=QUIET, fontsize=8.0, labelpad=6.0)
        for number, name in enumerate(names):
            label = name if number else f"{name} (home)"
            ax.bar(0, 0, color=COLORS[number % len(COLORS)], alpha=_PALE, label=label)
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2, columnspacing=1.4)
    return Path(path)


def _bar(ax: Axes, place: int, number: int, count: int, runs: Runs) -> None:
    """Draw one policy's returns in one of `count` worlds."""
    wide, color = _GROUP / count, COLORS[number % len(COLORS)]
    x = place + wide * (number - (count - 1) / 2)
    gained = runs.estimate("returns")
    known = runs.returns[np.isfinite(runs.returns)]
    top = 0.0
    if math.isfinite(gained.mean):
        ax.bar(x, gained.mean, 0.9 * wide, color=color, alpha=_PALE, linewidth=0)
        error = gained.error if math.isfinite(gained.error) else 0.0
        ax.errorbar(x, gained.mean, error, color=INK, linewidth=1.3, capsize=4.0, zorder=3)
        if 1 < len(known) <= _MOST_DOTS:
            # The golden ratio spreads dots evenly, and alike in every run.
            spread = 0.5 * wide * ((np.arange(len(known)) * 0.618034) % 1.0 - 0.5)
            fell = runs.fell[np.isfinite(runs.returns)]
            for some, marker in ((~fell, "o"), (fell, "x")):
                ax.plot((x + spread)[some], known[some], marker, color=color, markersize=3.6, alpha=0.9)
        top = max(gained.mean + error, float(known.max()), 0.0)
    said = [] if math.isfinite(gained.mean) else ["return\nnot known"]
    if runs.fell.any():
        said.append(f"{runs.fell.sum()} of {len(runs)}\nfell")
    ax.annotate(
        "\n".join(said),
        (x, top),
        xytext=(0, 4),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=7.5,
        color=INK,
    )


def _label(group: PolicyGap) -> str:
    """A policy's name, and below it what it loses in each other world."""
    named = len(group.away) > 1
    lines = [f"gap to {runs.world} {_gap(group, runs)}" if named else f"gap {_gap(group, runs)}" for runs in group.away]
    return "\n".join([group.name, *lines])


def _gap(group: PolicyGap, runs: Runs) -> str:
    gap = group.gap(runs.world)
    return plus_minus(gap, sign=True) + (" m" if math.isfinite(gap.mean) else "")
