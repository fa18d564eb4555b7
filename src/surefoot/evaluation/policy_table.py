"""Policies that follow commands, side by side: same commands, same robots, under the same conditions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import Policy, Progress, run_episodes
from surefoot.evaluation.tracking import STRIDE, Tracking, distance_along, kept_up
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS, CommandLimits
from surefoot.robot.randomization import Ranges
from surefoot.task.commands import CommandConfig
from surefoot.task.config import TaskConfig
from surefoot.task.pushes import PushConfig
from surefoot.world.registry import find_world

PUSH = (0.5, 0.8)
"""Least and greatest push [weights of the robot]."""
LATENCY = 0.020
"""Age of the readings [s] under the condition of that name."""
STIFFNESS = 3.0
"""Stiffness of the feet over the nominal one, under the condition of that name."""


@dataclass(frozen=True)
class Condition:
    """Under which policies are measured."""

    name: str
    meaning: str
    world: str
    change: Callable[[TaskConfig, RobotDescription], TaskConfig]
    """Returns a policy's task under it."""


def conditions(table1: Ranges) -> list[Condition]:
    """Return the conditions: a nominal robot in both worlds, and one thing that differs in each of the others.

    Args:
        table1: ranges of the paper's table I.
    """

    def pushed(task: TaskConfig, robot: RobotDescription) -> TaskConfig:
        pushes = PushConfig(enabled=True, relative=True, force=PUSH, direction="horizontal")
        return replace(task, pushes=pushes)

    def late(task: TaskConfig, robot: RobotDescription) -> TaskConfig:
        return replace(task, params={**task.params, "control_latency": LATENCY})

    def stiff(task: TaskConfig, robot: RobotDescription) -> TaskConfig:
        return replace(task, params={**task.params, "contact_stiffness": STIFFNESS * robot.contact.stiffness})

    return [
        Condition("nominal", "nominal robot", "mujoco", lambda task, robot: task),
        Condition("bullet", "nominal robot in the other engine", "bullet", lambda task, robot: task),
        Condition("table1", "robots of table I", "mujoco", lambda task, robot: replace(task, randomize=table1)),
        Condition(
            "pushes", f"pushed by {PUSH[0]:g} to {PUSH[1]:g} of its weight for 60 ms, each 1.2 s", "mujoco", pushed
        ),
        Condition("latency", f"readings {1e3 * LATENCY:g} ms old", "mujoco", late),
        Condition("feet", f"feet {STIFFNESS:g} times as stiff", "mujoco", stiff),
    ]


def common_commands(limits: Sequence[CommandLimits | None], names: Sequence[str]) -> CommandConfig:
    """Return how commands are drawn, within what every policy follows.

    Raises:
        SurefootError: a policy that follows none.
    """
    for one, name in zip(limits, names, strict=True):
        if one is None:
            raise SurefootError(f"policy '{name}' follows no commands; policies that are compared must")
    followed = [one for one in limits if one is not None]
    low, high = np.max([one.low for one in followed], axis=0), np.min([one.high for one in followed], axis=0)
    ranges = {name: (float(least), float(most)) for name, least, most in zip(COMMANDS, low, high, strict=True)}
    return CommandConfig(**ranges)  # type: ignore[arg-type]


def prepare_task(task: TaskConfig, commands: CommandConfig, duration: float, robot: RobotDescription) -> TaskConfig:
    """Return a policy's task as it is compared: commands as the others', no pushes, nothing randomized."""
    drawn = replace(
        commands,
        acceleration=task.commands.acceleration,
        heading_gain=task.commands.heading_gain,
    )
    step = float(task.nominal(robot).control_step[0])
    return replace(
        task,
        commands=drawn,
        randomize={},
        pushes=PushConfig(),
        max_steps=max(round(duration / step), 1),
    )


def measure(
    policy: Policy,
    task: TaskConfig,
    robot: RobotDescription,
    condition: Condition,
    episodes: int,
    seed: int = 0,
    threads: int = 0,
    progress: Progress | None = None,
) -> dict[str, object]:
    """Return the measures of a policy under a condition; see `COLUMNS`.

    Args:
        policy: gives the feedback.
        task: as `prepare_task` returns it.
        robot: the task's.
        condition: what holds.
        episodes: how many robots.
        seed: of robots, commands and pushes: the same for all policies.
        threads: of the simulation; 0: one a core.
        progress: called with the share that is done.
    """
    traces = run_episodes(
        policy, condition.change(task, robot), episodes, find_world(condition.world), seed, threads, progress
    )
    tracking = Tracking.from_traces(traces, float(traces[0].meta["gait_period"] or STRIDE))
    time = sum(trace.duration for trace in traces)
    energy = sum(float(trace.energy.sum()) for trace in traces)
    distance = sum(map(distance_along, traces))
    heat = np.sum([trace.motor_heat.sum(axis=0) for trace in traces], axis=0)
    hottest = int(heat.argmax())
    return {
        "condition": condition.name,
        "episodes": episodes,
        "falls": sum(trace.fell for trace in traces),
        "success": float(np.mean([kept_up(trace) for trace in traces])),
        **{f"rmse_{name}": float(value) for name, value in zip(COMMANDS, tracking.rmse, strict=True)},
        **{f"rmse_stride_{name}": float(value) for name, value in zip(COMMANDS, tracking.rmse_stride, strict=True)},
        "power": energy / time,
        "cost_of_transport": energy / (robot.weight * distance) if distance > 0 else float("nan"),
        "hottest_motor": robot.motor_names[hottest],
        "hottest_heat": float(heat[hottest] / time),
    }


COLUMNS = {
    "falls": ("falls", ""),
    "rmse_stride_forward": ("error forward", "m/s"),
    "rmse_stride_sideways": ("error sideways", "m/s"),
    "rmse_stride_yaw_rate": ("error of yaw rate", "rad/s"),
    "power": ("power", "W"),
    "cost_of_transport": ("cost of transport", ""),
    "hottest_heat": ("hottest motor", "W"),
    "rmse_forward": ("at once: forward", "m/s"),
    "rmse_sideways": ("at once: sideways", "m/s"),
    "rmse_yaw_rate": ("at once: yaw rate", "rad/s"),
}
"""Measures that are printed, with headings and units: falls; errors of following commands over strides (root mean
square); mechanical power; energy over weight and distance along commands; mean heat of the hottest motor; errors at
once."""


def texts(table: pd.DataFrame, condition: str) -> list[dict[str, str]]:
    """Return the rows of a condition as text, a policy in each."""
    rows = []
    for row in table[table.condition == condition].to_dict("records"):
        texts = {"policy": str(row["policy"])}
        for column, (heading, unit) in COLUMNS.items():
            title = f"{heading} ({unit})" if unit else heading
            value = row[column]
            if column == "falls":
                texts[title] = f"{value} of {row['episodes']}"
            else:
                texts[title] = "-" if pd.isna(value) else f"{value:.3f}" if "rmse" in column else f"{value:.3g}"
        rows.append(texts)
    return rows
