"""Parts of the reports of studies and searches: README.md in a folder, figures and tables."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from surefoot.evaluation.statistics import Interval, decimal
from surefoot.report.figures.style import (
    BLUE,
    GREEN,
    ORANGE,
    QUIET,
    capitalize_first,
    heading,
    new_figure,
    place_labels,
)
from surefoot.studies.search_space import short_name
from surefoot.tables import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from surefoot.studies.comparison import Comparison
    from surefoot.studies.search_result import SearchResult

_COLORS = {"complete": BLUE, "pruned": ORANGE}


def readme(title: str, command: str, parts: Iterable[str], files: Mapping[str, str]) -> str:
    """Return the text of a report's README.md.

    Args:
        title: title of the report.
        command: command line that wrote it.
        parts: headings, paragraphs, tables and images in Markdown.
        files: description of each table in the folder, by file name.
    """
    listed = "\n".join(f"- [{name}]({name}): {content}" for name, content in files.items())
    text = [f"# {title}", f"```sh\n{command}\n```", *parts, "## Files", listed]
    return "\n\n".join(text) + "\n"


def read_tables(folder: Path, names: Iterable[str]) -> dict[str, pd.DataFrame]:
    """Return the tables NAME.csv that a folder has, by name; names of groups stay text, also `1` or `NA`."""
    text = dict.fromkeys(
        ("group", "against", "label", "question", "effect", "policy", "parameter", "part", "row"), "str"
    )
    return {
        name: pd.read_csv(path, dtype=text, keep_default_na=False, na_values=[""])
        for name in names
        if (path := folder / f"{name}.csv").is_file()
    }


def p_text(value: float) -> str:
    """Return a p value as a table cell."""
    return "< 0.001" if value < 0.001 else decimal(value, 3)


def image(caption: str, file: str) -> str:
    """Return the Markdown of an image in the report's folder."""
    return f"![{caption}]({file})"


def stride_cells(result: Mapping[str, Any]) -> dict[str, str]:
    """Return stride period and duty factor in a result of the evaluation `gait` as table cells."""
    return {
        heading: decimal(math.nan if result[name] in (None, "") else float(result[name]))
        for heading, name in (("stride (s)", "stride"), ("duty factor", "duty"))
    }


def group_figure(comparison: Comparison, path: str | Path, names: Sequence[str]) -> Path:
    """Plot the metrics `names` of every group as bars: mean over seeds, 95 % interval, and each seed as a dot."""
    metrics = [metric for metric in comparison.metrics if metric.name in names]
    groups = comparison.groups
    with new_figure(path, (3.4 * len(metrics), 1.5 + 0.55 * len(groups)), columns=len(metrics)) as (figure, axes):
        for ax, metric in zip(axes, metrics, strict=True):
            for row, group in enumerate(groups):
                values = comparison.select_group(group)[metric.name]
                _group_bar(ax, row, comparison.interval(group, metric), values, f"C{row}")
            ax.set_title(textwrap.fill(capitalize_first(metric.heading), 34))
            ax.set_ylim(len(groups) - 0.4, -0.6)
            place_labels(
                ax, [comparison.study.label(group) if ax is axes[0] else "" for group in groups], vertical=True
            )
            ax.axvline(0.0, color=QUIET, linewidth=0.8)
            if metric.unit == "%":
                # Leave room for a dot at 100 %.
                ax.set_xlim(0.0, min(max(ax.get_xlim()[1], 5.0), 103.0))
        heading(figure, "Mean over seeds, 95 % confidence interval, and each seed as a dot")
    return Path(path)


def _group_bar(ax: Axes, row: int, interval: Interval, values: pd.Series, color: str) -> None:
    ax.barh(row, interval.mean, height=0.62, color=color, alpha=0.28, linewidth=0)
    if interval.is_finite:
        half = [[interval.mean - interval.low], [interval.high - interval.mean]]
        ax.errorbar(interval.mean, row, xerr=half, fmt="|", color=color, capsize=4.0, markersize=9.0, linewidth=1.6)
    lane = np.full(len(values), row + 0.2)
    ax.plot(values, lane, "o", color=color, markersize=4.5, markeredgecolor="white", markeredgewidth=0.6, clip_on=False)


def search_figure(result: SearchResult, path: Path) -> None:
    """Plot the returns of trials in order, their learning curves, and the distribution of returns."""
    trials, steps = result.trials, result.config.train.steps
    scale, unit = (1e6, "million ") if steps >= 2e5 else (1.0, "")
    with new_figure(path, (11.0, 3.8), columns=3) as (figure, (order, curves, spread)):
        parts = [trials[trials.state == state] for state in _COLORS]
        for part, (state, color) in zip(parts, _COLORS.items(), strict=True):
            order.plot(part.trial, part["return"], "o", color=color, markersize=4.0, label=state)
            for curve in part.curve:
                curves.plot(*(np.array(curve) / [scale, 1.0]).T, color=color, alpha=0.5, linewidth=0.8)
        so_far = trials["return"].where(trials.state == "complete").cummax().ffill()
        order.step(trials.trial, so_far, where="post", color=GREEN, linewidth=1.2, label="best so far")
        order.set_title(with_unit("Return at the end", result.return_unit))
        order.set_xlabel("trial")
        order.locator_params(axis="x", integer=True)
        curves.set_title(with_unit("Return in training", result.return_unit))
        curves.set_xlabel(f"{unit}control steps")
        returns, colors = [part["return"].dropna() for part in parts], list(_COLORS.values())
        spread.hist(returns, bins=20, stacked=True, color=colors, label=list(_COLORS))
        spread.set_title(with_unit("Trials by return", result.return_unit))
        spread.set_xlabel(with_unit("return", result.return_unit))
        figure.legend(*order.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        heading(figure, f"Search: {result.config.train.task.name}, {len(trials)} trials")


def settings_figure(result: SearchResult, path: Path) -> None:
    """Plot the return of every trial with a policy against each searched field, the most important field first."""
    trials = result.trials[result.trials.policy.notna()]
    names = list(dict.fromkeys([*result.importance, *result.config.space]))
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    with new_figure(path, (2.9 * columns, 1.0 + 2.3 * rows), rows=rows, columns=columns) as (figure, axes):
        for ax, name in zip(axes, names, strict=False):
            _against(ax, trials, name)
            importance = f" ({result.importance[name]:.2f})" if name in result.importance else ""
            ax.set_title(short_name(name) + importance, fontsize=8.0)
        for ax in axes[len(names) :]:
            ax.set_axis_off()
        handles = {label: line for ax in axes for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=2)
        heading(figure, f"{with_unit('Return', result.return_unit)} against each field; in brackets: its importance")


def _against(ax: Axes, trials: pd.DataFrame, name: str) -> None:
    """Plot returns against a field, on a categorical axis if its values are not numbers."""
    values = list(trials[name])
    if any(isinstance(value, str) for value in values):
        labels = sorted({str(value) for value in values}, key=lambda text: (len(text), text))
        places = np.array([labels.index(str(value)) for value in values], np.float64)
        place_labels(ax, labels)
        ax.set_xlim(-0.5, len(labels) - 0.5)
    else:
        places = np.array(values, np.float64)
        if places.min() > 0 and places.max() > 8 * places.min():
            ax.set_xscale("log")
            ax.xaxis.set_minor_formatter("")
    for state, color in _COLORS.items():
        of_state = (trials.state == state).to_numpy()
        returns = trials["return"][of_state]
        ax.plot(places[of_state], returns, "o", color=color, markersize=3.5, alpha=0.7, label=state)
    ax.tick_params(colors=QUIET, labelsize=7.0)
