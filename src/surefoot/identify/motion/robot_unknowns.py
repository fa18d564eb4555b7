"""Unknowns of a fit to logs of a robot with joint actuators, and the physical parameters of candidates.

A motor parameter has one value per kind of joint (hip, thigh, calf) if the data sheet has one per kind, otherwise one
value for all motors. It is multiplied by a ratio of each motor.
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
"""Steps of finite differences on a rack, relative to steps on the ground, where contacts are not smooth. Gains, masses
and friction can all grow in proportion, and only accurate derivatives show that a log does not determine this scale."""
CONSIDERED = {"servo_latency": 0.001, "presliding": 0.002}
"""Standard deviations of parameters that are not fitted by default: data sheets only assume the latency of the servos
[s], and presliding [rad] represents friction models that differ at motion reversals."""
CLOCK_DEVIATION = 0.02
"""Standard deviation of the scale of a clock whose times look computed."""


def robot_unknowns(
    robot: RobotDescription, prior: PhysicalParams, names: Sequence[str], rack: bool = False
) -> list[Unknown]:
    """Return the unknowns of a fit, starting at the prior parameters.

    Args:
        robot: robot description.
        prior: parameters before the fit, one row.
        names: parameters to estimate, keys of `robot_priors`.
        rack: whether the robot hangs on a rack in all logs, where legs do not affect each other.

    Raises:
        SurefootError: a name is unknown.
    """
    priors = robot_priors(robot)
    if bad := [name for name in names if name not in priors]:
        raise SurefootError(f"logs can't identify '{bad[0]}'; {suggest(bad[0], priors)}")
    unknowns = []
    for number, name in enumerate(dict.fromkeys(names)):
        rule = priors[name]
        if rule.individual:
            unknowns += _individual_unknowns(robot, prior, name, rule, number if rack else None)
        else:
            groups = motors_by_joint_kind(robot, prior, name) or {"": ()}
            unknowns += [_unknown(robot, prior, name, rule, motors=m, part_name=kind) for kind, m in groups.items()]
    if rack:
        return [replace(unknown, step=RACK_STEP * unknown.step) for unknown in unknowns]
    # Logs on the ground show less of the motors; lower bounds keep their friction away from zero.
    return [
        replace(one, low=max(one.low, one.prior / priors[one.name].deviation / MAX_FACTOR))
        if priors[one.name].relative and one.prior
        else one
        for one in unknowns
    ]


def _individual_unknowns(
    robot: RobotDescription, prior: PhysicalParams, name: str, rule: Prior, colour: int | None
) -> list[Unknown]:
    """Return one unknown per motor or axis; with a colour (on a rack), unknowns of different legs share a colour."""
    if name == "base_offset":
        return [_unknown(robot, prior, name, rule, k, part_name=axis) for k, axis in enumerate(("x", "y"))]
    legs = robot.leg_motor_index
    unknowns = []
    for motor, motor_name in enumerate(robot.motor_names):
        leg, place = np.argwhere(legs == motor)[0].tolist()
        more: dict[str, Any] = (
            {} if colour is None else {"colour": colour * legs.shape[1] + place, "affects": ("leg", leg)}
        )
        unknowns.append(_unknown(robot, prior, name, rule, motor, part_name=motor_name, **more))
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
        lower, upper = (size / MAX_FACTOR if name in STRICTLY_POSITIVE else 0.0), size * MAX_FACTOR
    else:
        lower, upper, size = start - 6 * rule.deviation, start + 6 * rule.deviation, 1.0
    return Unknown(
        name,
        start,
        max(low, lower),
        min(high, upper),
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
    """Return the physical parameters of K candidates (K, n): the first row of `base` with their values.

    A value that motors share is their mean: the motors keep their proportions in `base`. Ratios are applied afterwards.
    """
    params = candidate_params(base, [u for u in unknowns if u.index is not None],
                              values[:, [u.index is not None for u in unknowns]])  # fmt: skip
    for unknown, column in zip(unknowns, values.T, strict=True):
        if unknown.index is None and unknown.name in PARAMETERS:
            array, motors = getattr(params, unknown.name), list(unknown.motors) or slice(None)
            if array.ndim == 1:
                array[:] = column
                continue
            base_values = getattr(base, unknown.name)[0, motors]
            mean = np.mean(base_values)
            proportions = base_values / mean if mean > 0 else np.ones_like(base_values)
            array[:, motors] = column[:, None] * proportions
    columns = {(unknown.name, unknown.index): values[:, i] for i, unknown in enumerate(unknowns)}
    if (DAMPING_RATIO, None) in columns:
        params.servo_kd[:] = params.servo_kp * columns[DAMPING_RATIO, None][:, None]
    for (name, index), column in columns.items():
        if name in RATIOS:
            getattr(params, RATIOS[name])[:, index] *= column
    return params


def considered_unknowns(
    robot: RobotDescription, prior: PhysicalParams, motions: Sequence[RecordedMotion], fitted: Sequence[Unknown]
) -> list[Unknown]:
    """Return the considered parameters: they are not fitted, but their prior uncertainty widens all intervals.

    They are the latency of the servos and friction at motion reversals unless they are among the fitted unknowns, the
    clock of logs whose times look computed, and the delay of repeated commands.
    """
    names = {unknown.name for unknown in fitted}
    deviations = {name: deviation for name, deviation in CONSIDERED.items() if name not in names}
    if any(motion.computed_clock for motion in motions):
        deviations[CLOCK] = CLOCK_DEVIATION
    unknowns = []
    if (interval := max(motion.command_interval for motion in motions)) > 0:
        # Commands change less often than rows: the true time of sending is uncertain by up to one interval.
        deviations[COMMAND_SHIFT] = interval / np.sqrt(12)
    for name, deviation in deviations.items():
        start = float(np.mean(_prior_values(prior, name)))
        low, high = robot.allowed.get(name, (-1.0, 2.0))
        unknowns.append(Unknown(name, start, low, high, deviation, prior=deviation))
    return unknowns
