"""Figures from traces and runs: footfalls, learning curves, one episode.

Every function takes data, writes one PNG and returns its path. matplotlib is imported when the first figure
is drawn, and only its Agg canvas is used: no display, no global state, nothing of the user's own style.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.errors import SurefootError
from surefoot.evaluate.footfalls import Footfalls, analyze_footfalls
from surefoot.evaluate.metrics import episode_metrics
from surefoot.task.trace import EpisodeTrace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 130
INK, QUIET, GRID = "#22272e", "#6b7480", "#e3e7eb"
# Fore feet blue, hind feet orange, the left side dark and the right side light: safe for colour-blind eyes.
LEG_COLORS = {
    "front_left": "#1f5fa8",
    "front_right": "#6aa5e0",
    "back_left": "#c4560f",
    "back_right": "#f0a35e",
}
BLUE, ORANGE, GREEN = "#1f5fa8", "#c4560f", "#2f8f5b"
# As Hildebrand drew it: hind above fore on each side, so that a trot shows as a diagonal pattern.
DIAGRAM_ORDER = ("back_left", "front_left", "front_right", "back_right")

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
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


def footfall_diagram(
    traces: EpisodeTrace | Sequence[EpisodeTrace],
    path: str | Path,
    *,
    titles: Sequence[str] | None = None,
    seconds: float = 2.0,
) -> Path:
    """Draw a Hildebrand diagram of each trace, one below the other: bars where a foot is on the ground.

    Args:
        traces: one trace or several.
        path: PNG to write.
        titles: one a trace; "policy in world" when left out. Gait, stride and duty factors are added.
        seconds: length of the part shown, starting after the transient.
    """
    episodes = [traces] if isinstance(traces, EpisodeTrace) else list(traces)
    names = [_name(t) for t in episodes] if titles is None else list(titles)
    if not episodes or len(names) != len(episodes):
        raise SurefootError(f"footfall diagram: {len(names)} titles for {len(episodes)} traces; one each")
    with _figure(path, (8.0, 0.45 + 1.95 * len(episodes)), rows=len(episodes)) as (_, axes):
        for ax, trace, name in zip(axes, episodes, names, strict=True):
            feet = analyze_footfalls(trace.foot_contact, trace.time, trace.leg_names)
            _stance_bars(ax, feet, seconds)
            ax.set_title(f"{name}:  {feet.gait}", fontweight="bold", pad=20.0)
            ax.text(0.0, 1.06, _stride_text(feet), transform=ax.transAxes, color=QUIET, fontsize=8.0)
        axes[-1].set_xlabel("time (s)")
    return Path(path)


def learning_curve(
    steps: ArrayLike,
    return_mean: ArrayLike,
    speed: ArrayLike,
    path: str | Path,
    *,
    return_std: ArrayLike | None = None,
    speed_target: float | None = None,
    title: str = "",
) -> Path:
    """Draw return and speed over control steps.

    Args:
        steps: (K,) control steps so far.
        return_mean: (K,) m, the paper's return of an episode; NaN where not evaluated.
        speed: (K,) m/s; NaN where not evaluated.
        path: PNG to write.
        return_std: (K,) m, drawn as a band around the mean.
        speed_target: m/s, drawn as a line (the paper's speed, say).
        title: over both panels.
    """
    count = np.asarray(steps, dtype=np.float64)
    curves = {"return_mean": np.asarray(return_mean, float), "speed": np.asarray(speed, float)}
    spread = None if return_std is None else np.asarray(return_std, float)
    if spread is not None:
        curves["return_std"] = spread
    for name, curve in curves.items():
        if count.ndim != 1 or count.size == 0 or curve.shape != count.shape:
            raise SurefootError(f"learning curve: {name} {curve.shape} must fit steps {count.shape}, not empty")
    with _figure(path, (8.4, 3.3), columns=2) as (figure, (left, right)):
        scale, unit = (1e6, "million ") if count.max() >= 2e5 else (1.0, "")
        _curve(left, count / scale, curves["return_mean"], BLUE, spread)
        left.set_title("Return of an episode (m)")
        _curve(right, count / scale, curves["speed"], ORANGE)
        right.set_title("Speed (m/s)")
        if speed_target is not None:
            right.axhline(speed_target, color=QUIET, linewidth=1.0, linestyle=(0, (4, 3)))
            spot = (1.0, speed_target)
            right.annotate(
                f"{speed_target:g}",
                spot,
                xycoords=("axes fraction", "data"),
                xytext=(-3, 3),
                textcoords="offset points",
                ha="right",
                color=QUIET,
            )
        for ax in (left, right):
            ax.set_xlabel(f"{unit}control steps")
            ax.set_xlim(0.0, max(count.max() / scale, 1e-9))
        right.set_ylim(bottom=min(0.0, right.get_ylim()[0]))
        if title:
            figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    return Path(path)


def episode_plot(
    trace: EpisodeTrace,
    path: str | Path,
    *,
    leg_angle: ArrayLike | None = None,
    title: str = "",
) -> Path:
    """Draw one episode: tilt, speed and power over its whole length, leg angles over one second.

    Args:
        trace: the episode.
        path: PNG to write.
        leg_angle: (T, 2L) rad, measured swing of each leg, then extension of each leg (from the robot's
            description and `trace.motor_angle`). Without it the policy's feedback is drawn instead.
        title: over the panels; policy, world and how it ended when left out.
    """
    legs = len(trace.leg_names)
    angles = trace.feedback if leg_angle is None else np.asarray(leg_angle, dtype=np.float64)
    if angles.shape != (trace.num_steps, 2 * legs):
        raise SurefootError(f"episode plot: leg_angle {angles.shape} must be {(trace.num_steps, 2 * legs)}")
    step = np.diff(trace.time, prepend=0.0)
    numbers = episode_metrics(trace)
    with _figure(path, (9.0, 7.0), rows=3, columns=2) as (figure, axes):
        tilt, turn, speed, power, swing, extension = axes
        for column, (name, color) in enumerate((("roll", BLUE), ("pitch", ORANGE))):
            tilt.plot(trace.time, trace.roll_pitch_yaw[:, column], color=color, label=name, linewidth=1.0)
        tilt.set_title("Roll and pitch as measured (rad)")
        turn.plot(trace.time, np.unwrap(trace.roll_pitch_yaw[:, 2]), color=GREEN, linewidth=1.0)
        turn.set_title("Yaw as measured (rad)")
        forward = np.diff(trace.base_position_world[:, 0]) / step
        _raw_and_smooth(speed, trace, forward, BLUE, numbers.speed, "m/s")
        speed.set_title("Forward speed (m/s)")
        _raw_and_smooth(power, trace, trace.energy / step, ORANGE, numbers.power, "W")
        power.set_title("Mechanical power (W)")
        for ax in (tilt, turn, speed, power):
            ax.set_xlim(0.0, trace.duration)
        power.set_ylim(bottom=0.0)
        start = min(max(trace.duration - 1.0, 0.0), 2.0)
        shown = (trace.time >= start) & (trace.time <= start + 1.0)
        what = "Feedback: " if leg_angle is None else "Leg: "
        for ax, offset, name in ((swing, 0, "swing"), (extension, legs, "extension")):
            for index, leg in enumerate(trace.leg_names):
                # Dashed, so that a foot shows under the one that it moves with.
                line = "--" if "right" in leg else "-"
                color = LEG_COLORS.get(leg, f"C{index}")
                values = angles[shown, offset + index]
                ax.plot(trace.time[shown], values, line, color=color, label=_spoken(leg))
            ax.set_title(f"{what}{name} over one second (rad)")
            ax.set_xlim(start, start + 1.0)
            ax.set_xlabel("time (s)")
        _legend_above(tilt)
        figure.legend(*swing.get_legend_handles_labels(), loc="outside lower center", ncols=max(legs, 1))
        heading = title or f"{_name(trace)}, ended by {trace.meta['ended']}"
        figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
    return Path(path)


@contextmanager
def _figure(
    path: str | Path, size: tuple[float, float], rows: int = 1, columns: int = 1
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure in the house style and its axes, row by row; write it to path when done."""
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
        axes = figure.subplots(rows, columns, squeeze=False)
        yield figure, list(axes.flat)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=DPI, facecolor="white")


def _stance_bars(ax: Axes, feet: Footfalls, seconds: float) -> None:
    """Draw each foot's stances as bars, from the end of the transient on."""
    known = [leg for leg in DIAGRAM_ORDER if leg in feet.intervals]
    legs = known + [leg for leg in feet.intervals if leg not in known]
    start = feet.window[0]
    end = min(start + seconds, feet.window[1])
    for row, leg in enumerate(reversed(legs)):
        spans = [(max(a, start), min(b, end)) for a, b in feet.intervals[leg] if b > start and a < end]
        bars = [(a, b - a) for a, b in spans]
        ax.broken_barh(bars, (row - 0.34, 0.68), facecolors=LEG_COLORS.get(leg, BLUE), linewidth=0)
    labels = [f"{_spoken(leg)} ({feet.duty_factor[leg]:.2f})" for leg in reversed(legs)]
    ax.set_yticks(range(len(legs)), labels)
    ax.set_ylim(-0.6, len(legs) - 0.4)
    ax.set_xlim(start, end)
    ax.grid(visible=False, axis="y")
    ax.tick_params(axis="y", length=0)


def _stride_text(feet: Footfalls) -> str:
    """Tell pattern and stride in one line, which fits over the diagram."""
    stride = f", stride {feet.stride_period:.2f} s" if math.isfinite(feet.stride_period) else ""
    what = feet.reason if feet.gait == "other" else feet.pattern
    return f"{what}{stride}; in brackets: duty factors"


def _curve(
    ax: Axes,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    color: str,
    spread: NDArray[np.float64] | None = None,
) -> None:
    """Draw the points that are known, joined, with a band of one standard deviation."""
    known = np.isfinite(y)
    marker = "o" if known.sum() <= 30 else ""
    ax.plot(x[known], y[known], color=color, marker=marker, markersize=3.0)
    if spread is not None:
        ax.fill_between(x[known], (y - spread)[known], (y + spread)[known], color=color, alpha=0.18, linewidth=0)


def _raw_and_smooth(
    ax: Axes, trace: EpisodeTrace, values: NDArray[np.float64], color: str, mean: float, unit: str
) -> None:
    """Draw a signal faintly, its running mean over half a second on top, and the episode's mean as a line."""
    ax.plot(trace.time, values, color=color, alpha=0.28, linewidth=0.7)
    width = min(max(round(0.5 / float(trace.meta["control_step"])), 1), len(values))
    smooth = np.convolve(values, np.ones(width) / width, "valid")
    ax.plot(trace.time[width // 2 : width // 2 + len(smooth)], smooth, color=color)
    if math.isfinite(mean):
        ax.axhline(mean, color=INK, linewidth=0.9, linestyle=(0, (4, 3)), label=f"mean {mean:.3g} {unit}")
        _legend_above(ax)


def _legend_above(ax: Axes) -> None:
    """Put the legend right of the title, where it covers no curve."""
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=4, borderaxespad=0.0, columnspacing=1.2)


def _name(trace: EpisodeTrace) -> str:
    """Name an episode by policy and world."""
    policy = str(trace.meta["policy"]) or "no policy"
    return f"{policy} in {trace.meta['world']}"


def _spoken(name: str) -> str:
    """Turn front_left into front left."""
    return name.replace("_", " ")
