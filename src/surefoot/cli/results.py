"""What a finished run leaves in its folder: evaluation, table, learning curve, footfalls, one episode, video."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from surefoot.evaluate.footfalls import analyze_footfalls
from surefoot.evaluate.metrics import summarize
from surefoot.evaluate.rollout import run_episodes
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig
from surefoot.task.trace import EpisodeTrace
from surefoot.world.sim_world import SimWorld

EPISODES = 20

_ROWS = (
    ("speed", "speed_mean", "{:.2f} m/s", "mean of the episodes"),
    ("distance", "distance_mean", "{:.1f} m", "in an episode"),
    ("mechanical power", "power_mean", "{:.0f} W", "mean of |tau . qdot|"),
    ("cost of transport", "cost_of_transport_mean", "{:.2f}", "power / (m g speed)"),
    ("return", "return_mean", "{:.2f}", "paper's reward, w = .008"),
    ("sideways drift", "drift_mean", "{:.2f} m", "at the end of an episode"),
)


def results_table(summary: dict[str, Any], title: str) -> Table:
    """The figures of an evaluation as a table."""
    table = Table(title=title, title_justify="left", show_header=False)
    table.add_row("falls", f"{summary['falls']} of {summary['episodes']}", "episodes that ended before their time")
    for name, key, form, note in _ROWS:
        value = summary.get(key)
        table.add_row(name, "-" if value is None else form.format(value), note)
    duty = summary["duty_factor"] or {}
    table.add_row("gait", str(summary["gait"]), "from the footfalls")
    table.add_row("duty factor", f"{np.mean(list(duty.values())):.2f}" if duty else "-", "share of the stride on the ground")
    return table


def write_video(trace: EpisodeTrace, robot: RobotDescription, path: Path, seconds: float | None = None) -> Path:
    """Draw an episode as an MP4."""
    from surefoot.report.scene import poses, scene
    from surefoot.report.video import render_video

    angles = trace.true_motor_angle if np.isfinite(trace.true_motor_angle).all() else trace.motor_angle
    moves = poses(robot, trace.base_position_world[1:], trace.base_quat_world[1:], angles)
    gait = analyze_footfalls(trace.foot_contact, trace.time, trace.leg_names).gait
    distance = trace.base_position_world[1:, 0] - trace.base_position_world[0, 0]
    window = max(1, round(0.25 / float(np.median(np.diff(trace.time)))))
    overlay = []
    for k, now in enumerate(trace.time):
        first = max(0, k - window)
        speed = (distance[k] - distance[first]) / max(now - trace.time[first], 1e-9)
        overlay.append(f"{now:5.2f} s   {speed:5.2f} m/s   {distance[k]:5.2f} m   {gait}")
    return render_video(scene(robot), moves, trace.time, path, overlay=overlay, seconds=seconds, follow=robot.base)


def report_run(
    folder: Path, policy_path: Path, task: TaskConfig, rows: list[dict[str, Any]], console: Console
) -> dict[str, Any]:
    """Evaluate a run's policy without pushes, and with them where the task has them; write tables and figures.

    Args:
        folder: the run's folder.
        policy_path: the exported policy.
        task: what was learned.
        rows: the run's figures, one row an update.
        console: where to say what is done.
    """
    from dataclasses import replace

    from surefoot.report.figures import episode_plot, footfall_diagram, learning_curve

    policy, robot = PolicyRuntime.load(policy_path), RobotDescription.load(task.robot)
    mass, figures = robot.urdf.total_mass, folder / "figures"
    figures.mkdir(exist_ok=True)
    console.print(f"Evaluating over {EPISODES} episodes ...")
    calm = replace(task, pushes=replace(task.pushes, enabled=False))
    traces = run_episodes(policy, calm, EPISODES, SimWorld, seed=0)
    summary = summarize(traces, mass, world="mujoco", policy=str(policy_path))
    results: dict[str, Any] = {"without_pushes": summary}
    if task.pushes.enabled:
        pushed = run_episodes(policy, task, EPISODES, SimWorld, seed=0)
        results["with_pushes"] = summarize(pushed, mass, world="mujoco", policy=str(policy_path))
    (folder / "evaluation.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    console.print("Drawing figures and video ...")
    ended = [row for row in rows if row["return_mean"] is not None]
    if ended:
        learning_curve(
            np.array([row["steps"] for row in ended]),
            np.array([row["return_mean"] for row in ended]),
            np.array([row["speed_mean"] for row in ended]),
            figures / "learning_curve.png",
            title=task.name,
        )
    median = sorted(traces, key=lambda trace: trace.base_position_world[-1, 0])[len(traces) // 2]
    footfall_diagram(median, figures / "footfalls.png")
    episode_plot(median, figures / "episode.png")
    write_video(median, robot, figures / "video.mp4")
    for key, title in (("without_pushes", "without pushes"), ("with_pushes", "with pushes")):
        if key in results:
            console.print(results_table(results[key], f"{task.name}, {title}"))
    console.print(f"Policy, table, figures and video are in {folder}", soft_wrap=True)
    return results
