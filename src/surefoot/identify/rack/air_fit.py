"""Fit of the air experiment: a recording of a robot with joint actuators, fitted like a log of commands and angles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from surefoot.errors import SurefootError
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.robot_fit import fit_robot
from surefoot.identify.recording import CLOCK_RESOLUTION, Recording
from surefoot.identify.result import FitProgress, Identification
from surefoot.robot import PhysicalParams, RobotDescription


def fit_air(
    robot: RobotDescription, recording: Recording, prior: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """Return the result of the air experiment; see `Experiment.fit`. Gains that the robot reports are not fitted."""
    gains = {name: np.asarray(values, float) for name, values in recording.meta.get("gains", {}).items()}
    prior = prior.with_values(robot, **{name: values[None] for name, values in gains.items()})
    parts = {use: motion_from_phases(recording, use) for use in ("fit", "check")}
    result = fit_robot(
        robot, [parts["fit"]], [parts["check"]], None, prior, float(np.ptp(parts["fit"].time)), report=report,
        known=tuple(gains),
    )  # fmt: skip
    if result.failure:
        raise SurefootError("; ".join(result.failure))
    return replace(result, experiment="air")


def motion_from_phases(recording: Recording, use: str) -> RecordedMotion:
    """Return a recording from the first to the last phase with a use (fit or check), as a log of a hanging robot.

    Each row is a state, with the command in effect and the servo step in which it began to act. The control latency
    includes the lead, the time from sending a state to its use.
    """
    phases = recording.require_phases(use)
    states = np.arange(recording.phase_states(phases[0]).start, recording.phase_states(phases[-1]).stop)
    # Arrival times that no state reports are estimates, and may be out of order.
    arrival = np.maximum.accumulate(recording.arrival)
    command = np.clip(np.searchsorted(arrival, recording.time[states] + CLOCK_RESOLUTION, side="right") - 1, 0, None)
    acts = recording.servo_step(arrival[command]) * float(recording.meta["servo_period"])
    return RecordedMotion(
        f"{use} phases",
        acts - acts[0],
        recording.sent_value[command],
        recording.time[states] + float(recording.meta["lead"]) - acts[0],
        recording.motor_angle[states],
        recording.motor_velocity[states],
        recording.motor_torque[states],
        rack=True,
        meta={"clock": "robot"},
    ).require_replayable()
