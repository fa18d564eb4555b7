"""Figures of a sensitivity study: the return against one physical parameter, and over all test worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from surefoot.errors import SurefootError
from surefoot.evaluate.sensitivity import Sensitivity, row_unit
from surefoot.report.figures import BLUE, GREEN, ORANGE, _figure, _spoken

COLORS = (BLUE, ORANGE, GREEN, "#7a4fa3", "#a8324a", "#5a6b1f", "#1d8a99", "#8a6d3b")
"""One a policy, in order; more policies begin anew."""
MARKERS = "osD^vPX*"

Ranges = Mapping[str, tuple[float, float]]


def parameter_figure(
    row: str,
    sensitivities: Sequence[Sensitivity],
    path: str | Path,
    trained_ranges: Mapping[str, Ranges] | None = None,
) -> Path:
    """Draw the mean return against a row's value, with standard errors, and the share of falls below.

    Args:
        row: row of the table of ranges.
        sensitivities: one or more policies; those whose study lacks the row are left out.
        path: PNG to write.
        trained_ranges: by policy name, the ranges that it was trained with, by row; a policy without a range was
            trained at the nominal value. Without this nothing is said about training.

    Raises:
        SurefootError: a row that no study has.
    """
    shown = [(number, result) for number, result in enumerate(sensitivities) if row in result.rows]
    if not shown:
        raise SurefootError(f"parameter figure: row '{row}' is in none of {len(sensitivities)} studies")
    with _figure(path, (6.4, 4.4), rows=2) as (_, (top, bottom)):
        for number, result in shown:
            rows = result.of_row(row)
            value = np.array([result.worlds[i].value for i in rows])
            color = COLORS[number % len(COLORS)]
            error = np.nan_to_num(result.standard_error[rows])
            top.errorbar(value, result.mean_return[rows], error, color=color, label=result.policy, capsize=2.0)
            bottom.plot(value, 100 * result.fell[rows].mean(axis=1), color=color)
        top.legend()
        unit = row_unit(row)
        bottom.set_xlabel(f"{_spoken(row)} ({unit})" if unit else _spoken(row))
    return Path(path)


def aggregate_figure(sensitivities: Sequence[Sensitivity], path: str | Path) -> Path:
    """Draw a bar for each policy: the mean return over all its test worlds, with the standard deviation.

    Args:
        sensitivities: one or more policies.
        path: PNG to write.
    """
    if not sensitivities:
        raise SurefootError("aggregate figure: no study is given; it takes 1 or more")
    with _figure(path, (1.6 + 1.2 * len(sensitivities), 3.4)) as (_, (ax,)):
        for number, result in enumerate(sensitivities):
            ax.bar(number, result.mean, yerr=result.std, color=COLORS[number % len(COLORS)], capsize=4.0)
        ax.set_xticks(range(len(sensitivities)), [result.policy for result in sensitivities])
    return Path(path)
