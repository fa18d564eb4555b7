"""Least-squares model of logs of a robot with joint actuators: simulated robots replay the logged commands.

Logs need only commands and angles. Robots are simulated on the ground or on a rack, for a part of each log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.identify.model import Nuisance, Observations, ReplayModel, Unknown
from surefoot.identify.motion.priors import CLOCK, COMMAND_SHIFT
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import imu_channels
from surefoot.identify.motion.robot_unknowns import robot_params
from surefoot.identify.replay import Replayer, Segment, segment_from_motion
from surefoot.robot import PhysicalParams, RobotDescription

MOVING_NOISE = 0.006
"""Noise of the angles of moving joints [rad]: readings of unknown age, at up to 3.8 rad/s, have errors of this size."""
STILL_NOISE = 0.04
"""Noise of the angles of still joints [rad]: friction holds them where they came to rest before the log."""
TILT_NOISE = 0.03
"""Noise of roll and pitch [rad]."""
START_NOISE = 2.0
"""Factor of all noise during the first `SKIPPED_TIME`."""
MIN_ROW_SPACING = 0.011
"""Minimum time between rows that are compared [s]."""
GROUND_SECONDS = 2.3
"""Length of the fitted part of logs on the ground [s], from the start; longer replays diverge from the log."""
RACK_SECONDS = 24.0
"""Length of the fitted part of logs of a hanging robot [s]."""
BATCH = 20
"""Number of candidates that are simulated at once."""
NOISE_BLOCK = 2.0
"""Length of the time blocks [s] within which residuals of logs on a rack are taken as correlated: errors of the
friction model repeat at every reversal of a joint."""
MIN_NOISE = 0.004
"""Minimum noise of a log [rad] for correlated residuals: with less, the fit would adjust masses and gains to compensate
errors of the friction model."""
MAX_RESIDUAL = 100.0
"""Residual of a candidate that diverges, in standard deviations."""


def robot_model(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    unknowns: Sequence[Unknown],
    prior: PhysicalParams,
    seconds: float | None = None,
    noise: Sequence[float] | None = None,
) -> ReplayModel:
    """Return the residual model of the first part of some logs.

    Args:
        robot: robot description.
        motions: the logs.
        unknowns: parameters to estimate.
        prior: all other parameters, one row.
        seconds: length of the fitted part of each log. Defaults as in `fitted_part`.
        noise: noise of moving joints in each log [rad]. Defaults to `MOVING_NOISE`.
    """
    noise = noise or [MOVING_NOISE] * len(motions)
    replayers = {rack: Replayer(robot, BATCH, rack, torques=False) for rack in {motion.rack for motion in motions}}
    observations = [
        _observations(robot, fitted_part(motion, seconds), replayers[motion.rack], one)
        for motion, one in zip(motions, noise, strict=True)
    ]
    return ReplayModel(unknowns, prior, observations, BATCH, MAX_RESIDUAL, robot_params)


def correlated_noise(model: ReplayModel, residuals: Array, noise: Sequence[float]) -> list[float]:
    """Return the effective noise of each log [rad], which accounts for residuals (m,) that are correlated in time.

    Residuals of a slightly wrong model keep their sign for many rows. Independent noise with the returned standard
    deviation would have block sums (over `NOISE_BLOCK`, for each motor) of the same variance as the residuals.
    """
    effective, first = [], 0
    for one, before in zip(model.observations, noise, strict=True):
        compared = np.isfinite(one.noise)
        values = np.zeros(compared.shape)
        values[compared] = residuals[first : first + compared.sum()]
        first += int(compared.sum())
        block = (np.broadcast_to(one.time, compared.shape)[:, 0] / NOISE_BLOCK).astype(np.int64)
        edges = np.flatnonzero(np.diff(block, prepend=-1))
        sums, counts = (np.add.reduceat(part, edges, axis=0) for part in (values, compared.astype(float)))
        power = sums[counts > 0] ** 2 / counts[counts > 0]
        effective.append(max(before * float(np.sqrt(np.mean(power))), MIN_NOISE))
    return effective


def fitted_part(motion: RecordedMotion, seconds: float | None) -> RecordedMotion:
    """Return the part of a log to fit: its first `seconds`, which default to `RACK_SECONDS` or `GROUND_SECONDS`."""
    return motion.first_seconds(seconds or (RACK_SECONDS if motion.rack else GROUND_SECONDS))


def _observations(robot: RobotDescription, motion: RecordedMotion, replayer: Replayer, noise: float) -> Observations:
    """Return the motor angles, roll and pitch of a log as observations (n, M + 2)."""
    rows, segment = _spaced_rows(motion), segment_from_motion(motion, robot)
    recorded = np.concatenate([motion.motor_angle, motion.imu[:, :2]], axis=1)[rows]
    has_tilt = np.isfinite(recorded[:, -2:])

    def errors(params: PhysicalParams, nuisance: Nuisance) -> Array:
        clock = nuisance.get((CLOCK, None), np.ones(params.num_envs))
        shift = nuisance.get((COMMAND_SHIFT, None), np.zeros(params.num_envs))
        predicted = np.empty((params.num_envs, *recorded.shape))
        for scale, delay in sorted(set(zip(clock.tolist(), shift.tolist(), strict=True))):
            group = np.flatnonzero((clock == scale) & (shift == delay))
            readings = replayer.run(_correct_times(segment, scale, delay, robot.timing.servo_step), params.rows(group))
            predicted[group] = np.concatenate([readings.motor_angle, imu_channels(readings)[:, :, :2]], axis=2)[:, rows]
        errors = predicted - recorded
        # The orientation from such IMUs drifts between logs: only its change is compared.
        tilt = errors[:, :, -2:]
        tilt -= np.where(has_tilt, tilt, 0.0).sum(axis=1, keepdims=True) / np.maximum(has_tilt.sum(axis=0), 1)
        return errors

    # On a rack, readings of still joints do not depend on the parameters.
    still, tilt = (np.inf, np.inf) if motion.rack else (STILL_NOISE, TILT_NOISE)
    sizes = np.concatenate([np.where(motion.moving_joints, noise, still), [tilt, tilt]])
    early = ~motion.evaluated_rows[rows]
    sizes = np.where(early[:, None], START_NOISE, 1.0) * sizes
    leg = np.full(robot.num_motors + 2, -1)
    for number, motors in enumerate(robot.leg_motor_index):
        leg[motors] = number
    noises = np.where(np.isfinite(recorded), sizes, np.inf)
    return Observations(errors, noises, motion.time[rows][:, None], {"leg": leg})


def _correct_times(segment: Segment, scale: float, delay: float, dt: float) -> Segment:
    """Return a segment with its clock scaled and its commands sent `delay` [s] later."""
    segment = segment if scale == 1.0 else segment.with_clock_scale(scale, dt)
    if delay == 0.0:
        return segment
    ticks = np.maximum(segment.command_tick + round(delay / dt), 0)
    return replace(segment, command_tick=np.concatenate([[0], ticks[1:]]))


def _spaced_rows(motion: RecordedMotion) -> NDArray[np.int64]:
    """Return rows with new readings that are at least `MIN_ROW_SPACING` apart."""
    rows, last = [], -np.inf
    for row in np.flatnonzero(motion.has_new_reading).tolist():
        if motion.read_time[row] - last >= MIN_ROW_SPACING:
            rows.append(row)
            last = motion.read_time[row]
    return np.array(rows, np.int64)
