"""Figure of a replay: commands and angles of the moving joints, and errors of one or two simulators."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surefoot.identify.motion.replay_errors import ReplayErrors
from surefoot.report.figures.style import BLUE, INK, ORANGE, QUIET, heading, new_figure
from surefoot.robot import RobotDescription

PLOT_DURATION = 3.0
"""Duration of the log that is drawn, from its start [s]."""
_MAX_JOINTS = 8
_WIDTH, _HEIGHT = 11.0, 1.7


def draw_replay(
    path: Path,
    robot: RobotDescription,
    errors: ReplayErrors,
    other: ReplayErrors | None = None,
    label: str = "other recording",
) -> Path:
    """Draw angles and errors of the moving joints over the first seconds of a replay.

    Args:
        path: figure (.png) to write.
        robot: robot of the log.
        errors: errors of surefoot's simulation.
        other: errors of another recording of the same commands.
        label: name of the other recording.
    """
    log = errors.motion
    joints = np.flatnonzero(log.moving_joints)[:_MAX_JOINTS].tolist()
    with new_figure(path, (_WIDTH, 0.8 + _HEIGHT * len(joints)), len(joints), 2, sharex=True) as (figure, axes):
        legend = f"surefoot {1e3 * errors.rms:.1f} mrad"
        legend += "" if other is None else f", {label} {1e3 * other.rms:.1f} mrad"
        heading(figure, f"{log.name}: {robot.name}, root mean square error of {legend}")
        for joint, left, right in zip(joints, axes[::2], axes[1::2], strict=True):
            shown = log.time <= log.time[0] + PLOT_DURATION
            left.step(log.time[shown], log.command[shown, joint], color=QUIET, lw=0.8, where="post", label="command")
            left.plot(log.read_time[shown], log.motor_angle[shown, joint], color=INK, lw=2.0, label="robot")
            for color, name, one in ((ORANGE, label, other), (BLUE, "surefoot", errors)):
                if one is None:
                    continue
                rows = one.motion.time <= log.time[0] + PLOT_DURATION
                error, when = one.motor_angle[rows, joint], one.motion.read_time[rows]
                left.plot(when, one.motion.motor_angle[rows, joint] + error, color=color, lw=1.0, label=name)
                right.plot(when, 1e3 * error, color=color, lw=1.0, label=name)
            left.set_title(robot.motor_names[joint])
            left.set_ylabel("angle [rad]")
            right.set_ylabel("error [mrad]")
        axes[0].legend(loc="upper right", ncols=4)
        for axis in axes[-2:]:
            axis.set_xlabel("time [s]")
    return path
