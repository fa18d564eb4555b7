"""Searches for initial parameters of a fit to logs, if the data sheet may be far off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.model import ReplayModel, Unknown
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.robot_model import robot_model
from surefoot.identify.result import FitProgress
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS

GAIN_FACTORS = 2.0 ** np.arange(-3.0, 3.01, 0.5)
"""Grid of proportional gains, relative to the prior."""
DAMPING_TIMES = 0.005 * 2.0 ** np.arange(0.0, 5.01, 0.7)
"""Grid of derivative gains, divided by the proportional gain [s]."""
GAIN_SECONDS = 3.0
"""Length of the part of each log that the gain search uses [s]."""
GAIN_NOISE = 0.02
"""Noise of angles in the gain search [rad]."""
_POPULATION = 16


def find_gains(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    unknowns: Sequence[Unknown],
    prior: PhysicalParams,
    report: FitProgress,
) -> Array | None:
    """Search a grid of servo gains, because a fit that starts far from the true gains ends in another minimum.

    Returns:
        Start values (n,) of the unknowns with the best gains, or None if the gains are not both unknown.
    """
    stiffness, damping = ([k for k, one in enumerate(unknowns) if one.name == name] for name in GAINS)
    if not stiffness or not damping:
        return None
    report("searching for gains", float("nan"))
    moving = [one.from_first_motion() for one in motions]
    short = [one.first_seconds(min(GAIN_SECONDS, float(np.ptp(one.time)))) for one in moving]
    model = robot_model(robot, short, unknowns, prior, GAIN_SECONDS, [GAIN_NOISE] * len(short))
    factors, times = (grid.ravel() for grid in np.meshgrid(GAIN_FACTORS, DAMPING_TIMES))
    candidates = np.tile([unknown.start for unknown in unknowns], (len(factors), 1))
    candidates[:, stiffness] *= factors[:, None]
    for kd in damping:
        same = [kp for kp in stiffness if _share_motors(unknowns[kp], unknowns[kd])]
        candidates[:, kd] = candidates[:, same].mean(axis=1) * times
    low, high = (np.array([getattr(unknown, end) for unknown in unknowns]) for end in ("low", "high"))
    candidates = np.clip(candidates, low, high)
    return np.asarray(candidates[int(np.argmin(np.sum(model.residuals(candidates) ** 2, axis=1)))])


def _share_motors(one: Unknown, other: Unknown) -> bool:
    """Return whether two unknowns have a motor in common; unknowns without motors belong to all."""
    return not one.motors or not other.motors or not set(one.motors).isdisjoint(other.motors)


def search_start(model: ReplayModel, generations: int, seed: int, report: FitProgress) -> Array:
    """Search initial values (n,) with CMA-ES over the unknowns that are shared by all motors.

    The search is scaled by the prior standard deviations.

    Raises:
        SurefootError: each unknown belongs to a single motor or axis.
    """
    import cma

    unknowns = model.unknowns
    shared = [i for i, unknown in enumerate(unknowns) if unknown.index is None]
    if not shared:
        raise SurefootError(
            "--generations searches over parameters that all motors share; none of them is to be identified"
        )
    starts, low, high = (np.array([getattr(unknown, end) for unknown in unknowns]) for end in ("start", "low", "high"))
    spread = np.array([unknown.prior or 1.0 for unknown in unknowns])
    options = {"seed": seed or 1, "popsize": _POPULATION, "maxiter": generations, "verbose": -9}
    evolution = cma.CMAEvolutionStrategy(np.zeros(len(shared)), 0.5, options)
    best, min_cost = starts, np.inf
    while not evolution.stop():
        steps = np.array(evolution.ask())
        candidates = np.tile(starts, (len(steps), 1))
        candidates[:, shared] += steps * spread[shared]
        candidates = np.clip(candidates, low, high)
        costs = np.sum(model.residuals(candidates) ** 2, axis=1) + np.sum(steps**2, axis=1)
        evolution.tell(list(steps), costs.tolist())
        if costs.min() < min_cost:
            best, min_cost = candidates[int(np.argmin(costs))], float(costs.min())
        report(f"search, generation {evolution.countiter}", min_cost / len(model.blocks))
    return best
