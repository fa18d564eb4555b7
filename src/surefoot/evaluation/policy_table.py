"""Comparison of policies that follow commands: same commands and same robots, under several conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import Condition
from surefoot.evaluation.runs import command_metrics, summarize_load
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS, CommandLimits
from surefoot.robot.randomization import Ranges
from surefoot.tables import with_unit
from surefoot.task.commands import CommandConfig
from surefoot.task.config import TaskConfig
from surefoot.task.pushes import PushConfig
from surefoot.task.trace import EpisodeTrace

PUSH_FORCE_RANGE = (0.5, 0.8)
"""Minimum and maximum force of a push, in multiples of the robot's weight."""
READING_LATENCY = 0.020
"""Age of the readings [s] in the condition "latency"."""
FOOT_STIFFNESS_RATIO = 3.0
"""Ratio of foot stiffness to the nominal one in the condition "feet"."""


def comparison_conditions(robot: RobotDescription, table1: Ranges, duration: float) -> dict[str, Condition]:
    """Return the conditions by name: a nominal robot in both engines, then one difference at a time.

    Args:
        robot: the policies' robot.
        table1: ranges of the paper's table I.
        duration: length of an episode [s].
    """
    pushes = PushConfig(enabled=True, relative=True, force=PUSH_FORCE_RANGE, direction="horizontal")
    pushed = f"pushed by {PUSH_FORCE_RANGE[0]:g} to {PUSH_FORCE_RANGE[1]:g} of its weight for 60 ms, each 1.2 s"
    conditions = [
        Condition("nominal", "nominal robot"),
        Condition("bullet", "nominal robot in the other engine", "bullet"),
        Condition("table1", "randomized robots (the paper's table I)", randomize=table1),
        Condition("pushes", pushed, pushes=pushes),
        Condition("latency", f"readings {1e3 * READING_LATENCY:g} ms old", params={"control_latency": READING_LATENCY}),
        Condition(
            "feet",
            f"feet {FOOT_STIFFNESS_RATIO:g} times as stiff",
            params={"contact_stiffness": FOOT_STIFFNESS_RATIO * robot.contact.stiffness},
        ),
    ]
    return {one.name: replace(one, terrain=None, duration=duration, curricula=True) for one in conditions}


def common_commands(limits: Sequence[CommandLimits | None], names: Sequence[str]) -> CommandConfig:
    """Return the ranges of random commands that all policies support.

    Raises:
        SurefootError: a policy does not follow commands.
    """
    for one, name in zip(limits, names, strict=True):
        if one is None:
            raise SurefootError(f"policy '{name}' follows no commands; policies that are compared must")
    followed = [one for one in limits if one is not None]
    low, high = np.max([one.low for one in followed], axis=0), np.min([one.high for one in followed], axis=0)
    ranges = {
        name: (float(minimum), float(maximum)) for name, minimum, maximum in zip(COMMANDS, low, high, strict=True)
    }
    return CommandConfig(**ranges)  # type: ignore[arg-type]


def with_commands(task: TaskConfig, commands: CommandConfig) -> TaskConfig:
    """Return a policy's task with common commands; acceleration limits and heading control stay the policy's own."""
    own = task.commands
    return replace(task, commands=replace(commands, acceleration=own.acceleration, heading_gain=own.heading_gain))


def measure(traces: Sequence[EpisodeTrace], weight: float) -> dict[str, Any]:
    """Return the metrics of a policy in a condition from its episodes, see `COLUMNS`; `weight` of the robot [N]."""
    followed = command_metrics(traces)
    errors = {f"{kind}_{name}": value for kind in ("rmse", "rmse_stride") for name, value in followed[kind].items()}
    return {
        "episodes": len(traces),
        "falls": sum(trace.fell for trace in traces),
        "success": followed["success"],
        **errors,
        **summarize_load(traces, weight),
    }


COLUMNS = {
    "falls": ("falls", ""),
    "rmse_stride_forward": ("error forward", "m/s"),
    "rmse_stride_sideways": ("error sideways", "m/s"),
    "rmse_stride_yaw_rate": ("error of yaw rate", "rad/s"),
    "power": ("power", "W"),
    "cost_of_transport": ("cost of transport", ""),
    "hottest_heat": ("hottest motor", "W"),
    "rmse_forward": ("instantaneous: forward", "m/s"),
    "rmse_sideways": ("instantaneous: sideways", "m/s"),
    "rmse_yaw_rate": ("instantaneous: yaw rate", "rad/s"),
}
"""Headings and units of the printed metrics: falls; stride-averaged tracking errors (root mean square); mechanical
power; energy divided by weight and distance along commands; mean heating power of the hottest motor; instantaneous
tracking errors."""


def format_rows(table: pd.DataFrame, condition: str) -> list[dict[str, str]]:
    """Return the rows of a condition as text, one row per policy."""
    rows = []
    for row in table[table.condition == condition].to_dict("records"):
        texts = {"policy": str(row["policy"])}
        for column, (heading, unit) in COLUMNS.items():
            value = row[column]
            if column == "falls":
                text = f"{value} of {row['episodes']}"
            else:
                text = "-" if pd.isna(value) else f"{value:.3f}" if "rmse" in column else f"{value:.3g}"
            texts[with_unit(heading, unit)] = text
        rows.append(texts)
    return rows
