"""Figures of a study: learning curves, groups side by side, and what each physical parameter does to them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.evaluate.comparison import Comparison, GroupResult
from surefoot.evaluate.sensitivity import row_unit
from surefoot.report.figures import BLUE, GREEN, INK, ORANGE, QUIET, _figure, _spoken

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = (BLUE, ORANGE, GREEN, "#7a4fa3", "#a8324a", "#1d8a99", "#5a6b1f", "#8a6d3b")
"""One a group, in order; more groups begin anew."""
_MARKERS = "osD^vPX*"
_BINS = 40


def learning_curves(comparison: Comparison, path: str | Path) -> Path:
    """Draw return, speed and falls of every group's training: mean over seeds, and from the least to the greatest.

    Args:
        comparison: the groups.
        path: PNG to write.
    """
    parts = (("returns", "Return of an episode (m)"), ("speed", "Speed (m/s)"), ("falls", "Episodes with a fall (%)"))
    longest = max(float(seed.curve.steps[-1]) for group in comparison.groups for seed in group.seeds)
    scale, unit = (1e6, "million ") if longest >= 2e5 else (1.0, "")
    with _figure(path, (11.0, 3.7), columns=3) as (figure, axes):
        for ax, (name, title) in zip(axes, parts, strict=True):
            for number, group in enumerate(comparison.groups):
                # Every group its own bins, so that each curve reaches to the end of its training.
                edges = np.linspace(0.0, max(float(seed.curve.steps[-1]) for seed in group.seeds), _BINS + 1)
                curves = np.array([seed.curve.binned(name, edges) for seed in group.seeds])
                known = np.isfinite(curves).any(axis=0)
                _band(ax, edges[1:][known] / scale, curves[:, known], COLORS[number % len(COLORS)], group.label)
            ax.set_title(title)
            ax.set_xlabel(f"{unit}control steps")
            ax.set_xlim(0.0, longest / scale)
        axes[2].set_ylim(0.0, max(axes[2].get_ylim()[1], 1.0))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
        _heading(figure, "Training: mean over seeds, band from the least to the greatest seed")
    return Path(path)


def group_figure(comparison: Comparison, path: str | Path, names: Sequence[str] = ()) -> Path:
    """Draw figures of every group as bars: mean over seeds, its interval of 95 %, and every seed as a dot.

    Args:
        comparison: the groups.
        path: PNG to write.
        names: figures to draw, a panel each; all, if empty.
    """
    figures = [figure for figure in comparison.figures if not names or figure.name in names]
    if not figures:
        raise SurefootError("group figure: none of the figures wanted is in the study")
    groups = comparison.groups
    with _figure(path, (3.4 * len(figures), 1.5 + 0.55 * len(groups)), columns=len(figures)) as (heading, axes):
        for ax, figure in zip(axes, figures, strict=True):
            for row, group in enumerate(groups):
                _bar(ax, row, group, figure.name, COLORS[row % len(COLORS)])
            ax.set_title(_capital(f"{figure.title} ({figure.unit})"))
            ax.set_ylim(len(groups) - 0.4, -0.6)
            ax.set_yticks(range(len(groups)), [g.label for g in groups] if ax is axes[0] else [""] * len(groups))
            ax.tick_params(axis="y", length=0)
            ax.grid(visible=False, axis="y")
            ax.axvline(0.0, color=QUIET, linewidth=0.8)
            if figure.unit == "%":
                # Student's t knows no bounds; a share does.
                ax.set_xlim(0.0, min(max(ax.get_xlim()[1], 5.0), 103.0))
        _heading(heading, "Mean over seeds, 95 % confidence interval, and each seed as a dot")
    return Path(path)


def parameters_figure(comparison: Comparison, path: str | Path) -> Path:
    """Draw the return against every parameter, a panel each: mean over seeds, and from the least to the greatest.

    Args:
        comparison: the groups, with test worlds.
        path: PNG to write.
    """
    rows = parameter_rows(comparison)
    columns = min(len(rows), 5)
    lines = -(-len(rows) // columns)
    with _figure(path, (2.7 * columns, 0.9 + 2.3 * lines), rows=lines, columns=columns) as (figure, axes):
        bounds = []
        for ax, row in zip(axes, rows, strict=False):
            _returns(ax, comparison, row)
            ax.set_title(_titled(row))
            ax.locator_params(axis="x", nbins=4)
            bounds.append(ax.get_ylim())
        for number, ax in enumerate(axes):
            # One scale for all, so that panels can be compared.
            ax.set_ylim(min(low for low, _ in bounds), max(high for _, high in bounds))
            ax.set_visible(number < len(rows))
            if number % columns == 0:
                ax.set_ylabel("return (m)")
            else:
                ax.tick_params(axis="y", labelleft=False)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
        _heading(figure, "One parameter at a time: mean over seeds, band from the least to the greatest seed")
    return Path(path)


def parameter_figure(comparison: Comparison, row: str, path: str | Path) -> Path:
    """Draw return and falls against one parameter.

    Args:
        comparison: the groups, with test worlds.
        row: row of the table of ranges.
        path: PNG to write.
    """
    if row not in parameter_rows(comparison):
        raise SurefootError(f"parameter figure: row '{row}' is in no test world of the study")
    with _figure(path, (8.6, 3.7), columns=2) as (figure, (left, right)):
        _returns(left, comparison, row)
        left.set_title("Return (m)")
        for values, number, group in _worlds(comparison, row):
            fell = np.array([100 * one.fell[one.of_row(row)].mean(axis=1) for one in group.sensitivities])
            _band(right, values, fell, COLORS[number % len(COLORS)], group.label, _MARKERS[number % len(_MARKERS)])
        right.set_title("Episodes with a fall (%)")
        right.set_ylim(-3.0, 103.0)
        _mark_nominal(right, comparison, row)
        for ax in (left, right):
            ax.set_xlabel(_titled(row))
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=5)
        _heading(figure, f"{_titled(row)}: mean over seeds, band from the least to the greatest seed")
    return Path(path)


def parameter_rows(comparison: Comparison) -> tuple[str, ...]:
    """Rows of the table of ranges that test worlds differ in.

    Raises:
        SurefootError: a study without test worlds.
    """
    found = [rows for group in comparison.groups for one in group.sensitivities for rows in one.rows]
    if not found:
        raise SurefootError("parameter figure: the study has no test worlds; its evaluations must name 'sensitivity'")
    return tuple(dict.fromkeys(found))


def _returns(ax: Axes, comparison: Comparison, row: str) -> None:
    """Draw the return of every group against a parameter."""
    for values, number, group in _worlds(comparison, row):
        returns = np.array([one.mean_return[one.of_row(row)] for one in group.sensitivities])
        _band(ax, values, returns, COLORS[number % len(COLORS)], group.label, _MARKERS[number % len(_MARKERS)])
    _mark_nominal(ax, comparison, row)


def _worlds(comparison: Comparison, row: str) -> Iterator[tuple[NDArray[np.float64], int, GroupResult]]:
    """A row's values, and the number and the group of those that have test worlds."""
    for number, group in enumerate(comparison.groups):
        if group.sensitivities:
            one = group.sensitivities[0]
            yield np.array([one.worlds[i].value for i in one.of_row(row)]), number, group


def _mark_nominal(ax: Axes, comparison: Comparison, row: str) -> None:
    """Mark the nominal value of a parameter, in whose world all others of the table stand."""
    for group in comparison.groups:
        for one in group.sensitivities[:1]:
            if row in one.nominal.values:
                ax.axvline(
                    one.nominal.values[row],
                    color=QUIET,
                    linewidth=0.9,
                    linestyle=(0, (2, 2)),
                    zorder=0,
                    label="nominal",
                )
                return


def _band(
    ax: Axes, x: NDArray[np.float64], curves: NDArray[np.float64], color: str, label: str, marker: str = ""
) -> None:
    """Draw the mean of curves (S, K), and the band from the least to the greatest."""
    with warnings.catch_warnings():
        # A place that no seed has reached is left open.
        warnings.simplefilter("ignore", RuntimeWarning)
        mean, low, high = np.nanmean(curves, axis=0), np.nanmin(curves, axis=0), np.nanmax(curves, axis=0)
    ax.fill_between(x, low, high, color=color, alpha=0.16, linewidth=0)
    ax.plot(x, mean, color=color, label=label, marker=marker, markersize=2.8)


def _bar(ax: Axes, row: int, group: GroupResult, figure: str, color: str) -> None:
    """Draw a group's mean with its interval and its seeds."""
    interval, values = group.interval(figure), group.values(figure)
    ax.barh(row, interval.mean, height=0.62, color=color, alpha=0.28, linewidth=0)
    if interval.known:
        half = [[interval.mean - interval.low], [interval.high - interval.mean]]
        ax.errorbar(interval.mean, row, xerr=half, fmt="|", color=color, capsize=4.0, markersize=9.0, linewidth=1.6)
    lane = np.full(len(values), row + 0.2)
    ax.plot(values, lane, "o", color=color, markersize=4.5, markeredgecolor="white", markeredgewidth=0.6, clip_on=False)


def _titled(row: str) -> str:
    """A parameter's name with its unit, as a title."""
    unit = row_unit(row)
    name = _spoken(row).replace("imu", "IMU")
    return _capital(name) + (f" ({unit})" if unit else "")


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]


def _heading(figure: object, text: str) -> None:
    figure.suptitle(text, x=0.01, ha="left", fontweight="bold", color=INK)  # type: ignore[attr-defined]
