"""Synthetic traces of robots that swing their legs and move at a constant speed."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from surefoot.report.pages.recorded_runs import ShownTrace
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace


def standing_height(robot: RobotDescription) -> float:
    """Return the height of a robot's base in the resting pose [m]."""
    return -float(robot.foot_positions(robot.resting_angles)[:, 2].min())


def swinging(
    make_run: Callable[..., EpisodeTrace], name: str = "go2", speed: float = 0.5, seconds: float = 2.0, **changes: Any
) -> ShownTrace:
    """Return the trace of a robot whose motors swing by 0.2 rad at 1 Hz; for `arrays` and meta see `make_run`."""
    robot = RobotDescription.load(name)
    time = 0.01 * np.arange(1, round(seconds * 100) + 1)
    angles = robot.resting_angles + 0.2 * np.sin(2 * np.pi * time)[:, None]
    position = np.zeros((len(time) + 1, 3))
    position[:, 0], position[:, 2] = speed * 0.01 * np.arange(len(time) + 1), standing_height(robot)
    arrays = {
        "base_position_world": position,
        "motor_angle": angles,
        "target": angles + 0.05,
        **{name: np.zeros_like(angles) for name in ("motor_velocity", "motor_torque", "feedback")},
        "foot_contact": (np.sin(2 * np.pi * time)[:, None] > 0.0) * np.ones(len(robot.legs)),
        **changes.pop("arrays", {}),
    }
    meta = {"robot": name, "leg_names": robot.leg_names, "motor_names": robot.motor_names, "policy": name}
    return ShownTrace(name, robot, make_run(steps=len(time), arrays=arrays, **(meta | changes)))


def data_of(page: str) -> dict[str, Any]:
    """Return the data of a page's script, with the columns of each run as arrays (N, k)."""
    match = re.search(r"DATA = (\{.*\}),\n", page)
    assert match is not None
    data: dict[str, Any] = json.loads(match[1])
    for run in data["runs"]:
        for name, packed in run["columns"].items():
            whole = np.frombuffer(base64.b64decode(packed["data"]), "<i2").reshape(-1, run["rows"]).T.astype(float)
            values = np.array(packed["low"]) + np.array(packed["step"]) * (whole + 32767)
            run["columns"][name] = np.where(whole == -32768, np.nan, values)
    return data
