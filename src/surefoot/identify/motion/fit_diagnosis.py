"""Diagnosis of a fit to logs: whether the fitted robot reproduces the logs, and suggestions if it does not.

A fit explains the logs if its error is clearly smaller than the error of a baseline without physics: a motor that
follows its command after the best fitting delay. Fits of wrong models are no better than this baseline.
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

MAX_ERROR_RATIO = 0.7
"""Maximum error of a fit that explains its logs, relative to the baseline of a delayed command."""
SMALL_ERROR = 0.003
"""Error [rad] below which a fit is always accepted, because the comparison would only compare noise."""
DELAYS = np.arange(0.0, 0.3, 0.01)
"""Candidate delays of the baseline [s]."""
SUGGESTION_RATIO = 0.6
"""Error with the base on the rack instead of the ground, or vice versa, relative to the fit, below which this is
suggested."""
MIN_CORRELATION = 0.5
"""Correlation between an angle and a command above which they belong to the same motor."""


def diagnose_fit(robot: RobotDescription, motions: Sequence[RecordedMotion], params: PhysicalParams) -> tuple[str, ...]:
    """Return why a fit does not explain its logs, followed by suggestions; empty if it does.

    Args:
        robot: robot description.
        motions: fitted parts of the logs.
        params: estimates, one row.
    """
    replayers = {rack: Replayer(robot, 1, rack, torques=False) for rack in {one.rack for one in motions}}
    fit_errors, baseline_errors, worst = [], [], None
    for motion in motions:
        error = replay_motion(motion, robot, params, replayers[motion.rack]).rms
        baseline = following_error(motion)
        fit_errors.append(error)
        baseline_errors.append(baseline)
        ratio = error / max(baseline, 1e-12)
        if np.isfinite(ratio) and (worst is None or ratio > worst[1]):  # not a log without angles
            worst = motion, ratio
    if worst is None:
        return ()
    error, baseline = (float(np.sqrt(np.nanmean(np.square(values)))) for values in (fit_errors, baseline_errors))
    if error < max(MAX_ERROR_RATIO * baseline, SMALL_ERROR):
        return ()
    failure = (
        f"the fitted robot does not reproduce these logs: its error is {error:.4f} rad, but motors that just follow "
        f"their commands after a delay would have {baseline:.4f} rad"
    )
    return (failure, *_suggestions(robot, worst[0], error, params))


def following_error(motion: RecordedMotion) -> float:
    """Return the RMS error [rad] of the baseline: each motor follows its command after its best fitting delay."""
    time, rows = motion.time - motion.time[0], motion.evaluated_rows
    best = np.full(motion.command.shape[1], np.nan)
    for motor in np.flatnonzero(motion.moving_joints):
        angle, command = motion.motor_angle[:, motor], motion.command[:, motor]
        shifted = np.array([np.interp(time - delay, time, command) for delay in DELAYS])[:, rows]
        squares = (shifted - angle[rows]) ** 2
        if np.isfinite(squares).any():
            best[motor] = float(np.min(np.nanmean(squares, axis=1)))
    return float(np.sqrt(np.nanmean(best)))


def _suggestions(
    robot: RobotDescription, motion: RecordedMotion, error: float, params: PhysicalParams
) -> tuple[str, ...]:
    """Return possible mistakes in a log: rack or ground, signs or order of joints, units."""
    return (*_rack_hints(robot, motion, error, params), *_column_hints(robot, motion), *unit_notes(motion, robot))


def _rack_hints(robot: RobotDescription, motion: RecordedMotion, error: float, params: PhysicalParams) -> list[str]:
    """Suggest that the robot hung instead of stood, or vice versa, if a replay of that is much better."""
    name = motion.name.removesuffix(".npz")
    replayer = Replayer(robot, 1, not motion.rack, torques=False)
    try:
        nominal = PhysicalParams.nominal(robot).with_values(robot, **motion.gains)
        other_error = min(replay_motion(motion, robot, one, replayer).rms for one in (nominal, params))
    except ValueError:
        return []
    if motion.rack:
        return [f"did the robot stand? leave out --rack {name}"] if other_error < SUGGESTION_RATIO * error else []
    if other_error < SUGGESTION_RATIO * error or not np.isfinite(motion.imu).any():
        return [f"did the robot hang? add --rack {name}"]
    return []


def _column_hints(robot: RobotDescription, motion: RecordedMotion) -> list[str]:
    """Suggest wrong signs or order of motors: angles that follow another command, or the negative of their own."""
    hints = []
    correlation = command_correlation(motion)
    for motor in np.flatnonzero(motion.moving_joints):
        name, own = robot.motor_names[motor], correlation[motor, motor]
        if own < -MIN_CORRELATION:
            hints.append(f"the angle of {name} moves against its command: is its sign right?")
        elif own < MIN_CORRELATION:
            other = int(np.nanargmax(np.abs(correlation[motor]))) if np.isfinite(correlation[motor]).any() else motor
            if other != motor and abs(correlation[motor, other]) > MIN_CORRELATION:
                followed = robot.motor_names[other]
                hints.append(f"the angle of {name} follows the command of {followed}: is the order of joints right?")
    return hints


def command_correlation(motion: RecordedMotion) -> Array:
    """Return the correlation of each angle with each command (M, M); NaN for constant angles or commands."""
    both = np.concatenate([motion.motor_angle, motion.command], axis=1)
    both = both[np.isfinite(both).all(axis=1)]
    motors = motion.command.shape[1]
    if len(both) < 2:
        return np.full((motors, motors), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.corrcoef(both.T)[:motors, motors:])
