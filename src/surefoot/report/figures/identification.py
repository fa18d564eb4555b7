"""Figure of an identification: intervals relative to prior values, correlations, measured and simulated series.

The report's page uses the same names and number formats.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.identify.result import Identification, ParameterEstimate, Series
from surefoot.report.figures.style import BLUE, INK, LEG_COLORS, ORANGE, QUIET, humanize, new_figure
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH = 11.0
_PAPER: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
_BAR: dict[str, Any] = {"fmt": "o", "markersize": 4.5, "capsize": 3.0, "linewidth": 1.6}
_SMALL: dict[str, Any] = {"va": "center", "ha": "center", "fontsize": 7.5, "bbox": _PAPER}
_COLUMNS = 3
_MAX_POINTS = 2000
"""Maximum number of points drawn per series; more would not be visible."""
_MAX_DIGITS = 6
"""Maximum number of decimals; numbers that need more are written in scientific notation."""


def identification_figure(
    result: Identification, robot: RobotDescription, prior: PhysicalParams, path: str | Path
) -> Path:
    """Draw an identification.

    Intervals of scalar parameters are drawn in percent of the `prior` values (one row); parameters with one value per
    motor have one panel each, in their unit. Panels below show measured series, and simulated ones before and after.
    """
    single, several = _group(result.estimates)
    rows: list[tuple[float, list[float], list[Callable[[Axes], None]]]] = []
    panels: list[Callable[[Axes], None]] = []
    if single:
        panels.append(partial(_intervals, items=single, robot=robot, prior=prior))
    if result.correlations:
        panels.append(partial(_correlations, result=result, robot=robot))
    if panels:
        height = 1.1 + max(0.25 * len(single), 0.62 * max(len(result.correlations), 2))
        rows.append((height, [1.5, 1.0][: len(panels)], panels))
    for i in range(0, len(several), _COLUMNS):
        panels = [partial(_motors, items=group, robot=robot, prior=prior) for group in several[i : i + _COLUMNS]]
        rows.append((2.7, [1.0] * len(panels), panels))
    for i in range(0, len(result.series), 2):
        panels = [partial(_series, series=one) for one in result.series[i : i + 2]]
        rows.append((3.0, [1.0] * len(panels), panels))
    with new_figure(path, (WIDTH, sum(height for height, _, _ in rows) + 0.5)) as (figure, (unused,)):
        unused.remove()
        figure.suptitle(f"{result.experiment}: {result.robot}", x=0.01, ha="left", fontweight="bold")
        if rows:
            # One subfigure per row, so that the labels of one row do not affect the layout of another.
            parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=[height for height, _, _ in rows])
            for part, (_, widths, panels) in zip(parts[:, 0], rows, strict=True):
                axes = part.subplots(1, len(panels), squeeze=False, width_ratios=widths)
                for ax, draw in zip(axes[0], panels, strict=True):
                    draw(ax)
    return Path(path)


def _group(estimates: Sequence[ParameterEstimate]) -> tuple[list[ParameterEstimate], list[list[ParameterEstimate]]]:
    """Split estimates into single ones (scalars, vector components) and groups with one estimate per motor."""
    groups: dict[str, list[ParameterEstimate]] = {}
    for item in estimates:
        groups.setdefault(item.name, []).append(item)
    several = [group for group in groups.values() if group[0].index is not None and len(group) > 3]
    single = [item for group in groups.values() if group not in several for item in group]
    return single, several


def _intervals(ax: Axes, items: Sequence[ParameterEstimate], robot: RobotDescription, prior: PhysicalParams) -> None:
    """Draw intervals in percent of the prior values, except if the prior is 0 or missing."""
    reach = 1.0
    for place, item in enumerate(items):
        before, (low, high) = prior_value(item, prior), item.interval
        unit = "" if item.unit == "1" else f" {item.unit}"
        width = high - low
        if not item.identifiable:
            ax.text(0.5, place, "not identifiable", transform=ax.get_yaxis_transform(), **_SMALL, color=QUIET)
            text = ""
        else:
            text = f"{number(item.value, width)}  ({number(low, width)} to {number(high, width)}){unit}"
            if before is None or before == 0:
                remark = "no prior" if before is None else "prior is 0"
                ax.text(0.5, place, remark, transform=ax.get_yaxis_transform(), **_SMALL, color=QUIET)
            else:
                low, value, high = (100 * (x / before - 1) for x in (low, item.value, high))
                low, high = min(low, high), max(low, high)
                ax.errorbar(value, place, xerr=[[value - low], [high - value]], **_BAR, color=BLUE)
                reach = max(reach, abs(low), abs(high))
        ax.text(1.02, place, text, transform=ax.get_yaxis_transform(), va="center", fontsize=8.0, color=INK)
    ax.axvline(0.0, color=QUIET, linewidth=0.9, linestyle=(0, (4, 3)), zorder=0.5)
    ax.set_xlim(-1.12 * reach, 1.12 * reach)
    ax.set_ylim(len(items) - 0.4, -0.6)
    ax.set_yticks(range(len(items)), [humanize(full_name(item.label, robot)) for item in items])
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("difference from the prior value (%), 95 % interval")
    ax.set_title("Scalar parameters", fontweight="bold")


def _correlations(ax: Axes, result: Identification, robot: RobotDescription) -> None:
    """Draw the correlations of pairs of parameters; pairs near +1 or -1 are indistinguishable."""
    pairs = result.correlations
    for place, (one, other, value) in enumerate(pairs):
        ax.barh(place, value, 0.3, color=ORANGE if value < 0 else BLUE, alpha=0.45, linewidth=0)
        text = "\nand ".join(humanize(full_name(label, robot)) for label in (one, other))
        ax.text(0.0, place - 0.42, text, **_SMALL, linespacing=1.0)
        ax.text(value / 2, place, f"{value:+.2f}", ha="center", va="center", fontsize=7.5, color=INK)
    ax.axvline(0.0, color=QUIET, linewidth=0.9, zorder=0.5)
    ax.set_xlim(-1.0, 1.0)
    ax.set_ylim(max(len(pairs), 2) - 0.6, -0.8)
    ax.set_yticks([])
    ax.grid(visible=False)
    ax.set_xlabel("correlation of their errors")
    ax.set_title("Hardly distinguishable", fontweight="bold")


def _motors(ax: Axes, items: Sequence[ParameterEstimate], robot: RobotDescription, prior: PhysicalParams) -> None:
    """Draw a parameter of each motor with its interval, and the prior value."""
    count = max(item.index or 0 for item in items) + 1
    names = index_names(items[0].name, robot)
    if len(names) < count:
        names = tuple(map(str, range(count)))
    for item in items:
        place, before = item.index or 0, prior_value(item, prior)
        if before is not None:
            ax.plot([place - 0.38, place + 0.38], [before, before], color=QUIET, linewidth=1.2, linestyle=(0, (2, 1.5)))
        if not item.identifiable:
            ax.text(place, 0.04, "not identifiable", transform=ax.get_xaxis_transform(), rotation=90, ha="center",
                    va="bottom", fontsize=7.5, color=QUIET, bbox=_PAPER)  # fmt: skip
            continue
        low, high = item.interval
        leg = names[place].rsplit("_", 1)[0]
        ax.errorbar(place, item.value, yerr=[[max(item.value - low, 0.0)], [max(high - item.value, 0.0)]], **_BAR,
                    color=LEG_COLORS.get(leg, BLUE))  # fmt: skip
    ax.set_xlim(-0.7, len(names) - 0.3)
    labels = [humanize(name) for name in names]
    ax.set_xticks(range(len(names)), labels, rotation=40, ha="right", rotation_mode="anchor", fontsize=7.5)
    ax.tick_params(axis="x", length=0)
    ax.grid(visible=False, axis="x")
    unit = "" if items[0].unit == "1" else f" ({items[0].unit})"
    ax.set_title(f"{humanize(items[0].name).capitalize()}{unit}", fontweight="bold", pad=18.0)
    ax.text(0.0, 1.03, "dashed: prior", transform=ax.transAxes, fontsize=7.5, color=QUIET)
    ax.margins(y=0.15)


def _series(ax: Axes, series: Series) -> None:
    """Draw a measured series, and the series simulated with the prior parameters and with the estimates."""
    stride = max(math.ceil(len(series.x) / _MAX_POINTS), 1)
    x = np.asarray(series.x, float)[::stride]
    curves: tuple[tuple[str, Any, dict[str, Any]], ...] = (
        ("before", series.before, {"color": ORANGE, "linewidth": 1.1, "linestyle": (0, (4, 2))}),
        ("after", series.after, {"color": BLUE, "linewidth": 1.3}),
    )
    measured = np.asarray(series.measured, float)[::stride]
    if series.points:
        ax.plot(x, measured, "o", color=INK, markersize=3.5, label="measured", zorder=1)
    else:
        ax.plot(x, measured, color="#a9b1ba", linewidth=3.0, label="measured", zorder=1)
    for name, values, style in curves:
        values = np.asarray(values, float)[::stride]
        if np.isfinite(values).any():
            ax.plot(x, values, label=name, **style)
    ax.set_xlabel(_brackets(series.x_label))
    ax.set_ylabel(_brackets(series.y_label))
    title = series.title
    ax.set_title(
        title[:1].upper() + title[1:] if "_" not in title.split(" ")[0] else title, fontweight="bold", pad=20.0
    )
    ax.margins(x=0.01)
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2, columnspacing=1.4)


def _brackets(label: str) -> str:
    """Replace square brackets around units by round ones, as in other figures."""
    return label.replace("[", "(").replace("]", ")")


def index_names(name: str, robot: RobotDescription) -> tuple[str, ...]:
    """Return the names of a parameter's components (motors or axes); empty for a scalar."""
    motors = tuple(motor.removesuffix("_motor") for motor in robot.motor_names)
    if name not in PARAMETERS:
        return motors if name.startswith(("motor", "torque")) else ("x", "y", "z")
    return PARAMETERS[name].element_names(motors)


def full_name(label: str, robot: RobotDescription) -> str:
    """Return an estimate's label with the name of the motor or axis instead of its index."""
    name, _, rest = label.partition("[")
    names = index_names(name, robot)
    index = int(rest.rstrip("]")) if rest.rstrip("]").isdigit() else -1
    return f"{name} {names[index]}" if 0 <= index < len(names) else label


def prior_value(item: ParameterEstimate, prior: PhysicalParams) -> float | None:
    """Return the prior value of a physical parameter; None for other estimates."""
    if item.name not in PhysicalParams.names():
        return None
    values = getattr(prior, item.name)[0]
    return float(np.mean(values) if item.index is None else np.atleast_1d(values)[item.index])


def cells(item: ParameterEstimate, prior: PhysicalParams) -> tuple[str, str, str]:
    """Return the prior value, the estimate and its interval as texts, which are empty if there is no value."""
    before, (low, high) = prior_value(item, prior), item.interval
    width = high - low if item.identifiable else math.nan
    prior_text = "" if before is None else number(before, width)
    if not item.identifiable:
        return prior_text, "not identifiable", ""
    return prior_text, number(item.value, width), f"{number(low, width)} to {number(high, width)}"


def number(value: float, width: float) -> str:
    """Format a number, rounded to two significant digits of half the width of its interval (NaN without interval)."""
    if not (math.isfinite(width) and width > 0 and math.isfinite(value)):
        return f"{value:.4g}"
    digits = 1 - math.floor(math.log10(width / 2))
    return f"{value:.{max(digits, 0)}f}" if digits <= _MAX_DIGITS else f"{value:.3g}"
