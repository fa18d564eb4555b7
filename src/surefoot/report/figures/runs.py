"""Figures over time of an episode, runs in several worlds, or a motor; each writes a PNG and returns its path."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.evaluation.footfalls import Footfalls, analyze_footfalls
from surefoot.evaluation.runs import measure_runs
from surefoot.evaluation.tracking import measured_velocity
from surefoot.report.figures.style import (
    BLUE,
    GREEN,
    INK,
    LEG_COLORS,
    ORANGE,
    QUIET,
    capitalize_first,
    heading,
    humanize,
    new_figure,
    place_labels,
)
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DIAGRAM_ORDER = ("back_left", "front_left", "front_right", "back_right")
"""Hildebrand's order of legs, in which a trot appears as a diagonal pattern."""
_DIAGRAM_TIME = 2.0
"""Duration of a footfall diagram [s]."""
_ZOOM_TIME = 1.0
"""Duration of plots of angles [s]."""
_MEAN_TIME = 0.5
"""Averaging time of speed and power, which oscillate with every step [s]."""
STYLES = {"dc": (ORANGE, "servo and DC motor"), "constraint": (GREEN, "constraint motor")}
"""Colour and label of each actuator model."""


def footfall_diagram(trace: EpisodeTrace, path: str | Path) -> Path:
    """Draw a Hildebrand diagram of two seconds of a trace after the transient, with a bar for each stance of a foot."""
    with new_figure(path, (8.0, 2.4)) as (_, (ax,)):
        feet = analyze_footfalls(trace)
        _stance_bars(ax, feet)
        ax.set_title(f"{_name(trace)}:  {feet.gait}", fontweight="bold", pad=20.0)
        ax.text(0.0, 1.06, _stride_text(feet), transform=ax.transAxes, color=QUIET, fontsize=8.0)
        ax.set_xlabel("time (s)")
    return Path(path)


def episode_plot(trace: EpisodeTrace, robot: RobotDescription, path: str | Path) -> Path:
    """Draw an episode: tilt, speed and power over its whole duration, and measured leg coordinates over one second.

    With velocity commands also the velocities and yaw rate with their commands, and the path seen from above.
    """
    step = np.diff(trace.elapsed, prepend=0.0)
    run, steered = measure_runs([trace]).iloc[0], bool(np.isfinite(trace.command).any())
    rows = 4 if steered else 3
    with new_figure(path, (9.0, 2.3 * rows), rows=rows, columns=2) as (figure, axes):
        tilt, *motions, power, left, right = axes
        for name, color, angle in (
            ("roll", BLUE, trace.roll_pitch_yaw[:, 0]),
            ("pitch", ORANGE, trace.roll_pitch_yaw[:, 1]),
        ):
            tilt.plot(trace.elapsed, angle, color=color, label=name, linewidth=1.0)
        tilt.set_title("Roll and pitch as measured (rad)")
        if steered:
            _tracking(motions, trace)
        else:
            turn, speed = motions
            turn.plot(trace.elapsed, np.unwrap(trace.roll_pitch_yaw[:, 2]), color=GREEN, linewidth=1.0)
            turn.set_title("Yaw as measured (rad)")
            forward = np.diff(trace.base_position_world[:, 0]) / step
            _raw_and_smooth(speed, trace, forward, BLUE, run.speed, "m/s")
            speed.set_title("Forward speed (m/s)")
        _raw_and_smooth(power, trace, trace.energy / step, ORANGE, run.power, "W")
        power.set_title("Mechanical power (W)")
        for ax in (tilt, *motions[: 3 if steered else 2], power):
            ax.set_xlim(0.0, trace.duration)
        power.set_ylim(bottom=0.0)
        start = min(max(trace.duration - _ZOOM_TIME, 0.0), 2.0)
        shown = (trace.elapsed >= start) & (trace.elapsed <= start + _ZOOM_TIME)
        poses = robot.to_pose(trace.motor_angle[shown])
        for ax, place in zip((left, right), (-2, -1), strict=True):
            angle, name, unit = poses[:, place], robot.coordinates[place], robot.leg_geometry.units[place]
            for index, leg in enumerate(trace.leg_names):
                # Dashed lines do not hide the curve of another foot that moves in phase.
                line = "--" if "right" in leg else "-"
                color = LEG_COLORS.get(leg, f"C{index}")
                ax.plot(trace.elapsed[shown], angle[:, index], line, color=color, label=humanize(leg))
            ax.set_title(f"Leg: {name} over one second{'' if unit == '1' else f' ({unit})'}")
            ax.set_xlim(start, start + _ZOOM_TIME)
            ax.set_xlabel("time (s)")
        _legend_above(tilt)
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=len(trace.leg_names))
        heading(figure, f"{_name(trace)}, end: {trace.meta['ended']}")
    return Path(path)


def _tracking(axes: Sequence[Axes], trace: EpisodeTrace) -> None:
    """Draw forward and lateral velocity and yaw rate with their commands, and the path from above, one panel each."""
    *speeds, path = axes
    measured = measured_velocity(trace)
    titles = ("Forward velocity (m/s)", "Lateral velocity (m/s)", "Yaw rate (rad/s)")
    for column, (ax, title, color) in enumerate(zip(speeds, titles, (BLUE, ORANGE, GREEN), strict=True)):
        _raw_and_smooth(ax, trace, measured[:, column], color, math.nan, "")
        ax.step(trace.elapsed, trace.command[:, column], where="pre", color=INK, linewidth=1.0, label="command")
        ax.set_title(title)
    _legend_above(speeds[0])
    moved = trace.base_position_world - trace.base_position_world[0]
    path.plot(moved[:, 0], moved[:, 1], color=BLUE, linewidth=1.2)
    path.plot(0.0, 0.0, "o", color=INK, markersize=4.0)
    path.set_title("Path from above: forward, left (m)")
    path.set_aspect("equal", adjustable="datalim")


def _stance_bars(ax: Axes, feet: Footfalls) -> None:
    """Draw each foot's stances as bars, starting after the transient."""
    first = [leg for leg in _DIAGRAM_ORDER if leg in feet.intervals]
    legs = [*first, *(leg for leg in feet.intervals if leg not in first)][::-1]
    start = feet.window[0]
    end = min(start + _DIAGRAM_TIME, feet.window[1])
    for row, leg in enumerate(legs):
        bars = [(max(a, start), min(b, end) - max(a, start)) for a, b in feet.intervals[leg] if b > start and a < end]
        ax.broken_barh(bars, (row - 0.34, 0.68), facecolors=LEG_COLORS.get(leg, BLUE), linewidth=0)
    place_labels(ax, [f"{humanize(leg)} ({feet.duty_factor[leg]:.2f})" for leg in legs], vertical=True)
    ax.set_ylim(-0.6, len(legs) - 0.4)
    ax.set_xlim(start, end)


def _stride_text(feet: Footfalls) -> str:
    """Return a line with the footfall pattern and the stride period."""
    stride = f", stride {feet.stride_period:.2f} s" if math.isfinite(feet.stride_period) else ""
    return f"{feet.reason if feet.gait == 'other' else feet.pattern}{stride}; in brackets: duty factors"


def _raw_and_smooth(ax: Axes, trace: EpisodeTrace, values: Array, color: str, mean: float, unit: str) -> None:
    """Draw a signal in a faint color, its moving average, and the episode's mean as a line."""
    ax.plot(trace.elapsed, values, color=color, alpha=0.28, linewidth=0.7)
    width = min(max(round(_MEAN_TIME / float(trace.meta["control_step"])), 1), len(values))
    smooth = np.convolve(values, np.ones(width) / width, "valid")
    ax.plot(trace.elapsed[width // 2 : width // 2 + len(smooth)], smooth, color=color)
    if math.isfinite(mean):
        ax.axhline(mean, color=INK, linewidth=0.9, linestyle=(0, (4, 3)), label=f"mean {mean:.3g} {unit}")
        _legend_above(ax)


def _legend_above(ax: Axes) -> None:
    """Put the legend right of the title, where it does not cover a curve."""
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=4, borderaxespad=0.0, columnspacing=1.2)


def _name(trace: EpisodeTrace) -> str:
    return f"{trace.meta['policy'] or 'no policy'} in {trace.meta['world']}"


def side_by_side(runs: Mapping[str, Sequence[EpisodeTrace]], path: str | Path, title: str) -> Path:
    """Draw runs in several worlds: position and power of all runs; tilt and a motor over one second of the first runs.

    Missing quantities are not drawn, such as the position of a robot without motion capture.

    Args:
        runs: one or more traces per world, home world first.
        path: file to write (.png).
        title: title of the figure.
    """
    with new_figure(path, (9.0, 7.0), rows=3, columns=2) as (figure, axes):
        distance, aside, power, pitch, roll, motor = axes
        for number, (world, traces) in enumerate(runs.items()):
            color = f"C{number}"
            for trace in traces:
                moved = trace.base_position_world - trace.base_position_world[0]
                for ax, column in ((distance, 0), (aside, 1)):
                    ax.plot([0.0, *trace.elapsed], moved[:, column], color=color, linewidth=1.1, alpha=0.85)
                power.plot(*_mean_power(trace), color=color, linewidth=1.1, alpha=0.85)
            first = traces[0]
            start = max((first.duration - _ZOOM_TIME) / 2, 0.0)
            shown = (first.time >= start) & (first.time <= start + _ZOOM_TIME)
            angles = ((pitch, first.roll_pitch_yaw[:, 1]), (roll, first.roll_pitch_yaw[:, 0]))
            for ax, values in (*angles, (motor, first.motor_angle[:, 0])):
                ax.plot(first.time[shown], values[shown], color=color, linewidth=1.1)
            motor.plot(first.time[shown], first.target[shown, 0], color=color, linewidth=0.9, linestyle=":")
            distance.plot([], [], color=color, label=f"{world}, {len(traces)} run{'s' if len(traces) > 1 else ''}")
        distance.plot([], [], color="black", linestyle=":", label="command")
        for ax, text in (
            (distance, "Distance forward (m)"),
            (aside, "To the left (m)"),
            (power, f"Mechanical power over {_MEAN_TIME:g} s (W)"),
            (pitch, "Pitch as measured (rad)"),
            (roll, "Roll as measured (rad)"),
            (motor, f"{capitalize_first(humanize(first.meta['motor_names'][0]))} (rad)"),
        ):
            ax.set_title(text)
        power.set_ylim(bottom=0.0)
        for ax in (roll, motor):
            ax.set_xlabel("time (s)")
        figure.legend(*distance.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        heading(figure, title)
    return Path(path)


def _mean_power(trace: EpisodeTrace) -> tuple[Array, Array]:
    """Return times [s] and the mean power [W] over the preceding `_MEAN_TIME`, or since the start."""
    energy, times = np.concatenate([[0.0], np.cumsum(trace.energy)]), np.concatenate([[0.0], trace.elapsed])
    start = np.maximum(trace.elapsed - _MEAN_TIME, 0.0)
    return trace.elapsed, (energy[1:] - np.interp(start, times, energy)) / (trace.elapsed - start)


def motor_figure(
    path: Path,
    time: ArrayLike,
    target: ArrayLike,
    measured: ArrayLike,
    simulated: Mapping[str, ArrayLike],
    errors: Mapping[str, float],
    title: str,
) -> Path:
    """Draw target, measured angle and the angle of each motor model over time, and below the models' errors.

    Args:
        path: file to write (.png).
        time: times (T,) [s].
        target: target angles (T,) [rad].
        measured: measured angles (T,) [rad], NaN where missing. If all are missing, errors are relative to the target.
        simulated: simulated angles (T,) [rad], by actuator model.
        errors: root mean square errors [rad], by actuator model.
        title: title of the figure.
    """
    is_measured = np.isfinite(np.asarray(measured, float)).any()
    reference = np.asarray(measured if is_measured else target, float)
    with new_figure(path, (8.0, 5.8), rows=2, sharex=True, height_ratios=(2.2, 1)) as (figure, (above, below)):
        above.step(time, target, where="post", color=QUIET, alpha=0.6, label="target")
        if is_measured:
            above.plot(time, reference, color=BLUE, linewidth=2.4, label="measured")
        for name, angle in simulated.items():
            color, label = STYLES[name]
            above.plot(time, angle, color=color, label=f"{label}, {1000 * errors[name]:.1f} mrad RMS")
            below.plot(time, 1000 * (np.asarray(angle) - reference), color=color)
        above.set_title("Motor angle (rad)")
        below.axhline(0, color=QUIET, linewidth=0.8)
        below.set_title(f"Difference from the {'measured angle' if is_measured else 'target'} (mrad)")
        below.set_xlabel("time (s)")
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        heading(figure, title)
    return path
