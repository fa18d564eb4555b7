"""Runs of one policy in several worlds over time, drawn over each other: where they part, and in what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.report.style import COLORS, capital, heading, new_figure, spoken
from surefoot.task.trace import EpisodeTrace

Array = NDArray[np.float64]
_ZOOM = 1.0
"""Length [s] of the part that angles are drawn of: they could not be told apart over a whole episode."""
_POWER_MEAN = 0.5
"""Time [s] over which power is averaged: it swings with every step."""


def side_by_side(runs: Mapping[str, Sequence[EpisodeTrace]], path: str | Path, title: str) -> Path:
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
    with new_figure(path, (9.0, 7.0), rows=3, columns=2) as (figure, axes):
        distance, aside, power, pitch, roll, motor = axes
        for number, (world, traces) in enumerate(runs.items()):
            color = COLORS[number % len(COLORS)]
            for trace in traces:
                moved = trace.base_position_world - trace.base_position_world[0]
                for ax, column in ((distance, 0), (aside, 1)):
                    ax.plot([0.0, *trace.time], moved[:, column], color=color, linewidth=1.1, alpha=0.85)
                power.plot(*_mean_power(trace), color=color, linewidth=1.1, alpha=0.85)
            first = traces[0]
            # A second in the middle of the run, when it has found its gait.
            start = max((first.duration - _ZOOM) / 2, 0.0)
            shown = (first.time >= start) & (first.time <= start + _ZOOM)
            angles = ((pitch, first.roll_pitch_yaw[:, 1]), (roll, first.roll_pitch_yaw[:, 0]))
            for ax, values in (*angles, (motor, first.motor_angle[:, 0])):
                ax.plot(first.time[shown], values[shown], color=color, linewidth=1.1)
            motor.plot(first.time[shown], first.target[shown, 0], color=color, linewidth=0.9, linestyle=":")
            distance.plot([], [], color=color, label=f"{world}, {len(traces)} run{'s' if len(traces) > 1 else ''}")
        distance.plot([], [], color="black", linestyle=":", label="command")
        for ax, text in (
            (distance, "Distance forward (m)"),
            (aside, "To the left (m)"),
            (power, f"Mechanical power over {_POWER_MEAN:g} s (W)"),
            (pitch, "Pitch as measured (rad)"),
            (roll, "Roll as measured (rad)"),
            (motor, f"{capital(spoken(first.meta['motor_names'][0]))} (rad)"),
        ):
            ax.set_title(text)
        power.set_ylim(bottom=0.0)
        for ax in (roll, motor):
            ax.set_xlabel("time (s)")
        figure.legend(*distance.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        heading(figure, title)
    return Path(path)


def _mean_power(trace: EpisodeTrace) -> tuple[Array, Array]:
    """Times [s] and power [W], each over the `_POWER_MEAN` seconds before it, or as long as the run has lasted."""
    energy, times = np.concatenate([[0.0], np.cumsum(trace.energy)]), np.concatenate([[0.0], trace.time])
    start = np.maximum(trace.time - _POWER_MEAN, 0.0)
    return trace.time, (energy[1:] - np.interp(start, times, energy)) / (trace.time - start)
