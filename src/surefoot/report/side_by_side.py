"""Runs of one policy in several worlds over time, drawn over each other: where they part, and in what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.report.figures import _figure
from surefoot.report.gap_figures import COLORS
from surefoot.task.trace import EpisodeTrace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
_ZOOM = 1.0
"""Length [s] of the part that angles are drawn of: they could not be told apart over a whole episode."""
_POWER_MEAN = 0.5
"""Time [s] over which power is averaged: it swings with every step."""


def side_by_side(runs: Mapping[str, Sequence[EpisodeTrace]], path: str | Path, title: str = "") -> Path:
    """Draw where the robot was, its power, its tilt, and one motor in a second of the gait, for runs in several worlds.

    Distance, side and power are drawn of every run; tilt and motor of the first run in each world. What a trace does
    not know is left out, such as the place of a robot that no motion capture sees.

    Args:
        runs: traces by world, home first; at least one each.
        path: PNG to write.
        title: over the panels.

    Raises:
        SurefootError: no world, or one without runs.
    """
    if not runs or not all(runs.values()):
        raise SurefootError("runs side by side: every world needs one run or more")
    with _figure(path, (9.0, 7.0), rows=3, columns=2) as (figure, axes):
        distance, aside, power, pitch, roll, motor = axes
        for (world, traces), color in zip(runs.items(), _colors(len(runs)), strict=True):
            for trace in traces:
                _runs_of(trace, (distance, aside, power), color)
            _tilt_of(traces[0], (pitch, roll), color)
            _motor_of(traces[0], motor, color)
            distance.plot([], [], color=color, label=f"{world}, {len(traces)} run{'s' if len(traces) > 1 else ''}")
        distance.plot([], [], color="black", linestyle=":", label="command")
        name = next(iter(runs.values()))[0].meta["motor_names"][0].replace("_", " ")
        for ax, text in (
            (distance, "Distance forward (m)"),
            (aside, "To the left (m)"),
            (power, f"Mechanical power over {_POWER_MEAN:g} s (W)"),
            (pitch, "Pitch as measured (rad)"),
            (roll, "Roll as measured (rad)"),
            (motor, f"{name[0].upper()}{name[1:]} (rad)"),
        ):
            ax.set_title(text)
        power.set_ylim(bottom=0.0)
        for ax in (roll, motor):
            ax.set_xlabel("time (s)")
        figure.legend(*distance.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        if title:
            figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    return Path(path)


def _colors(count: int) -> list[str]:
    return [COLORS[number % len(COLORS)] for number in range(count)]


def _runs_of(trace: EpisodeTrace, axes: tuple[Axes, Axes, Axes], color: str) -> None:
    """Distance, side and power of one run."""
    distance, aside, power = axes
    moved = trace.base_position_world - trace.base_position_world[0]
    times = np.concatenate([[0.0], trace.time])
    for ax, column in ((distance, 0), (aside, 1)):
        ax.plot(times, moved[:, column], color=color, linewidth=1.1, alpha=0.85)
    smooth_at, smooth = _mean_power(trace)
    power.plot(smooth_at, smooth, color=color, linewidth=1.1, alpha=0.85)


def _mean_power(trace: EpisodeTrace) -> tuple[Array, Array]:
    """Times [s] and power [W], each over the `_POWER_MEAN` seconds before it, or as long as the run has lasted."""
    energy, times = np.concatenate([[0.0], np.cumsum(trace.energy)]), np.concatenate([[0.0], trace.time])
    start = np.maximum(trace.time - _POWER_MEAN, 0.0)
    return trace.time, (energy[1:] - np.interp(start, times, energy)) / (trace.time - start)


def _window(trace: EpisodeTrace) -> NDArray[np.bool_]:
    """A second in the middle of a run, when it has found its gait."""
    start = max((trace.duration - _ZOOM) / 2, 0.0)
    return (trace.time >= start) & (trace.time <= start + _ZOOM)


def _tilt_of(trace: EpisodeTrace, axes: tuple[Axes, Axes], color: str) -> None:
    pitch, roll = axes
    shown = _window(trace)
    for ax, column in ((pitch, 1), (roll, 0)):
        ax.plot(trace.time[shown], trace.roll_pitch_yaw[shown, column], color=color, linewidth=1.1)


def _motor_of(trace: EpisodeTrace, ax: Axes, color: str) -> None:
    """The first motor as measured, and what it was told."""
    shown = _window(trace)
    ax.plot(trace.time[shown], trace.motor_angle[shown, 0], color=color, linewidth=1.1)
    ax.plot(trace.time[shown], trace.target[shown, 0], color=color, linewidth=0.9, linestyle=":")
