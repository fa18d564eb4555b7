"""Evaluation of policies on hidden robots: runs in the training simulator, and on each robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
from numpy.typing import ArrayLike

from surefoot.evaluation.conditions import data_sheet_task, undisturbed_task
from surefoot.evaluation.runs import measure_runs
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import CONTROLLER_PARAMETERS
from surefoot.robot.params_file import param_values
from surefoot.studies.evaluations import GAP_SEED, EvaluationKind, EvaluationRun, Result, ResultMetric, Traces
from surefoot.studies.hidden_robots import HiddenRobots, robot_name
from surefoot.task.config import TaskConfig

NAME = "robot"
"""Name of the evaluation."""
HOME = "mujoco"
"""Name of the training simulator's world."""


def robot_kind(robots: HiddenRobots, seeds: Sequence[int], folder: Path) -> EvaluationKind:
    """Return the evaluation of a policy on hidden robots.

    Args:
        robots: the study's hidden robots.
        seeds: seeds of the robots on which the policy runs: the robot that it was trained for, or all.
        folder: folder of the robot description with other motors.
    """

    def run(evaluation: EvaluationRun) -> tuple[Result, Traces]:
        home = measure_runs(evaluation.run(undisturbed_task(evaluation.task), HOME), HOME)
        tasks = {robot_name(seed): robot_task(evaluation.task, robots, seed, folder) for seed in seeds}
        on_robots = [measure_runs(evaluation.run(task, robots.world), name) for name, task in tasks.items()]
        return {"runs": pd.concat([home, *on_robots]).to_dict("list")}, {}

    settings: dict[str, Any] = {"home": HOME, "episodes": robots.starts, "seed": GAP_SEED}
    return EvaluationKind(
        f"{robots.starts} runs in the training simulator, and as many on each of the policy's robots, without pushes",
        settings | {"robots": list(seeds), **robots.settings()},
        run,
        _read,
        (
            ResultMetric("home", "return in training simulator", "m", 2, is_return=True),
            ResultMetric("on_robot", "return on the robot", "m", 2, is_return=True),
            ResultMetric("falls", "falls on the robot", "%", 0),
        ),
    )


def robot_task(task: TaskConfig, robots: HiddenRobots, seed: int, folder: Path) -> TaskConfig:
    """Return a policy's task on a hidden robot: the robot's parameters with the policy's control step and gains."""
    robot = RobotDescription.load(task.robot)
    own = param_values(task.nominal(robot), CONTROLLER_PARAMETERS)
    params = {**param_values(robots.params(seed, folder), PhysicalParams.names(robot)), **own}
    return replace(data_sheet_task(task), robot=robots.description(seed, folder), params=params)


def _read(result: Result) -> tuple[ArrayLike, ...]:
    runs = pd.DataFrame(result["runs"])
    away = runs[runs.world != HOME]
    return runs[runs.world == HOME]["return"], away["return"], 100 * (1 - away.balanced.astype(float))
