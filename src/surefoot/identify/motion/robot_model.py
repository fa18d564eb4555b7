"""Least-squares model of logs of a robot with joint actuators: observations, unknowns and parameters.

Commands and angles are enough. Robots are simulated on the ground, or on a rack, for a part of each log.

A parameter of motors is a number for each kind of joint (hip, thigh, calf) where the sheet has one for each kind, else
one number for all motors; times a ratio of each motor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, suggest
from surefoot.identify.joint_kinds import kinds_of_joints
from surefoot.identify.model import Nuisance, Observations, ReplayModel, Unknown, candidate_params
from surefoot.identify.motion.priors import (
    CLOCK,
    COMMAND_SHIFT,
    DAMPING_RATIO,
    MAX_FACTOR,
    RATIOS,
    STRICTLY_POSITIVE,
    Prior,
    prior_scale,
    priors_of,
)
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import imu_channels
from surefoot.identify.replay import Replayer, Segment, segment_from_motion
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS

MOVING_NOISE = 0.006
"""Standard deviation with which angles of joints that move are compared [rad]: readings of unknown age, at up to 3.8
rad/s, are off by as much."""
STILL_NOISE = 0.04
"""The same for joints that stand still: friction holds them where they came to rest before the log."""
TILT_NOISE = 0.03
"""The same for roll and pitch [rad]."""
START_NOISE = 2.0
"""Factor of all noise in the first `SKIPPED` seconds."""
SPACING = 0.011
"""Least time between rows that are compared [s]."""
SECONDS = 2.3
"""Length of each log of a robot on the ground that is fitted [s], from its start; longer replays go astray."""
RACK_SECONDS = 24.0
"""The same of a robot that hangs."""
BATCH = 20
"""Candidates that are simulated at once."""
RACK_STEP = 0.01
"""Steps of finite differences of a robot on a rack, over those of one on the ground, whose contacts are rough. Gains,
masses and friction may all be greater alike: only exact derivatives show that a log does not tell."""
NOISE_BLOCK = 2.0
"""Length of the blocks of time [s] over which residuals of logs on a rack are taken to correlate: errors of the law of
friction repeat with every turn of a joint."""
MIN_NOISE = 0.004
"""Least noise of a log [rad] for correlated residuals: a fit that believed its law of friction further would follow it
away from masses and gains."""
CONSIDERED = {"servo_latency": 0.001, "presliding": 0.002}
"""Standard deviations of what is not fitted: sheets assume the servos' latency [s]; presliding [rad] stands for laws of
friction that differ where joints turn."""
CLOCK_DEVIATION = 0.02
"""Relative standard deviation of a clock whose times look computed."""
MAX_RESIDUAL = 100.0
"""Residual of a candidate that diverges, in standard deviations."""


def robot_unknowns(
    robot: RobotDescription, prior: PhysicalParams, names: Sequence[str], rack: bool = False
) -> list[Unknown]:
    """Return the unknowns of `names` of `priors_of`, around the parameters before (one row).

    Args:
        robot: its description.
        prior: the parameters before.
        names: what to estimate.
        rack: whether all logs are of a robot on a rack, whose legs do not affect each other.

    Raises:
        SurefootError: another name.
    """
    priors = priors_of(robot)
    if bad := [name for name in names if name not in priors]:
        raise SurefootError(f"logs can't identify '{bad[0]}'; {suggest(bad[0], priors)}")
    unknowns = []
    for number, name in enumerate(dict.fromkeys(names)):
        rule = priors[name]
        if rule.each:
            unknowns += _own_unknowns(robot, prior, name, rule, number if rack else None)
        else:
            groups = kinds_of_joints(robot, prior, name) or {"": ()}
            unknowns += [_unknown(robot, prior, name, rule, motors=m, whose=kind) for kind, m in groups.items()]
    if rack:
        return [replace(unknown, step=RACK_STEP * unknown.step) for unknown in unknowns]
    # Logs on the ground tell less of motors: none has next to no friction.
    return [
        replace(one, low=max(one.low, one.prior / priors[one.name].deviation / MAX_FACTOR))
        if priors[one.name].relative and one.prior
        else one
        for one in unknowns
    ]


def _own_unknowns(
    robot: RobotDescription, prior: PhysicalParams, name: str, rule: Prior, colour: int | None
) -> list[Unknown]:
    """Return an unknown for each motor or axis; on a rack, with a colour, those of different legs vary at once."""
    if name == "base_offset":
        return [_unknown(robot, prior, name, rule, k, whose=axis) for k, axis in enumerate(("x", "y"))]
    legs = robot.leg_motor_index
    unknowns = []
    for motor, whose in enumerate(robot.motor_names):
        leg, place = np.argwhere(legs == motor)[0].tolist()
        more: dict[str, Any] = (
            {} if colour is None else {"colour": colour * legs.shape[1] + place, "affects": ("leg", leg)}
        )
        unknowns.append(_unknown(robot, prior, name, rule, motor, whose=whose, **more))
    return unknowns


def _unknown(
    robot: RobotDescription,
    prior: PhysicalParams,
    name: str,
    rule: Prior,
    index: int | None = None,
    motors: tuple[int, ...] = (),
    **more: Any,
) -> Unknown:
    values = _prior_values(prior, name)
    start = float(np.mean(values[list(motors)] if motors else values) if index is None else values[index])
    start = start if rule.start is None else rule.start
    low, high = robot.allowed.get(name, (-np.inf, np.inf))
    if rule.relative:
        size = prior_scale(robot, name, start)
        least, most = (size / MAX_FACTOR if name in STRICTLY_POSITIVE else 0.0), size * MAX_FACTOR
    else:
        least, most, size = start - 6 * rule.deviation, start + 6 * rule.deviation, 1.0
    return Unknown(
        name,
        start,
        max(low, least),
        min(high, most),
        rule.step * size,
        index,
        rule.deviation * size,
        motors=motors,
        **more,
    )


def _prior_values(prior: PhysicalParams, name: str) -> Array:
    if name == DAMPING_RATIO:
        return np.atleast_1d(np.mean(prior.servo_kd[0]) / np.mean(prior.servo_kp[0]))
    if name in (CLOCK, COMMAND_SHIFT):
        return np.ones(1) if name == CLOCK else np.zeros(1)
    if name in RATIOS:
        values = getattr(prior, RATIOS[name])[0]
        return np.ones_like(values)
    return np.atleast_1d(getattr(prior, name)[0])


def robot_params(base: PhysicalParams, unknowns: Sequence[Unknown], values: Array) -> PhysicalParams:
    """Return one row of `base` for each of K candidates (K, n).

    A number that motors share is their mean: they keep the proportions of the base. Then the ratios are applied.
    """
    params = candidate_params(base, [u for u in unknowns if u.index is not None],
                              values[:, [u.index is not None for u in unknowns]])  # fmt: skip
    for unknown, column in zip(unknowns, values.T, strict=True):
        if unknown.index is None and unknown.name in PARAMETERS:
            array, motors = getattr(params, unknown.name), list(unknown.motors) or slice(None)
            if array.ndim == 1:
                array[:] = column
                continue
            own = getattr(base, unknown.name)[0, motors]
            share = own / np.mean(own) if np.mean(own) > 0 else np.ones_like(own)
            array[:, motors] = column[:, None] * share
    columns = {(unknown.name, unknown.index): values[:, i] for i, unknown in enumerate(unknowns)}
    if (DAMPING_RATIO, None) in columns:
        params.servo_kd[:] = params.servo_kp * columns[DAMPING_RATIO, None][:, None]
    for (name, index), column in columns.items():
        if name in RATIOS:
            getattr(params, RATIOS[name])[:, index] *= column
    return params


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


def considered_unknowns(
    robot: RobotDescription, prior: PhysicalParams, motions: Sequence[RecordedMotion]
) -> list[Unknown]:
    """Return what is neither fitted nor known exactly, with prior deviations: it widens the intervals of the rest.

    The servos' latency, the law of friction where a joint turns, and the clock of logs whose times look computed.
    """
    deviations = dict(CONSIDERED)
    if any(motion.computed_clock for motion in motions):
        deviations[CLOCK] = CLOCK_DEVIATION
    unknowns = []
    if (interval := max(motion.command_interval for motion in motions)) > 0:
        # A row repeats a command that is up to an interval old, or rows were looked up in a slower table.
        deviations[COMMAND_SHIFT] = interval / np.sqrt(12)
    for name, deviation in deviations.items():
        start = float(np.mean(_prior_values(prior, name)))
        low, high = robot.allowed.get(name, (-1.0, 2.0))
        unknowns.append(Unknown(name, start, low, high, deviation, prior=deviation))
    return unknowns


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
    rows, segment = spaced_rows(motion), segment_from_motion(motion, robot)
    recorded = np.concatenate([motion.motor_angle, motion.imu[:, :2]], axis=1)[rows]

    def errors(params: PhysicalParams, nuisance: Nuisance) -> Array:
        clock = nuisance.get((CLOCK, None), np.ones(params.num_envs))
        shift = nuisance.get((COMMAND_SHIFT, None), np.zeros(params.num_envs))
        predicted = np.empty((params.num_envs, *recorded.shape))
        for scale, late in sorted(set(zip(clock.tolist(), shift.tolist(), strict=True))):
            these = np.flatnonzero((clock == scale) & (shift == late))
            readings = replayer.run(_retimed(segment, scale, late, robot.timing.servo_step), params.rows(these))
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


def _retimed(segment: Segment, scale: float, late: float, dt: float) -> Segment:
    """Return a segment with another clock: a second takes `scale` seconds, commands are sent `late` [s] later."""
    segment = segment if scale == 1.0 else segment.stretched(scale, dt)
    if late == 0.0:
        return segment
    ticks = np.maximum(segment.order_tick + round(late / dt), 0)
    return replace(segment, order_tick=np.concatenate([[0], ticks[1:]]))


def spaced_rows(motion: RecordedMotion) -> NDArray[np.int64]:
    """Return rows of new readings that are `SPACING` or more apart."""
    kept, last = [], -np.inf
    for row in np.flatnonzero(motion.fresh).tolist():
        if motion.read_time[row] - last >= SPACING:
            kept.append(row)
            last = motion.read_time[row]
    return np.array(kept, np.int64)
