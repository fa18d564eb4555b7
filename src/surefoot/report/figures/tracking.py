"""Heat map of the command tracking error of a policy over a grid of commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.arrays import Array
from surefoot.evaluation.tracking import Tracking
from surefoot.report.figures.style import new_figure
from surefoot.robot.commands import COMMANDS
from surefoot.task.trace import EpisodeTrace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_ERROR = {"m/s": 0.2, "rad/s": 0.4}
"""Errors at which the colour scale ends."""
_NAMES = ("forward", "lateral", "yaw rate")


def tracking_figure(traces: Sequence[EpisodeTrace], path: str | Path) -> Path:
    """Draw the stride-averaged errors of runs with one constant command each; a cross marks a fall.

    One row of panels shows forward and yaw rate commands; a second row shows forward and lateral commands, if any.
    """
    commands = np.array([trace.command[0] for trace in traces])
    errors = np.array([Tracking.from_traces([trace]).rmse_stride for trace in traces])
    fell = np.array([trace.fell for trace in traces])
    across = [2, *([1] if commands[:, 1].any() else [])]
    with new_figure(path, (10.0, 3.1 * len(across)), len(across), 3) as (figure, axes):
        for row, other in enumerate(across):
            chosen = commands[:, 3 - other] == 0
            for k, (name, unit) in enumerate(zip(_NAMES, COMMANDS.values(), strict=True)):
                ax = axes[3 * row + k]
                image = _panel(ax, commands[chosen][:, [0, other]], errors[chosen, k], fell[chosen], _MAX_ERROR[unit])
                ax.set_title(f"error {name}")
                ax.set_xlabel("forward (m/s)")
                ax.set_ylabel(f"{_NAMES[other]} ({list(COMMANDS.values())[other]})")
                figure.colorbar(image, ax=ax, label=f"stride-averaged RMSE ({unit})")
    return Path(path)


def _panel(ax: Axes, commands: Array, errors: Array, fell: Array, max_error: float) -> Any:
    """Draw errors (N,) as a heat map over two commands (N, 2); return the image for a colour bar."""
    x, y = (np.unique(commands[:, k]) for k in range(2))
    table = np.full((len(y), len(x)), np.nan)
    places = np.searchsorted(y, commands[:, 1]), np.searchsorted(x, commands[:, 0])
    table[places] = errors
    ax.grid(visible=False)
    image = ax.pcolormesh(x, y, table, shading="nearest", cmap="viridis_r", vmin=0.0, vmax=max_error)
    ax.plot(commands[fell, 0], commands[fell, 1], "x", color="#a8324a")
    return image
