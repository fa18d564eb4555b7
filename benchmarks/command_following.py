"""Protocol by which benchmarks say how well robots follow velocity commands.

A robot follows one command for 6 s from standing. Errors are root mean squares, over robots and control steps, of the
mean velocity in a control step from the motion of the base, in the heading frame, minus the command; the first 1.5 s
are left out. The planar error is the root of the sum of squares of the forward and the sideways error. A fall is a roll
or pitch of more than 0.5 rad, or a simulation that diverges; errors count up to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.evaluation.tracking import mean_velocity
from surefoot.robot.commands import COMMANDS
from surefoot.rotations import quat_matrix

SECONDS, SETTLED = 6.0, 1.5
"""Duration of a command, and its beginning that is left out [s]."""
FALL_ANGLE = 0.5
"""Roll or pitch from which a robot has fallen [rad]."""
COMMAND_SEED = 63


def draw_commands(number: int, low: Array, high: Array) -> Array:
    """Return random commands (number, 3) [m/s, m/s, rad/s], uniformly between two limits (3,), always the same."""
    return np.round(np.random.default_rng(COMMAND_SEED).uniform(low, high, (number, 3)), 4)


def command_errors(poses: Mapping[str, Array], commands: Array) -> dict[str, Any]:
    """Return the errors of robots that follow one command each; see the protocol above.

    Args:
        poses: time (T + 1, N) [s] from the beginning of the commands, position (T + 1, N, 3) [m] and quat (T + 1, N, 4)
            of the base in the world frame, w x y z. Poses after the end of a robot's run repeat the last time.
        commands: (N, 3) [m/s, m/s, rad/s].

    Returns:
        Number of falls and of robots, errors by command, and the planar error [m/s, rad/s]; NaN without data.
    """
    falls, errors = 0, [np.empty((0, 3))]
    for i, command in enumerate(commands):
        time, position, quat = (poses[name][:, i] for name in ("time", "position", "quat"))
        step = np.diff(time)
        up = quat_matrix(quat)[:, 2]  # the vertical in the base frame
        pitch, roll = np.arcsin(np.clip(up[:, 0], -1.0, 1.0)), np.arctan2(up[:, 1], up[:, 2])
        tilted = np.maximum(np.abs(pitch), np.abs(roll)) > FALL_ANGLE
        end = int(tilted.argmax()) if tilted.any() else 1 + int(np.count_nonzero(step > 0))
        falls += bool(tilted.any() or time[end - 1] < SECONDS - step[step > 0].max(initial=0.0))
        if end < 2:
            continue
        measured = mean_velocity(step[: end - 1], position[:end], quat[:end]) - command
        errors.append(measured[time[: end - 1] >= SETTLED - 1e-9])
    whole = np.concatenate(errors)
    rmse = np.sqrt((whole**2).mean(axis=0)) if len(whole) else np.full(3, np.nan)
    named = dict(zip(COMMANDS, rmse.round(4).tolist(), strict=True))
    return {"falls": falls, "episodes": len(commands), **named, "planar": round(float(np.hypot(rmse[0], rmse[1])), 4)}
