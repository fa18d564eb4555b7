"""The reality gap in figures: returns at home and in other worlds, as Tan et al. 2018 draw them, and runs over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.evaluate.gap import PolicyGap
from surefoot.evaluate.runs import Runs
from surefoot.report.style import INK, QUIET, capital, heading, new_figure, place_labels, scattered, spoken
from surefoot.task.trace import EpisodeTrace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GROUP = 0.8
"""Width of the bars of a policy, where policies are 1 apart."""
_PALE = 0.5
_MOST_DOTS = 100
_ZOOM = 1.0
"""Length [s] of the part that angles are drawn of: they could not be told apart over a whole episode."""
_POWER_MEAN = 0.5
"""Time [s] over which power is averaged: it swings with every step."""


def gap_figure(policies: Sequence[PolicyGap], path: str | Path) -> Path:
    """Draw the return of each policy as bars, a bar a world, with one standard error and every run as a dot.

    Below each policy stands its gap to each other world; over a bar, how many of the runs fell, if any did: they are
    crosses.

    Args:
        policies: one or more, or groups of policies, run in the same worlds.
        path: PNG to write.

    Raises:
        SurefootError: no policy, or policies that were run in different worlds.
    """
    worlds = {tuple(runs.world for runs in policy.runs) for policy in policies}
    if len(worlds) != 1:
        raise SurefootError(f"gap figure: {len(policies)} policies in {len(worlds)} sets of worlds; it takes one set")
    (names,) = worlds
    width = max(5.2, 1.2 + len(policies) * max(1.6 if len(names) < 3 else 2.3, 0.62 * len(names)))
    with new_figure(path, (width, 3.9 + 0.16 * len(names))) as (_, (ax,)):
        for place, policy in enumerate(policies):
            for number, runs in enumerate(policy.runs):
                _bar(ax, place, number, len(names), runs)
        ax.axhline(0.0, color=QUIET, linewidth=0.8)
        place_labels(ax, [_label(policy) for policy in policies])
        ax.set_xlim(-0.5, len(policies) - 0.5)
        ax.margins(y=0.12)
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.set_title("Return of an episode (m)", fontweight="bold", pad=24.0)
        said = "bars: mean and one standard error; dots: runs, crosses: runs that ended in a fall"
        ax.set_xlabel(said, color=QUIET, fontsize=8.0, labelpad=6.0)
        for number, name in enumerate(names):
            label = name if number else f"{name} (home)"
            ax.bar(0, 0, color=f"C{number}", alpha=_PALE, label=label)
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2, columnspacing=1.4)
    return Path(path)


def _bar(ax: Axes, place: int, number: int, count: int, runs: Runs) -> None:
    """Draw one policy's returns in one of `count` worlds."""
    wide, color = _GROUP / count, f"C{number}"
    x = place + wide * (number - (count - 1) / 2)
    gained, known = runs.estimate("returns"), np.isfinite(runs.returns)
    top, said = 0.0, []
    if math.isfinite(gained.mean):
        error = gained.error if math.isfinite(gained.error) else 0.0
        ax.bar(x, gained.mean, 0.9 * wide, color=color, alpha=_PALE, linewidth=0)
        ax.errorbar(x, gained.mean, error, color=INK, linewidth=1.3, capsize=4.0, zorder=3)
        if 1 < known.sum() <= _MOST_DOTS:
            across = x + scattered(len(runs), 0.5 * wide)
            for some, marker in ((known & ~runs.fell, "o"), (known & runs.fell, "x")):
                ax.plot(across[some], runs.returns[some], marker, color=color, markersize=3.6, alpha=0.9)
        top = max(gained.mean + error, float(runs.returns[known].max()), 0.0)
    else:
        said = ["return\nnot known"]
    if runs.fell.any():
        said.append(f"{runs.fell.sum()} of {len(runs)}\nfell")
    text, offset = "\n".join(said), (0, 4)
    ax.annotate(text, (x, top), offset, textcoords="offset points", ha="center", va="bottom", fontsize=7.5, color=INK)


def _label(policy: PolicyGap) -> str:
    """Return a policy's name, and below it its gap to each other world."""
    lines = []
    for runs in policy.away:
        gap = policy.gap(runs.world).mean
        where = f"gap to {runs.world}" if len(policy.away) > 1 else "gap"
        lines.append(f"{where} {gap:+.2f} m" if math.isfinite(gap) else f"{where} -")
    return "\n".join([*policy.name.split(", "), *lines])


def side_by_side(runs: Mapping[str, Sequence[EpisodeTrace]], path: str | Path, title: str) -> Path:
    """Draw where the robot was, its power, its tilt, and one motor in a second of the gait, for runs in several worlds.

    Distance, side and power are drawn of every run; tilt and motor of the first run in each world. What a trace does
    not know is left out, such as the place of a robot that no motion capture sees.

    Args:
        runs: traces by world, home first; at least one each.
        path: PNG to write.
        title: over the panels.
    """
    with new_figure(path, (9.0, 7.0), rows=3, columns=2) as (figure, axes):
        distance, aside, power, pitch, roll, motor = axes
        for number, (world, traces) in enumerate(runs.items()):
            color = f"C{number}"
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
