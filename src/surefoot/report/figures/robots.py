"""Figure of groups of policies on robots: return in simulation and on the robot, as in Tan et al. 2018, figure 5."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.evaluation.statistics import CONFIDENCE, Interval
from surefoot.report.figures.style import BLUE, INK, ORANGE, QUIET, new_figure, place_labels, spread_dots
from surefoot.tables import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BAR_WIDTH = 0.36
"""Width of a bar; groups are at a distance of 1."""
_BAR_ALPHA = 0.4


@dataclass(frozen=True)
class GroupOnRobots:
    """Returns of a group of policies per robot, averaged over seeds and initial states."""

    label: str
    home: Array
    """Return in the training simulator (R,) [m]."""
    on_robot: Array
    """Return on the robot (R,) [m]."""
    intervals: tuple[Interval, Interval]
    """Means over robots of both with their intervals [m]."""
    falls: float
    """Fraction of runs on robots that ended in a fall, 0 to 1."""
    marked: NDArray[np.bool_]
    """Whether each robot is drawn as a cross (R,)."""


def robots_figure(
    groups: Sequence[GroupOnRobots], path: str | Path, marked: str = "", title: str = "", unit: str = "m"
) -> Path:
    """Draw the returns of groups in simulation and on robots, as bars with intervals over robots and one dot per robot.

    A line connects the two returns of a robot. The label of a group contains its mean gap; the fraction of falls is
    above its bar on robots.

    Args:
        groups: one or more groups.
        path: file to write (.png).
        marked: meaning of crosses, for the legend; if empty, no robot is drawn as a cross.
        title: title of the figure.
        unit: unit of returns.
    """
    with new_figure(path, (max(5.2, 1.4 + 1.35 * len(groups)), 4.2)) as (_, (ax,)):
        for place, group in enumerate(groups):
            _group(ax, place, group, bool(marked))
        ax.axhline(0.0, color=QUIET, linewidth=0.8)
        gaps = [float(np.mean(group.home - group.on_robot)) for group in groups]
        labels = [f"{group.label}\ngap {gap:+.2f} {unit}".rstrip() for group, gap in zip(groups, gaps, strict=True)]
        place_labels(ax, [label.replace(", ", ",\n") for label in labels])
        ax.set_xlim(-0.5, len(groups) - 0.5)
        ax.margins(y=0.12)
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.set_title(title or with_unit("Return of an episode", unit), fontweight="bold", pad=24.0)
        legend = f"bars: mean and {CONFIDENCE:.0%} interval; dots: robots"
        ax.set_xlabel(legend + (f"; crosses: {marked}" if marked else ""), color=QUIET, fontsize=8.0, labelpad=6.0)
        for color, name in ((BLUE, "in simulation"), (ORANGE, "on the robot")):
            ax.bar(0, 0, color=color, alpha=_BAR_ALPHA, label=name)
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2, columnspacing=1.4)
    return Path(path)


def _group(ax: Axes, place: int, group: GroupOnRobots, marked: bool) -> None:
    across = spread_dots(len(group.home), 0.4 * _BAR_WIDTH)
    places = [place - _BAR_WIDTH / 2 - 0.01 + across, place + _BAR_WIDTH / 2 + 0.01 + across]
    ax.plot(places, [group.home, group.on_robot], color=QUIET, linewidth=0.6, alpha=0.45, zorder=2)
    crosses = group.marked if marked else np.zeros(len(group.home), np.bool_)
    both = (group.home, group.on_robot)
    for x, values, interval, color in zip(places, both, group.intervals, (BLUE, ORANGE), strict=True):
        middle = float(np.mean(x - across))
        error = interval.high - interval.mean if interval.is_finite else 0.0
        ax.bar(middle, interval.mean, _BAR_WIDTH, color=color, alpha=_BAR_ALPHA, linewidth=0)
        ax.errorbar(middle, interval.mean, error, color=INK, linewidth=1.3, capsize=4.0, zorder=4)
        for some, marker, size in ((~crosses, "o", 3.8), (crosses, "x", 5.0)):
            ax.plot(x[some], values[some], marker, color=color, markersize=size, alpha=0.9, zorder=3)
    if group.falls > 0:
        high = group.intervals[1].high
        top = max(float(np.max(group.on_robot)), high if math.isfinite(high) else 0.0, 0.0)
        text, where = f"{group.falls:.0%}\nfell", (place + _BAR_WIDTH / 2, top)
        ax.annotate(text, where, (0, 5), textcoords="offset points", ha="center", va="bottom", fontsize=7.5, color=INK)
