"""Reports in the folder of a finished run: evaluation, learning curve, footfalls, one episode, video."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from surefoot.cli.evaluate import print_table
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
    from surefoot.report.figures import episode_plot, footfall_diagram, learning_curve
    from surefoot.report.scene import scene, trace_poses
    from surefoot.report.video import render_video

    policy, robot = PolicyRuntime.load(policy_path), RobotDescription.load(task.robot)
    mass, figures = robot.urdf.total_mass, folder / "figures"
    figures.mkdir(exist_ok=True)
    console.print(f"Evaluating over {EPISODES} episodes ...")
    calm = replace(task, pushes=replace(task.pushes, enabled=False), randomize=RandomizeConfig())
    traces = run_episodes(policy, calm, EPISODES, SimWorld, seed=0, policy_name=policy.contract.name)
    summary = summarize(traces, mass)
    results: dict[str, Any] = {"without_pushes": summary}
    if task.randomize.ranges:
        drawn = replace(calm, randomize=task.randomize)
        drawn_traces = run_episodes(policy, drawn, DRAWN_EPISODES, SimWorld, seed=0, policy_name=policy.contract.name)
        results["randomized"] = summarize(drawn_traces, mass)
    if task.pushes.enabled:
        every = replace(calm, pushes=replace(task.pushes, probability=1.0))
        pushed = run_episodes(policy, every, EPISODES, SimWorld, seed=0, policy_name=policy.contract.name)
        results["with_pushes"] = summarize(pushed, mass)
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
    leg_angle = np.concatenate(robot.motor_to_leg_pose(median.motor_angle), axis=-1)
    episode_plot(median, figures / "episode.png", leg_angle=leg_angle)
    video = figures / "video.mp4"
    render_video(
        scene(robot),
        trace_poses(robot, median),
        median.time,
        video,
        overlay=captions(median),
        follow=robot.base,
    )
    for key, figures_of in results.items():
        console.print(f"\n{key.replace('_', ' ')}:")
        print_table(figures_of)
    console.print(f"Policy, table, figures and video are in {folder}", soft_wrap=True)
    return results
