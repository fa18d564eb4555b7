"""Checks of a log's units, clock and commands: what looks wrong, in words."""

from __future__ import annotations

import numpy as np

from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.robot import RobotDescription

OUTSIDE = 0.5
"""Share of a motor's readings outside of its joint's limits from which the unit is doubted."""
LIMIT_MARGIN = 0.1
"""Distance beyond a joint's limits [rad] that calibrations explain."""
MIN_ROW_PERIOD = 2e-4
"""Median time between rows [s] that no logger of a legged robot has: 5 kHz."""
MAX_ROW_PERIOD = 1.0
"""The same of slow rows."""
MAX_REPEATED_FRACTION = 0.2
"""Share of repeated commands from which it is said."""


def check_log(motion: RecordedMotion, robot: RobotDescription) -> list[str]:
    """Return notes on a log that looks wrong, or whose clock or commands limit what it shows."""
    notes = unit_notes(motion, robot)
    if motion.computed_clock:
        notes.append("these times look computed, not measured: clock and delay can't be told apart")
    changed = np.any(np.diff(motion.command, axis=0) != 0, axis=1)
    moving = np.flatnonzero(changed)
    if len(moving):
        repeated = float(np.mean(~changed[moving[0] : moving[-1] + 1]))
        if repeated > MAX_REPEATED_FRACTION:
            notes.append(f"{100 * repeated:.0f} % of the commands repeat the row before")
    return notes


def unit_notes(motion: RecordedMotion, robot: RobotDescription) -> list[str]:
    """Return doubts about the units of angles and times."""
    return [*_angle_notes(motion, robot), *_time_notes(motion)]


def _angle_notes(motion: RecordedMotion, robot: RobotDescription) -> list[str]:
    """Return a doubt about the unit of angles: readings of a motor that are outside of its joint's limits."""
    for motor, name in enumerate(robot.motor_names):
        angle = motion.motor_angle[:, motor]
        angle = angle[np.isfinite(angle)]
        limits = robot.urdf.joints[name].limits
        if not len(angle) or limits is None:
            continue
        low, high = sorted(robot.motor_sign[motor] * np.asarray(limits, float))
        outside = (angle < low - LIMIT_MARGIN) | (angle > high + LIMIT_MARGIN)
        if np.mean(outside) > OUTSIDE:
            return [
                f"{name} goes from {angle.min():.2f} to {angle.max():.2f} rad, outside of its limits {low:.2f} to "
                f"{high:.2f}: are unit, sign and offset right?"
            ]
    return []


def _time_notes(motion: RecordedMotion) -> list[str]:
    steps = np.diff(motion.time)
    if not len(steps):
        return []
    rows, whole, step = len(motion.time), float(np.ptp(motion.time)), float(np.median(steps))
    if MIN_ROW_PERIOD <= step <= MAX_ROW_PERIOD or (step == 0 and whole > MIN_ROW_PERIOD * rows):
        return []
    return [f"{rows} rows in {whole:.3g} s: is the unit of time right?"]
