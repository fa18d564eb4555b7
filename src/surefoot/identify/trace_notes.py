"""What whoever reads what traces told should know."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.connection import LEAD
from surefoot.errors import choices
from surefoot.identify.result import Estimate
from surefoot.identify.trace_rows import Piece
from surefoot.identify.trace_unknowns import NAMES
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

AT_LIMIT = 0.9
"""Share of the time with the greatest torque from which a motor tells nothing but its strength."""


def notes_on_traces(
    robot: RobotDescription,
    traces: Sequence[EpisodeTrace],
    pieces: Sequence[Piece],
    moving: NDArray[np.bool_],
    wanted: Sequence[str],
) -> list[str]:
    """What is odd about the data."""
    notes = []
    for number, trace in enumerate(traces):
        step = float(trace.meta["control_step"])
        jumps = np.flatnonzero(np.abs(np.diff(trace.time) - step) > 0.25 * step)
        if len(jumps):
            notes.append(
                f"trace {number + 1}: time jumps {len(jumps)} times, first at {trace.time[jumps[0]]:.2f} s; "
                "rows around jumps are left out"
            )
        if missed := len(trace.meta.get("missed_steps", [])):
            notes.append(f"trace {number + 1}: {missed} control steps were missed; rows around them are left out")
        if not any(piece.number == number for piece in pieces):
            notes.append(f"trace {number + 1}: {trace.duration:.2f} s are too short, or full of gaps; it is left out")
    if "motor_strength" in wanted:
        notes += [
            f"{robot.motor_names[motor]} never moves, so its strength is not told"
            for motor in np.flatnonzero(~moving).tolist()
        ]
    torque = np.concatenate([np.abs(piece.torque) for piece in pieces])
    full = np.mean(torque > 0.97 * torque.max(axis=0), axis=0)
    notes += [
        f"{robot.motor_names[motor]} gives its greatest torque in {100 * full[motor]:.0f} % of the steps: "
        "it tells nothing of servo, latencies and battery"
        for motor in np.flatnonzero(moving & (full > AT_LIMIT)).tolist()
    ]
    return notes


def notes_on_estimates(estimates: Sequence[Estimate], wanted: Sequence[str], held: Sequence[Piece]) -> list[str]:
    """What the traces do not tell, and what goes with what."""
    notes = []
    if untold := [e.label for e in estimates if not e.told and e.name in NAMES]:
        notes.append(f"the traces do not tell {choices(untold)}: what was known before is kept")
    if {"voltage", "torque_constant", "resistance"} <= set(wanted):
        volts = next(e.value for e in estimates if e.name == "voltage")
        notes.append(
            f"torque_constant and resistance go with a voltage of {volts:g} V, which traces do not tell beside them; "
            "measure the battery, say so, and leave voltage out, and their intervals shrink"
        )
    if held[0].reporting.spread:
        notes.append(
            f"the robot told its readings in real time, {1e3 * LEAD:g} ms before they were used: a control latency "
            "below that is not seen, and acts as that"
        )
    return notes
