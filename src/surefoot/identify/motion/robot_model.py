"""Least-squares model of logs of a robot with joint actuators: simulated robots that repeat their commands.

Commands and angles are enough. Robots are simulated on the ground, or on a rack, for a part of each log.
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
"""Standard deviation with which angles of joints that move are compared [rad]: readings of unknown age, at up to 3.8
rad/s, are off by as much."""
STILL_NOISE = 0.04
"""The same for joints that stand still: friction holds them where they came to rest before the log."""
TILT_NOISE = 0.03
"""The same for roll and pitch [rad]."""
START_NOISE = 2.0
"""Factor of all noise in the first `SKIPPED_TIME` seconds."""
SPACING = 0.011
"""Least time between rows that are compared [s]."""
SECONDS = 2.3
"""Length of each log of a robot on the ground that is fitted [s], from its start; longer replays go astray."""
RACK_SECONDS = 24.0
"""The same of a robot that hangs."""
BATCH = 20
"""Candidates that are simulated at once."""
NOISE_BLOCK = 2.0
"""Length of the blocks of time [s] over which residuals of logs on a rack are taken to correlate: errors of the law of
friction repeat with every turn of a joint."""
MIN_NOISE = 0.004
"""Least noise of a log [rad] for correlated residuals: a fit that believed its law of friction further would follow it
away from masses and gains."""
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
    """Return the model of the first seconds of logs; all other parameters are as in the prior (one row).

    `noise` is that of joints that move, for each log [rad]; `MOVING_NOISE`, if not given.
    """
    noise = noise or [MOVING_NOISE] * len(motions)
    replayers = {rack: Replayer(robot, BATCH, rack, torques=False) for rack in {motion.rack for motion in motions}}
    observations = [
        _observations(robot, fitted_part(motion, seconds), replayers[motion.rack], one)
        for motion, one in zip(motions, noise, strict=True)
    ]
    return ReplayModel(unknowns, prior, observations, BATCH, MAX_RESIDUAL, robot_params)


def correlated_noise(model: ReplayModel, residuals: Array, noise: Sequence[float]) -> list[float]:
    """Return the noise of each log [rad] whose independent values would add up to as much as the residuals (m,) do.

    Residuals of a model that is a little wrong keep their sign for many rows. Their sums over `NOISE_BLOCK` of each
    motor vary as those of independent values of this standard deviation would.
    """
    found, first = [], 0
    for one, before in zip(model.observations, noise, strict=True):
        compared = np.isfinite(one.noise)
        values = np.zeros(compared.shape)
        values[compared] = residuals[first : first + compared.sum()]
        first += int(compared.sum())
        block = (np.broadcast_to(one.time, compared.shape)[:, 0] / NOISE_BLOCK).astype(np.int64)
        edges = np.flatnonzero(np.diff(block, prepend=-1))
        sums, counts = (np.add.reduceat(part, edges, axis=0) for part in (values, compared.astype(float)))
        power = sums[counts > 0] ** 2 / counts[counts > 0]
        found.append(max(before * float(np.sqrt(np.mean(power))), MIN_NOISE))
    return found


def fitted_part(motion: RecordedMotion, seconds: float | None) -> RecordedMotion:
    """Return the part of a log that is fitted: its first seconds, or by default as much as replays well."""
    return motion.until(seconds or (RACK_SECONDS if motion.rack else SECONDS))


def _observations(robot: RobotDescription, motion: RecordedMotion, replayer: Replayer, noise: float) -> Observations:
    """Return a log's angles of motors, roll and pitch (n, M + 2) as observations."""
    rows, segment = _spaced_rows(motion), segment_from_motion(motion, robot)
    recorded = np.concatenate([motion.motor_angle, motion.imu[:, :2]], axis=1)[rows]

    def errors(params: PhysicalParams, nuisance: Nuisance) -> Array:
        clock = nuisance.get((CLOCK, None), np.ones(params.num_envs))
        shift = nuisance.get((COMMAND_SHIFT, None), np.zeros(params.num_envs))
        predicted = np.empty((params.num_envs, *recorded.shape))
        for scale, late in sorted(set(zip(clock.tolist(), shift.tolist(), strict=True))):
            these = np.flatnonzero((clock == scale) & (shift == late))
            readings = replayer.run(_correct_times(segment, scale, late, robot.timing.servo_step), params.rows(these))
            predicted[these] = np.concatenate([readings.motor_angle, imu_channels(readings)[:, :, :2]], axis=2)[:, rows]
        errors = predicted - recorded
        # Attitudes of such IMUs drift from log to log: only their change is compared.
        errors[:, :, -2:] -= errors[:, :, -2:].mean(axis=1, keepdims=True)
        return errors

    # Readings of joints that hang still do not depend on the parameters.
    still, tilt = (np.inf, np.inf) if motion.rack else (STILL_NOISE, TILT_NOISE)
    sizes = np.concatenate([np.where(motion.moving, noise, still), [tilt, tilt]])
    early = ~motion.counted[rows]
    sizes = np.where(early[:, None], START_NOISE, 1.0) * sizes
    leg = np.full(robot.num_motors + 2, -1)
    for number, motors in enumerate(robot.leg_motor_index):
        leg[motors] = number
    noises = np.where(np.isfinite(recorded), sizes, np.inf)
    return Observations(errors, noises, motion.time[rows][:, None], {"leg": leg})


def _correct_times(segment: Segment, scale: float, late: float, dt: float) -> Segment:
    """Return a segment with another clock: a second takes `scale` seconds, commands are sent `late` [s] later."""
    segment = segment if scale == 1.0 else segment.with_clock_scale(scale, dt)
    if late == 0.0:
        return segment
    ticks = np.maximum(segment.command_tick + round(late / dt), 0)
    return replace(segment, command_tick=np.concatenate([[0], ticks[1:]]))


def _spaced_rows(motion: RecordedMotion) -> NDArray[np.int64]:
    """Return rows of new readings that are `SPACING` or more apart."""
    kept, last = [], -np.inf
    for row in np.flatnonzero(motion.fresh).tolist():
        if motion.read_time[row] - last >= SPACING:
            kept.append(row)
            last = motion.read_time[row]
    return np.array(kept, np.int64)
