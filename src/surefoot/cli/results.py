"""Reports in the folder of a finished run: evaluation, learning curve, footfalls, one episode, video."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from surefoot.cli.evaluate import print_summaries
from surefoot.cli.play import captions
from surefoot.evaluate.metrics import summarize
from surefoot.evaluate.rollout import run_episodes
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig
from surefoot.task.randomize import RandomizeConfig
from surefoot.world.sim_world import SimWorld

EPISODES = 20
DRAWN_EPISODES = 100
"""Episodes with physical parameters drawn: falls are rare there, and worlds differ."""


def report_run(
    folder: Path, policy_path: Path, task: TaskConfig, rows: list[dict[str, Any]], console: Console
) -> dict[str, Any]:
    """Evaluate a run's policy on the nominal robot, on drawn ones and with pushes where the task has them.

    Leaves tables, figures and a video.

    Args:
        folder: the run's folder.
        policy_path: the exported policy.
        task: what was learned.
        rows: the run's figures, one row an update.
        console: where to say what is done.
    """
    from surefoot.evaluate.comparison import Curve
    from surefoot.report.figures import episode_plot, footfall_diagram
    from surefoot.report.scene import scene, trace_poses
    from surefoot.report.study_figures import learning_curves
    from surefoot.report.video import render_video

    policy, robot = PolicyRuntime.load(policy_path), RobotDescription.load(task.robot)
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)
    console.print(f"Evaluating over {EPISODES} episodes ...")
    calm = replace(task, pushes=replace(task.pushes, enabled=False), randomize=RandomizeConfig())
    wanted = {"without_pushes": (calm, EPISODES)}
    if task.randomize.ranges:
        wanted["randomized"] = (replace(calm, randomize=task.randomize), DRAWN_EPISODES)
    if task.pushes.enabled:
        wanted["with_pushes"] = (replace(calm, pushes=replace(task.pushes, probability=1.0)), EPISODES)
    traces = {
        name: run_episodes(policy, given, episodes, SimWorld, seed=0, policy_name=policy.contract.name)
        for name, (given, episodes) in wanted.items()
    }
    results = {name: summarize(found, robot.urdf.total_mass) for name, found in traces.items()}
    (folder / "evaluation.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    console.print("Drawing figures and video ...")
    if any(row["return_mean"] is not None for row in rows):
        learning_curves({task.name: [Curve.of_rows(rows)]}, figures / "learning_curve.png")
    nominal = traces["without_pushes"]
    median = sorted(nominal, key=lambda trace: trace.base_position_world[-1, 0])[len(nominal) // 2]
    footfall_diagram(median, figures / "footfalls.png")
    episode_plot(median, robot, figures / "episode.png")
    shapes, poses = scene(robot), trace_poses(robot, median)
    render_video(shapes, poses, median.time, figures / "video.mp4", overlay=captions(median), follow=robot.base)
    print_summaries({name.replace("_", " "): summary for name, summary in results.items()})
    console.print(f"Policy, table, figures and video are in {folder}", soft_wrap=True)
    return results
