"""Unknowns of a fit to logs of a robot with joint actuators, and the parameters of candidates.

A parameter of motors is a number for each kind of joint (hip, thigh, calf) where the sheet has one for each kind, else
one number for all motors; times a ratio of each motor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, suggest
from surefoot.identify.joint_kinds import motors_by_joint_kind
from surefoot.identify.model import Unknown, candidate_params
from surefoot.identify.motion.priors import (
    CLOCK,
    COMMAND_SHIFT,
    DAMPING_RATIO,
    MAX_FACTOR,
    RATIOS,
    STRICTLY_POSITIVE,
    Prior,
    prior_scale,
    robot_priors,
)
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS

RACK_STEP = 0.01
"""Steps of finite differences of a robot on a rack, over those of one on the ground, whose contacts are rough. Gains,
masses and friction may all be greater alike: only exact derivatives show that a log does not tell."""
CONSIDERED = {"servo_latency": 0.001, "presliding": 0.002}
"""Standard deviations of what is not fitted: sheets assume the servos' latency [s]; presliding [rad] stands for laws of
friction that differ where joints turn."""
CLOCK_DEVIATION = 0.02
"""Relative standard deviation of a clock whose times look computed."""


def robot_unknowns(
    robot: RobotDescription, prior: PhysicalParams, names: Sequence[str], rack: bool = False
) -> list[Unknown]:
    """Return the unknowns of `names` of `robot_priors`, around the parameters before (one row).

    Args:
        robot: its description.
        prior: the parameters before.
        names: what to estimate.
        rack: whether all logs are of a robot on a rack, whose legs do not affect each other.

    Raises:
        SurefootError: another name.
    """
    priors = robot_priors(robot)
    if bad := [name for name in names if name not in priors]:
        raise SurefootError(f"logs can't identify '{bad[0]}'; {suggest(bad[0], priors)}")
    unknowns = []
    for number, name in enumerate(dict.fromkeys(names)):
        rule = priors[name]
        if rule.each:
            unknowns += _individual_unknowns(robot, prior, name, rule, number if rack else None)
        else:
            groups = motors_by_joint_kind(robot, prior, name) or {"": ()}
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


def _individual_unknowns(
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
