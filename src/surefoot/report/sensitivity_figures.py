"""Figures of a sensitivity study: the return against one physical parameter, and over all test worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surefoot.errors import SurefootError
from surefoot.evaluate.sensitivity import Sensitivity, row_unit
from surefoot.report.figures import BLUE, GREEN, INK, ORANGE, QUIET, _figure, _spoken
from surefoot.task.randomize import ROWS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = (BLUE, ORANGE, GREEN, "#7a4fa3", "#a8324a", "#1d8a99", "#8a6d3b", "#4a5560")
"""One a policy, in order; beyond them they begin anew, with another marker."""
MARKERS = "osD^vP"
MOST_COUNTS = 12
"""So many values' falls can be written side by side."""

Ranges = Mapping[str, tuple[float, float]]


def parameter_figure(
    row: str,
    sensitivities: Sequence[Sensitivity],
    path: str | Path,
    trained_ranges: Mapping[str, Ranges] | None = None,
) -> Path:
    """Draw the mean return against a row's value, with standard errors, and below it each policy's falls.

    A world in which a policy falls at least once has an open marker, and the number of falls below. Where a policy
    was trained is shaded in its colour; one that was trained in the nominal world alone has a line there.

    Args:
        row: row of the table of ranges.
        sensitivities: one or more policies; those whose study lacks the row are left out.
        path: PNG to write.
        trained_ranges: by policy name, the ranges that it was trained with, by row. Without this nothing is said
            about training.

    Raises:
        SurefootError: a row that no study has.
    """
    shown = [(number, result) for number, result in enumerate(sensitivities) if row in result.rows]
    if not shown:
        raise SurefootError(f"parameter figure: row '{row}' is in none of the {len(sensitivities)} studies given")
    below = 0.25 + 0.24 * len(shown)
    with _figure(path, (6.6, 4.0 + below), rows=2) as (_, (top, bottom)):
        grid = top.get_gridspec()
        if grid is not None:
            grid.set_height_ratios([3.3, below])
        for place, (number, result) in enumerate(shown):
            _returns(top, result, row, number)
            _falls(bottom, result, row, number, place)
            if trained_ranges is not None:
                trained = trained_ranges.get(result.policy, {}).get(row)
                _training(top, bottom, result, row, number, place, trained)
        values = [world.value for _, result in shown for world in result.worlds if world.row == row]
        margin = 0.04 * (max(values) - min(values)) or 0.5 * abs(values[0]) or 1.0
        for ax in (top, bottom):
            ax.set_xlim(min(values) - margin, max(values) + margin)
        top.set_ylim(bottom=min(0.0, top.get_ylim()[0]))
        top.set_title(f"Return of an episode (m) against {_spoken(row)}", fontweight="bold", pad=22.0)
        top.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2, columnspacing=1.4)
        top.tick_params(labelbottom=False)
        bottom.set_ylim(len(shown) - 0.4, -0.6)
        bottom.set_yticks(range(len(shown)), [result.policy for _, result in shown])
        for label, (number, _) in zip(bottom.get_yticklabels(), shown, strict=True):
            label.set_color(COLORS[number % len(COLORS)])
        bottom.grid(visible=False)
        bottom.tick_params(axis="y", length=0)
        episodes = sorted({result.episodes for _, result in shown})
        said = f"Falls in {' or '.join(map(str, episodes))} episodes"
        if trained_ranges is not None:
            said += "; band: range trained in, bar: trained at this value alone"
        bottom.set_title(said, fontsize=8.5, pad=4.0)
        bottom.set_xlabel(_label(row))
    return Path(path)


def _label(row: str) -> str:
    """A row and its unit; ratios are called so."""
    unit = row_unit(row)
    if unit:
        return f"{_spoken(row)} ({unit})"
    return f"{_spoken(row)} ratio" if ROWS[row].params[0].endswith("_ratio") else _spoken(row)


def _returns(ax: Axes, result: Sensitivity, row: str, number: int) -> None:
    """Draw one policy's returns: a line, error bars, and markers that are open where it falls."""
    rows = result.of_row(row)
    value = np.array([result.worlds[i].value for i in rows])
    mean, error = result.mean_return[rows], np.nan_to_num(result.standard_error[rows])
    color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
    ax.errorbar(value, mean, error, color=color, linewidth=1.4, elinewidth=1.0, capsize=2.5)
    falls = result.fell[rows].any(axis=1)
    ax.plot(value[~falls], mean[~falls], marker, color=color, markersize=5.0)
    ax.plot(value[falls], mean[falls], marker, color=color, markersize=5.5, markerfacecolor="white", zorder=3)
    ax.plot([], [], marker=marker, color=color, markersize=5.0, label=result.policy)


def _falls(ax: Axes, result: Sensitivity, row: str, number: int, place: int) -> None:
    """Write how often one policy falls at each value, on a disc that is the darker the more it does."""
    rows = result.of_row(row)
    falls, color = result.fell[rows].sum(axis=1), COLORS[number % len(COLORS)]
    for i, count in zip(rows, falls, strict=True):
        value, share = result.worlds[i].value, count / result.episodes
        if not count:
            ax.plot(value, place, ".", color=QUIET, markersize=2.5)
            continue
        ax.plot(value, place, "o", color="white", markersize=12.5, zorder=3)
        ax.plot(value, place, "o", color=color, alpha=0.25 + 0.75 * share, markersize=12.5, markeredgewidth=0, zorder=3)
        if len(rows) <= MOST_COUNTS:
            ink = "white" if share >= 0.5 else INK
            ax.text(value, place, str(count), color=ink, fontsize=7.5, ha="center", va="center_baseline", zorder=4)


def _training(
    top: Axes,
    bottom: Axes,
    result: Sensitivity,
    row: str,
    number: int,
    place: int,
    trained: tuple[float, float] | None,
) -> None:
    """Shade the range that a policy was trained in; a line at the nominal value, if it was trained there alone."""
    color = COLORS[number % len(COLORS)]
    if trained is not None and trained[1] > trained[0]:
        top.axvspan(*trained, color=color, alpha=0.07, linewidth=0, zorder=0)
        bottom.fill_between(trained, place - 0.42, place + 0.42, color=color, alpha=0.2, linewidth=0, zorder=0)
        return
    value = result.nominal.values.get(row) if trained is None else trained[0]
    if value is not None:
        top.axvline(value, color=color, linewidth=1.0, linestyle=(2 * place, (4, 6)), zorder=0.5)
        bottom.plot([value, value], [place - 0.42, place + 0.42], color=color, linewidth=2.0, zorder=0.5)


def aggregate_figure(sensitivities: Sequence[Sensitivity], path: str | Path) -> Path:
    """Draw a bar for each policy: the mean over all its test worlds, with the standard deviation.

    Dots are the mean returns of single test worlds, a diamond is that of the nominal world.

    Args:
        sensitivities: one or more policies.
        path: PNG to write.

    Raises:
        SurefootError: no policy.
    """
    if not sensitivities:
        raise SurefootError("aggregate figure: no study is given; it takes 1 or more")
    with _figure(path, (7.6, 1.2 + 0.62 * len(sensitivities))) as (_, (ax,)):
        for place, result in enumerate(sensitivities):
            color, means = COLORS[place % len(COLORS)], result.mean_return
            ax.barh(place, result.mean, 0.62, color=color, alpha=0.35, linewidth=0)
            # The golden ratio spreads dots evenly, and alike in every run.
            spread = 0.5 * ((np.arange(len(means)) * 0.618034) % 1.0 - 0.5)
            ax.plot(means, place + spread, "o", color=color, alpha=0.55, markersize=2.8, markeredgewidth=0)
            ax.errorbar(result.mean, place, xerr=result.std, color=INK, linewidth=1.3, capsize=4.0)
            ax.plot(result.nominal.mean_return, place, "D", color="white", markeredgecolor=INK, markersize=5.5)
            said = f"{result.mean:.2f} ± {result.std:.2f} m\n{100 * result.fall_rate:.1f} % fall"
            ax.text(1.02, place, said, transform=ax.get_yaxis_transform(), va="center", fontsize=8.5, color=INK)
        ax.axvline(0.0, color=QUIET, linewidth=0.8)
        ax.set_yticks(range(len(sensitivities)), [result.policy for result in sensitivities])
        ax.set_ylim(len(sensitivities) - 0.5, -0.5)
        ax.tick_params(axis="y", length=0)
        ax.grid(visible=False, axis="y")
        worlds = sorted({len(result.worlds) for result in sensitivities})
        ax.set_title(f"Return over {' or '.join(map(str, worlds))} test worlds", fontweight="bold")
        ax.set_xlabel("return (m): mean and standard deviation; dots: test worlds; diamond: nominal world")
    return Path(path)
