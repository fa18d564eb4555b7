"""Common colours, style and helpers of all figures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 130
INK, QUIET, GRID = "#22272e", "#6b7480", "#e3e7eb"
BLUE, ORANGE, GREEN = "#1f5fa8", "#c4560f", "#2f8f5b"
COLORS = (BLUE, ORANGE, GREEN, "#7a4fa3", "#a8324a", "#1d8a99", "#5a6b1f", "#8a6d3b")
"""Colours of policies, groups or worlds in order (matplotlib's C0, C1, ...), repeated if there are more."""
MARKERS = "osD^vPX*"
# Front feet blue, hind feet orange, left dark, right light: distinguishable with colour blindness.
LEG_COLORS = {"front_left": BLUE, "front_right": "#6aa5e0", "back_left": ORANGE, "back_right": "#f0a35e"}

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "text.parse_math": False,  # names from files may have a $
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.prop_cycle": f"cycler('color', {COLORS})",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "legend.handlelength": 1.4,
}


@contextmanager
def new_figure(
    path: str | Path, size: tuple[float, float], rows: int = 1, columns: int = 1, **options: Any
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Context manager that yields a new figure in the common style and its axes, row by row, and writes it to `path`.

    `path` must end in .png; `options` are passed to matplotlib's `Figure.subplots`. The user's own style is not used,
    and no display is needed.
    """
    import matplotlib.style
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    path = Path(path)
    if path.suffix.lower() != ".png":
        raise SurefootError(f"figure {path}: the name must end in .png")
    with rc_context(), matplotlib.style.context(["default", _STYLE]):
        padding = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08, wspace=0.03, hspace=0.03)
        figure = Figure(figsize=size, dpi=DPI, layout=padding)
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, columns, squeeze=False, **options)
        yield figure, list(axes.flat)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=DPI, facecolor="white")


def heading(figure: Figure, text: str) -> None:
    """Add a bold title above all panels."""
    figure.suptitle(text, x=0.01, ha="left", fontweight="bold", color=INK, wrap=True)


def place_labels(axis: Axes, labels: list[str], vertical: bool = False) -> None:
    """Label the positions 0, 1, ... of a categorical axis, without ticks and grid."""
    name = "y" if vertical else "x"
    (axis.set_yticks if vertical else axis.set_xticks)(range(len(labels)), labels)
    axis.tick_params(axis=name, length=0)  # type: ignore[arg-type]
    axis.grid(visible=False, axis=name)  # type: ignore[arg-type]


def spread_dots(count: int, width: float) -> Array:
    """Return offsets (count,) around 0 that spread dots evenly over a width, by the golden ratio."""
    return np.asarray(width * ((np.arange(count) * 0.618034) % 1.0 - 0.5), np.float64)


def humanize(name: str) -> str:
    """Return a name in words, such as front left for front_left."""
    return name.replace("_", " ").replace("imu", "IMU")


def capitalize_first(text: str) -> str:
    """Return text with its first letter capitalized."""
    return text[0].upper() + text[1:]
