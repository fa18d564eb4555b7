"""Tables, figures and videos of episodes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surefoot.robot.commands import COMMANDS

if TYPE_CHECKING:
    from surefoot.robot import RobotDescription
    from surefoot.task.trace import EpisodeTrace
    from surefoot.world.ground import Ground


def draw_episode(folder: Path, trace: EpisodeTrace, robot: RobotDescription) -> list[Path]:
    """Draw a footfall diagram and a plot of an episode; return the written files."""
    import numpy as np

    from surefoot.report.figures.runs import episode_plot, footfall_diagram

    plot = episode_plot(trace, robot, folder / "episode.png")
    # Without foot contact sensors footfalls can't be measured.
    if np.isnan(trace.foot_contact).any():
        return [plot]
    return [footfall_diagram(trace, folder / "footfalls.png"), plot]


def print_summaries(summaries: dict[str, dict[str, Any]], reward: Mapping[str, float] | None = None) -> None:
    """Print the metrics of evaluations, one column per evaluation, and notes on saturated motors or a standing robot.

    Args:
        summaries: metrics, by name of the evaluation.
        reward: weights of the training's reward terms, which explain why a robot only stands.
    """
    from surefoot.tables import print_table

    print_table(summary_rows(summaries))
    first = next(iter(summaries.values()))
    for note in (saturation_note(first), standing_note(first, reward or {})):
        if note:
            print(note)


def standing_note(summary: dict[str, Any], reward: Mapping[str, float]) -> str | None:
    """Return a note that explains, by its reward terms, why a policy only stands; None if it does not, or should."""
    from surefoot.evaluation.footfalls import STANDING_REASON

    error = summary.get("rmse", {}).get("forward")
    if (
        summary.get("gait_reason") != STANDING_REASON
        or not reward
        or (error is not None and error < _MIN_STANDING_ERROR)
    ):
        return None
    terms = [f"{name} {weight:g}" for name, weight in sorted(reward.items(), key=lambda one: -one[1]) if weight]
    return (
        f"the policy learned to stand: moving costs more reward than it earns ({', '.join(terms)}); reduce the weights "
        "of costs, or increase the weights of progress; see docs/troubleshooting.md"
    )


def summary_rows(summaries: dict[str, dict[str, Any]]) -> list[dict[str, str]]:
    """Return the metrics of evaluations as text, one row per metric and one column per evaluation."""
    columns = {name: _summary_texts(summary) for name, summary in summaries.items()}
    metrics = next(iter(columns.values()))
    return [{"": metric} | {name: texts[metric] for name, texts in columns.items()} for metric in metrics]


def saturation_note(summary: dict[str, Any]) -> str | None:
    """Return a note on the motor that is saturated for the longest time, if motors limit the gait; else None."""
    from surefoot.evaluation.runs import MIN_LIMITING_SATURATION

    fractions = {name: value for name, value in summary["saturation"].items() if value is not None}
    worst = max(fractions, key=lambda name: fractions[name], default=None)
    if worst is None or fractions[worst] < MIN_LIMITING_SATURATION:
        return None
    count = sum(value >= MIN_LIMITING_SATURATION for value in fractions.values()) - 1
    others = f", and {count} more motors for over {MIN_LIMITING_SATURATION:.0%}" if count else ""
    return (
        f"motors limit this gait: {worst} is at its limit for {fractions[worst]:.0%} of the time{others}; "
        "surefoot robot check computes the torque that a trot requires"
    )


_MIN_STANDING_ERROR = 0.05
"""RMSE of the forward velocity [m/s] from which a standing robot was commanded to move."""


def _tracking_texts(summary: dict[str, Any]) -> dict[str, str]:
    """Return the command tracking errors as text; empty without commands."""
    texts = {}
    for key, label in (("rmse", "RMSE"), ("rmse_stride", "stride-averaged RMSE")):
        if key in summary:
            parts = [f"{'-' if x is None else format(x, '.3f')} {COMMANDS[name]}" for name, x in summary[key].items()]
            texts[f"{label}: {', '.join(COMMANDS).replace('_', ' ')}"] = ", ".join(parts)
    return texts


def _summary_texts(summary: dict[str, Any]) -> dict[str, str]:
    """Return the metrics of an evaluation as text, by name."""

    def text(key: str, unit: str, deviation: str = "") -> str:
        value = summary[key]
        if value is None:
            return "-"
        spread = summary[deviation] if deviation else None
        return f"{value:.3f}" + (f" ± {spread:.3f}" if spread is not None else "") + f" {unit}".rstrip()

    falls = f"{summary['falls']} of {summary['episodes']}"
    for name in ("faults", "stopped"):
        if summary.get(name):
            falls += f", {summary[name]} {name}"
    duty, phases = summary["duty_factor"], summary["phases"]
    # Command tracking comes first: it is the aim of a policy with commands.
    tracking = _tracking_texts(summary)
    tracking |= {"success": f"{summary['success']:.2f}"} if "success" in summary else {}
    saturation = [value for value in summary.get("saturation", {}).values() if value is not None]
    texts = {
        "falls": falls,
        **tracking,
        "steps": f"{summary['steps_mean']:.1f}",
        "speed": text("speed_mean", "m/s", "speed_std"),
        "power": text("power_mean", "W"),
        "return": text("return_mean", "", "return_std"),
        "distance": text("distance_mean", "m"),
        "drift": text("drift_mean", "m"),
        "cost of transport": text("cost_of_transport_mean", ""),
        "heat of the hottest motor": _hottest_text(summary),
        "saturation of the worst motor": f"{max(saturation):.0%} of the time" if saturation else "-",
        # Without duty factors, footfalls were not measured.
        "gait": _gait_text(summary) if any(value is not None for value in duty.values()) else "-",
    }
    for leg in duty:
        numbers = ["-" if value is None else f"{value:.2f}" for value in (duty[leg], phases[leg])]
        texts[f"{leg.replace('_', ' ')}: duty factor, phase"] = ", ".join(numbers)
    return texts


def _hottest_text(summary: dict[str, Any]) -> str:
    heat = summary.get("hottest_heat")
    return "-" if heat is None else f"{heat:.1f} W, {summary['hottest_motor']}"


def _gait_text(summary: dict[str, Any]) -> str:
    """Return the name of a gait, or the reason why it has none."""
    from surefoot.evaluation.footfalls import STANDING_REASON

    reason = summary.get("gait_reason", "")
    if summary["gait"] != "other" or not reason:
        return str(summary["gait"])
    return f"{'stands' if reason == STANDING_REASON else 'other'}: {reason}"


def film(robot: RobotDescription, trace: EpisodeTrace, path: Path, ground: Ground | None = None) -> Path:
    """Write a video (.mp4) of a trace; return its path. The ground defaults to the trace's."""
    from surefoot.evaluation.recorded import ground_for_trace
    from surefoot.report.drawing.renderer import Camera
    from surefoot.report.drawing.scene import extent, trace_poses
    from surefoot.report.drawing.video import render_video

    parts, poses = robot.appearance(), trace_poses(robot, trace)
    camera, ground = Camera.for_robot(extent(robot)), ground or ground_for_trace(trace)
    text = captions(trace)
    return render_video(parts, poses, trace.time, path, overlay=text, follow=robot.base, camera=camera, ground=ground)


def captions(trace: EpisodeTrace) -> list[str]:
    """Return one caption per control step of a trace: policy, world, and speed over the last half second.

    With velocity commands, the caption contains the command and the measured velocities (forward, left, yaw rate).
    """
    import numpy as np

    from surefoot.evaluation.statistics import decimal
    from surefoot.evaluation.tracking import measured_velocity

    half, steered = max(round(0.5 / trace.meta["control_step"]), 1), bool(np.isfinite(trace.command).any())
    terrain = trace.meta["terrain"]
    place = str(trace.meta["world"]) + ("" if terrain == "flat" else f" on {terrain}")
    lines = []
    velocity = measured_velocity(trace) if steered else np.zeros((trace.num_steps, 3))
    for step, time in enumerate(trace.time):
        start = max(step + 1 - half, 0)
        moved = trace.base_position_world[step + 1, 0] - trace.base_position_world[start, 0]
        speed = f"{moved / (time - (trace.time[start - 1] if start else 0.0)):5.2f} m/s"
        if steered:
            rows = {"command": trace.command[step], "robot": velocity[start : step + 1].mean(axis=0)}
            texts = {name: [decimal(float(value)) for value in row] for name, row in rows.items()}
            speed = "".join(f"\n{name}: forward {x}, left {y} m/s, turn {w} rad/s" for name, (x, y, w) in texts.items())
        separator = "" if steered else "   "
        lines.append(f"{trace.meta['policy']} in {place}\n{time:4.1f} s{separator}{speed}")
    return lines
