"""Verdict on a fit to logs: whether the simulated robot repeats them at all, and what to try if not.

A fit explains logs if its error is clearly less than that of a motor that knows no physics: one that follows its
command after the delay that fits best. A stiff drive hides nothing else: fits of wrong models end at it, or beyond.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.arrays import Array
from surefoot.identify.motion.log_checks import unit_notes
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import replay_motion
from surefoot.identify.replay import Replayer
from surefoot.robot import PhysicalParams, RobotDescription

EXPLAINED = 0.7
"""Greatest error of a fit, over that of a motor that follows its command."""
SMALL_ERROR = 0.003
"""Error [rad] that needs no explanation: so small that the comparison is one of noise."""
DELAYS = np.arange(0.0, 0.3, 0.01)
"""Delays of such a motor [s]."""
BETTER = 0.6
"""Error with another place of the base, over that of the fit, from which it is suggested."""
CLEAR = 0.5
"""Correlation of an angle with a command from which they belong together."""


def diagnose_fit(robot: RobotDescription, motions: Sequence[RecordedMotion], params: PhysicalParams) -> tuple[str, ...]:
    """Return why a fit does not explain its logs, then what to try; nothing, if it explains them.

    Args:
        robot: its description.
        motions: the fitted parts of logs.
        params: the estimates, one row.
    """
    replayers = {rack: Replayer(robot, 1, rack, torques=False) for rack in {one.rack for one in motions}}
    ours, stiff, worst = [], [], None
    for motion in motions:
        error = replay_motion(motion, robot, params, replayers[motion.rack]).rms
        plain = following_error(motion)
        ours.append(error)
        stiff.append(plain)
        if worst is None or error / plain > worst[1]:
            worst = motion, error / plain
    error, plain = (float(np.sqrt(np.mean(np.square(values)))) for values in (ours, stiff))
    if worst is None or not np.isfinite(error) or error < max(EXPLAINED * plain, SMALL_ERROR):
        return ()
    failure = (
        f"the fitted robot does not repeat these logs: its error is {error:.4f} rad, and a motor that only follows its "
        f"command after a delay has {plain:.4f} rad"
    )
    return (failure, *_suggestions(robot, worst[0], error, params))


def following_error(motion: RecordedMotion) -> float:
    """Return the error [rad] of motors that follow their commands after the delay that fits each of them best."""
    time, rows = motion.time - motion.time[0], motion.counted
    best = np.full(motion.command.shape[1], np.nan)
    for motor in np.flatnonzero(motion.moving):
        angle, command = motion.motor_angle[:, motor], motion.command[:, motor]
        shifted = np.array([np.interp(time - delay, time, command) for delay in DELAYS])[:, rows]
        squares = (shifted - angle[rows]) ** 2
        if np.isfinite(squares).any():
            best[motor] = float(np.min(np.nanmean(squares, axis=1)))
    return float(np.sqrt(np.nanmean(best)))


def _suggestions(
    robot: RobotDescription, motion: RecordedMotion, error: float, params: PhysicalParams
) -> tuple[str, ...]:
    """Return what may be wrong with a log: its base, signs, order of joints, units."""
    return (*_other_place(robot, motion, error, params), *_column_hints(robot, motion), *unit_notes(motion, robot))


def _other_place(robot: RobotDescription, motion: RecordedMotion, error: float, params: PhysicalParams) -> list[str]:
    name = motion.name.removesuffix(".npz")
    replayer = Replayer(robot, 1, not motion.rack, torques=False)
    try:
        nominal = PhysicalParams.nominal(robot).with_values(robot, **motion.gains)
        there = min(replay_motion(motion, robot, one, replayer).rms for one in (nominal, params))
    except ValueError:
        return []
    if motion.rack:
        return [f"did the robot stand? leave out --rack {name}"] if there < BETTER * error else []
    if there < BETTER * error or not np.isfinite(motion.imu).any():
        return [f"did the robot hang? --rack {name}"]
    return []


def _column_hints(robot: RobotDescription, motion: RecordedMotion) -> list[str]:
    """Return doubts about signs and order of motors: angles that follow another command, or the negative of theirs."""
    hints = []
    similar = command_correlation(motion)
    for motor in np.flatnonzero(motion.moving):
        name, own = robot.motor_names[motor], similar[motor, motor]
        if own < -CLEAR:
            hints.append(f"the angle of {name} goes against its command: sign?")
        elif own < CLEAR:
            other = int(np.nanargmax(np.abs(similar[motor]))) if np.isfinite(similar[motor]).any() else motor
            if other != motor and abs(similar[motor, other]) > CLEAR:
                hints.append(f"the angle of {name} follows the command of {robot.motor_names[other]}: order of joints?")
    return hints


def command_correlation(motion: RecordedMotion) -> Array:
    """Return the correlation of every angle with every command that moves (M, M); NaN where there is none."""
    both = np.concatenate([motion.motor_angle, motion.command], axis=1)
    both = both[np.isfinite(both).all(axis=1)]
    motors = motion.command.shape[1]
    if len(both) < 2:
        return np.full((motors, motors), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.corrcoef(both.T)[:motors, motors:])
