"""Plausibility checks of a log's units, clock and commands."""

from __future__ import annotations

import numpy as np

from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.robot import RobotDescription

MAX_OUTSIDE_FRACTION = 0.5
"""Fraction of a motor's readings outside the joint limits above which the unit is doubted."""
LIMIT_MARGIN = 0.1
"""Distance beyond a joint limit [rad] that calibration errors can explain."""
MIN_ROW_PERIOD = 2e-4
"""Minimum plausible median time between rows [s]: no logger of a legged robot is faster than 5 kHz."""
MAX_ROW_PERIOD = 1.0
"""Maximum plausible median time between rows [s]."""
MAX_REPEATED_FRACTION = 0.2
"""Fraction of repeated commands above which a note is returned."""


def check_log(motion: RecordedMotion, robot: RobotDescription) -> list[str]:
    """Return notes on implausible units, and on a clock or commands that limit what the log can identify."""
    notes = unit_notes(motion, robot)
    if motion.computed_clock:
        notes.append("these times look computed, not measured: errors of the clock can't be distinguished from delay")
    changed = np.any(np.diff(motion.command, axis=0) != 0, axis=1)
    moving = np.flatnonzero(changed)
    if len(moving):
        repeated = float(np.mean(~changed[moving[0] : moving[-1] + 1]))
        if repeated > MAX_REPEATED_FRACTION:
            notes.append(f"{100 * repeated:.0f} % of the commands repeat the previous row")
    return notes


def unit_notes(motion: RecordedMotion, robot: RobotDescription) -> list[str]:
    """Return notes on implausible units of angles and times."""
    return [*_angle_notes(motion, robot), *_time_notes(motion)]


def _angle_notes(motion: RecordedMotion, robot: RobotDescription) -> list[str]:
    """Return a note on the first motor with most of its readings outside the joint limits."""
    for motor, name in enumerate(robot.motor_names):
        angle = motion.motor_angle[:, motor]
        angle = angle[np.isfinite(angle)]
        limits = robot.urdf.joints[name].limits
        if not len(angle) or limits is None:
            continue
        low, high = sorted(robot.motor_sign[motor] * np.asarray(limits, float))
        outside = (angle < low - LIMIT_MARGIN) | (angle > high + LIMIT_MARGIN)
        if np.mean(outside) > MAX_OUTSIDE_FRACTION:
            return [
                f"{name} goes from {angle.min():.2f} to {angle.max():.2f} rad, outside its limits {low:.2f} to "
                f"{high:.2f}: are unit, sign and offset right?"
            ]
    return []


def _time_notes(motion: RecordedMotion) -> list[str]:
    steps = np.diff(motion.time)
    if not len(steps):
        return []
    rows, duration, step = len(motion.time), float(np.ptp(motion.time)), float(np.median(steps))
    if MIN_ROW_PERIOD <= step <= MAX_ROW_PERIOD or (step == 0 and duration > MIN_ROW_PERIOD * rows):
        return []
    return [f"{rows} rows in {duration:.3g} s: is the unit of time right?"]
