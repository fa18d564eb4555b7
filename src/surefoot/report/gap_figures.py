"""The reality gap as a figure: returns at home and in other worlds, side by side, as Tan et al. 2018 draw them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.errors import SurefootError
from surefoot.evaluate.gap import PolicyGap
from surefoot.evaluate.runs import Runs
from surefoot.report.style import COLORS, INK, QUIET, new_figure, place_labels, scattered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GROUP = 0.8
"""Width of the bars of a policy, where policies are 1 apart."""
_PALE = 0.5
_MOST_DOTS = 100


def gap_figure(policies: Sequence[PolicyGap], path: str | Path) -> Path:
    """Draw the return of each policy as bars, a bar a world, with one standard error and every run as a dot.

    Below each policy stands its gap to each other world; over a bar, how many of the runs fell, if any did: they are
    crosses.

    Args:
        policies: one or more, or groups of policies, run in the same worlds.
        path: PNG to write.

    Raises:
        SurefootError: no policy, or policies that were run in different worlds.
    """
    worlds = {tuple(runs.world for runs in (policy.home, *policy.away)) for policy in policies}
    if len(worlds) != 1:
        raise SurefootError(f"gap figure: {len(policies)} policies in {len(worlds)} sets of worlds; it takes one set")
    (names,) = worlds
    width = max(5.2, 1.2 + len(policies) * max(1.6 if len(names) < 3 else 2.3, 0.62 * len(names)))
    with new_figure(path, (width, 3.9 + 0.16 * len(names))) as (_, (ax,)):
        for place, policy in enumerate(policies):
            for number, runs in enumerate((policy.home, *policy.away)):
                _bar(ax, place, number, len(names), runs)
        ax.axhline(0.0, color=QUIET, linewidth=0.8)
        place_labels(ax, [_label(policy) for policy in policies])
        ax.set_xlim(-0.5, len(policies) - 0.5)
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
    gained, known = runs.estimate("returns"), np.isfinite(runs.returns)
    top, said = 0.0, []
    if math.isfinite(gained.mean):
        error = gained.error if math.isfinite(gained.error) else 0.0
        ax.bar(x, gained.mean, 0.9 * wide, color=color, alpha=_PALE, linewidth=0)
        ax.errorbar(x, gained.mean, error, color=INK, linewidth=1.3, capsize=4.0, zorder=3)
        if 1 < known.sum() <= _MOST_DOTS:
            across = x + scattered(len(runs), 0.5 * wide)
            for some, marker in ((known & ~runs.fell, "o"), (known & runs.fell, "x")):
                ax.plot(across[some], runs.returns[some], marker, color=color, markersize=3.6, alpha=0.9)
        top = max(gained.mean + error, float(runs.returns[known].max()), 0.0)
    else:
        said = ["return\nnot known"]
    if runs.fell.any():
        said.append(f"{runs.fell.sum()} of {len(runs)}\nfell")
    style: dict[str, Any] = {
        "textcoords": "offset points",
        "ha": "center",
        "va": "bottom",
        "fontsize": 7.5,
        "color": INK,
    }
    ax.annotate("\n".join(said), (x, top), xytext=(0, 4), **style)


def _label(policy: PolicyGap) -> str:
    """Return a policy's name, and below it its gap to each other world."""
    lines = []
    for runs in policy.away:
        gap = policy.gap(runs.world).mean
        where = f"gap to {runs.world}" if len(policy.away) > 1 else "gap"
        lines.append(f"{where} {gap:+.2f} m" if math.isfinite(gap) else f"{where} -")
    return "\n".join([*policy.name.split(", "), *lines])
