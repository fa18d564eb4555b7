"""Figures of a sensitivity analysis: return and falls against a physical parameter, and returns of all test worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.evaluation.sensitivity import Sensitivity
from surefoot.report.figures.style import (
    INK,
    MARKERS,
    QUIET,
    capitalize_first,
    heading,
    humanize,
    new_figure,
    place_labels,
    spread_dots,
)
from surefoot.tables import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Groups = Mapping[str, Sequence[Sensitivity]]
"""Sensitivities of the policies of each group (one or more), by the group's name in the figure."""
Ranges = Mapping[str, tuple[float, float]]
_BAND = "band: minimum to maximum over seeds, or one standard error of a single policy"


def parameter_figure(
    row: str, groups: Groups, path: str | Path, trained_ranges: Mapping[str, Ranges] | None = None, unit: str = "m"
) -> Path:
    """Draw returns and falls against a parameter, with a band for each group.

    The band extends from the minimum to the maximum over the policies of a group, or one standard error for a single
    policy. The parameter's range in training is shaded in the policy's colour; a fixed value in training is a line.

    Args:
        row: parameter (row of the table of ranges), which at least one group must have.
        groups: groups of sensitivities; groups without the parameter are skipped.
        path: file to write (.png).
        trained_ranges: training ranges by group and parameter; by default training ranges are not drawn.
        unit: unit of returns.
    """
    if not any(row in one.rows for results in groups.values() for one in results):
        raise SurefootError(f"parameter figure: no test world of {', '.join(groups) or 'nothing'} varies '{row}'")
    with new_figure(path, (8.6, 3.7), columns=2) as (figure, (left, right)):
        _returns(left, groups, row)
        for number, (label, results) in enumerate(groups.items()):
            if row not in results[0].rows:
                continue
            worlds = [one.of_row(row) for one in results]
            falls = np.array([100 * one.falls / one.episodes for one in worlds])
            _band(right, worlds[0].value, falls, number, label)
            if trained_ranges is not None:
                _training(left, results[0], row, number, trained_ranges.get(label, {}).get(row))
        left.set_title(with_unit("Return", unit))
        left.set_ylim(bottom=min(0.0, left.get_ylim()[0]))
        right.set_title("Episodes with a fall (%)")
        right.set_ylim(-3.0, 103.0)
        for ax in (left, right):
            ax.set_xlabel(_titled(row, groups))
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=5)
        heading(figure, f"{_titled(row, groups)}; {_BAND}")
    return Path(path)


def parameters_figure(groups: Groups, path: str | Path, unit: str = "m") -> Path:
    """Draw the return against every parameter, one panel each, on a common scale; `unit` is the unit of returns."""
    rows = tuple(dict.fromkeys(row for results in groups.values() for one in results for row in one.rows))
    columns = min(len(rows), 5)
    lines = -(-len(rows) // columns)
    with new_figure(path, (2.7 * columns, 0.9 + 2.3 * lines), rows=lines, columns=columns) as (figure, axes):
        for ax, row in zip(axes, rows, strict=False):
            _returns(ax, groups, row)
            ax.set_title(_titled(row, groups))
            ax.locator_params(axis="x", nbins=4)
        low, high = zip(*(ax.get_ylim() for ax in axes[: len(rows)]), strict=True)
        for number, ax in enumerate(axes):
            ax.set_ylim(min(low), max(high))
            ax.set_visible(number < len(rows))
            ax.tick_params(axis="y", labelleft=number % columns == 0)
        axes[0].set_ylabel(with_unit("return", unit))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
        heading(figure, f"One parameter at a time; {_BAND}")
    return Path(path)


def aggregate_figure(sensitivities: Sequence[Sensitivity], path: str | Path, unit: str = "m") -> Path:
    """Draw one bar per policy: mean and standard deviation of the return over all its test worlds.

    Dots are the mean returns of single test worlds, the diamond of the nominal world. `unit` is the unit of returns.
    """
    with new_figure(path, (7.6, 1.2 + 0.62 * len(sensitivities))) as (_, (ax,)):
        for place, result in enumerate(sensitivities):
            color, means = f"C{place}", result.worlds.return_mean
            ax.barh(place, result.mean, 0.62, color=color, alpha=0.35, linewidth=0)
            across = place + spread_dots(len(means), 0.5)
            ax.plot(means, across, "o", color=color, alpha=0.55, markersize=2.8, markeredgewidth=0)
            ax.errorbar(result.mean, place, xerr=result.std, color=INK, linewidth=1.3, capsize=4.0)
            ax.plot(result.nominal["return"].mean(), place, "D", color="white", markeredgecolor=INK, markersize=5.5)
            text = f"{result.mean:.2f} ± {result.std:.2f} {unit}\n{100 * result.fall_rate:.1f} % fall"
            ax.text(1.02, place, text, transform=ax.get_yaxis_transform(), va="center", fontsize=8.5, color=INK)
        ax.axvline(0.0, color=QUIET, linewidth=0.8)
        place_labels(ax, [result.policy for result in sensitivities], vertical=True)
        ax.set_ylim(len(sensitivities) - 0.5, -0.5)
        ax.set_title("Return over test worlds", fontweight="bold")
        legend = "mean and standard deviation; dots: test worlds; diamond: nominal world"
        ax.set_xlabel(f"{with_unit('return', unit)}: {legend}")
    return Path(path)


def _returns(ax: Axes, groups: Groups, row: str) -> None:
    """Draw the return of each group against a parameter, and mark the nominal value."""
    for number, (label, results) in enumerate(groups.items()):
        if row in results[0].rows:
            worlds = [one.of_row(row) for one in results]
            returns = np.array([one.return_mean for one in worlds])
            if len(results) == 1:
                error = worlds[0].return_error.fillna(0.0)
                returns = np.array([returns[0] - error, returns[0], returns[0] + error])
            _band(ax, worlds[0].value, returns, number, label)
    nominal = {one.nominal_values[row] for results in groups.values() for one in results if row in one.nominal_values}
    for value in sorted(nominal)[:1]:
        ax.axvline(value, color=QUIET, linewidth=0.9, linestyle=(0, (2, 2)), zorder=0, label="nominal")


def _band(ax: Axes, x: Array, curves: Array, number: int, label: str) -> None:
    """Draw the mean of curves (S, K), with a band from minimum to maximum."""
    color, marker = f"C{number}", MARKERS[number % len(MARKERS)]
    ax.fill_between(x, curves.min(axis=0), curves.max(axis=0), color=color, alpha=0.16, linewidth=0)
    ax.plot(x, curves.mean(axis=0), color=color, label=label, marker=marker, markersize=2.8)


def _training(ax: Axes, result: Sensitivity, row: str, number: int, trained: tuple[float, float] | None) -> None:
    """Shade the training range of a policy, or draw a line if the parameter was fixed in training."""
    color = f"C{number}"
    if trained is not None and trained[1] > trained[0]:
        ax.axvspan(*trained, color=color, alpha=0.07, linewidth=0, zorder=0)
    else:
        value = result.nominal_values[row] if trained is None else trained[0]
        ax.axvline(value, color=color, linewidth=1.0, linestyle=(2 * number, (4, 6)), zorder=0.5)


def _titled(row: str, groups: Groups) -> str:
    """Return a parameter's name and unit as a title."""
    unit = next(one.unit(row) for results in groups.values() for one in results if row in one.rows)
    return with_unit(capitalize_first(humanize(row)), unit)
