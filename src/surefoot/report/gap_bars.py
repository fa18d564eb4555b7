"""Reality gaps of groups as Tan et al. 2018 draw them: a pair of bars a group, at home and away."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from surefoot.errors import SurefootError
from surefoot.evaluate.gap import Runs, plus_minus
from surefoot.evaluate.gap_groups import GroupGap
from surefoot.report.figures import BLUE, INK, ORANGE, QUIET, _figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HOME, AWAY = BLUE, ORANGE
"""The paper's are blue and red."""
_WIDE = 0.38
"""Width of a bar, where groups are 1 apart."""
_LANE = 0.028
"""How far runs of a policy stand apart at most."""


def gap_bars(groups: Sequence[GroupGap], path: str | Path, title: str = "") -> Path:
    """Draw each group's mean return at home and away with one standard error, and every run as a mark.

    Runs of one policy stand close together; runs in which the robot fell are crosses.

    Args:
        groups: one or more.
        path: PNG to write.
        title: over the bars.

    Raises:
        SurefootError: no groups.
    """
    if not groups:
        raise SurefootError("gap figure: no groups; it shows 1 or more")
    with _figure(path, (max(4.8, 1.2 + 1.55 * len(groups)), 4.3)) as (figure, (ax,)):
        for place, group in enumerate(groups):
            _bar(ax, place - _WIDE / 2 - 0.02, group.home, [policy.home for policy in group.policies], HOME)
            _bar(ax, place + _WIDE / 2 + 0.02, group.away, [policy.away[0] for policy in group.policies], AWAY)
        ax.axhline(0.0, color=QUIET, linewidth=0.8)
        ax.set_xlim(-0.55, len(groups) - 0.45)
        # The least and greatest mark keep some distance to the edges.
        low, high = ax.get_ylim()
        ax.set_ylim(min(low, 0.0) if low >= 0 else low - 0.02 * (high - low), high)
        ax.set_xticks(range(len(groups)), _labels(groups))
        ax.tick_params(axis="x", length=0)
        ax.grid(visible=False, axis="x")
        ax.set_ylabel("return (m)")
        away = {"ensemble": "on the ensemble's robots"}.get(groups[0].away.world, f"in {groups[0].away.world}")
        for color, name in ((HOME, "in its own simulator"), (AWAY, away)):
            ax.bar(0, 0, color=color, alpha=0.75, label=name)
        ax.plot([], [], "o", color=INK, markersize=4.0, label="run kept its balance")
        ax.plot([], [], "x", color=INK, markersize=4.5, label="run fell")
        # matplotlib puts lines before bars; here bars come first.
        handles, names = (part[2:] + part[:2] for part in ax.get_legend_handles_labels())
        figure.legend(handles, names, loc="outside lower center", ncols=2 if len(groups) < 3 else 4)
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold", color=INK)
    return Path(path)


def _labels(groups: Sequence[GroupGap]) -> list[str]:
    """Names of the groups, and below them in one line their gaps."""
    names = [group.label.split(", ") for group in groups]
    lines = max(map(len, names))
    return [
        "\n".join([*name, *[""] * (lines - len(name)), f"gap {plus_minus(group.gap)} m"])
        for name, group in zip(names, groups, strict=True)
    ]


def _bar(ax: Axes, x: float, runs: Runs, policies: Sequence[Runs], color: str) -> None:
    """Draw a bar with its error, and runs by policy."""
    mean = runs.estimate("returns")
    ax.bar(x, mean.mean, width=_WIDE, color=color, alpha=0.75, linewidth=0)
    # Marks keep to the left, so that none covers the error.
    apart, left = 0.8 * _WIDE / len(policies), x - 0.08 * _WIDE
    for number, policy in enumerate(policies):
        center = left + apart * (number - (len(policies) - 1) / 2)
        lane = min(_LANE, 0.7 * apart / max(len(policy) - 1, 1))
        for run, (gained, balanced) in enumerate(zip(policy.returns, policy.balanced, strict=True)):
            place = center + lane * (run - (len(policy) - 1) / 2)
            mark, size, edge = ("o", 3.6, 0.5) if balanced else ("x", 4.2, 1.1)
            around = "white" if balanced else INK
            ax.plot(
                place,
                gained,
                mark,
                color=INK,
                markersize=size,
                markeredgewidth=edge,
                markeredgecolor=around,
                alpha=0.85,
                zorder=3,
            )
    if math.isfinite(mean.error):
        ax.errorbar(x + 0.4 * _WIDE, mean.mean, yerr=mean.error, color=INK, capsize=3.5, linewidth=1.5, zorder=4)
