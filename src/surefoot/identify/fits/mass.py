"""The mass experiment's fit: what the feet carry is the weight; what their forces turn, and how fast, the inertia."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.identify.accuracy import with_floor
from surefoot.identify.fits.motor import GAIN
from surefoot.identify.ground_motion import GroundMotion, block_deviation, check_feet, ground_motion, regress
from surefoot.identify.inverse_dynamics import Forces, InverseDynamics
from surefoot.identify.recording import Recording
from surefoot.identify.registry import FitProgress
from surefoot.identify.result import Check, Estimate, Identification, Series
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

STILL = ("stand still", "squat slowly")
"""Phases in which nothing is fast: what the feet carry on average is the weight."""
TURNING = ("nod",)
"""Phases in which the base turns fast about y."""
ROUNDS = 4
SEEN = 0.15
"""Standard deviation of what is told of the base's inertia, in shares of it, beyond which it is not told."""


def fit_mass(
    robot: RobotDescription,
    recording: Recording,
    known: PhysicalParams,
    sensors: dict[str, Any],
    tell: FitProgress,
) -> Identification:
    """What the mass experiment tells.

    Raises:
        SurefootError: data too poor to tell anything, or a robot that did not stand.
    """
    standing = ground_motion(robot, recording, known, sensors)
    still, turning = standing.during(*STILL), standing.during(*TURNING)
    notes = []
    accuracy = float(sensors.get("torque_accuracy", GAIN / np.sqrt(robot.num_motors)))
    if "torque_gain" not in sensors:
        notes.append("the motors were not identified before: their torque reports are taken as they are")
    params = known.rows(np.zeros(1, np.int64))
    for k in range(ROUNDS):
        dynamics = InverseDynamics(robot, params)
        forces = dynamics.forces(standing.motion)
        check_feet(standing, forces, dynamics)
        weight = forces.force[still, :, 1].sum(axis=1)
        base = dynamics.base_mass
        total, legs = float(weight.mean()) / GRAVITY, dynamics.mass - base
        columns, lacking = _turning(standing, forces, turning)
        found, covariance = regress(columns, lacking, standing.blocks[turning])
        params.base_mass_ratio[0] *= _within(robot, "base_mass_ratio", (total - legs) / base, params)
        params.base_inertia_ratio[0] *= _within(robot, "base_inertia_ratio", 1 + float(found[0]), params)
        tell(f"round {k + 1}: {total:.3f} kg", float("nan"))
    forces = InverseDynamics(robot, params).forces(standing.motion)
    mass_spread = float(np.hypot(block_deviation(weight, standing.blocks[still]) / GRAVITY, accuracy * total))
    inertia = float(params.base_inertia_ratio[0])
    # Moments carry the scale of forces, and the legs' inertia with the base's.
    inertia_spread = inertia * float(np.hypot(np.sqrt(covariance[0, 0]), 2 * accuracy))
    inertia_spread, told = with_floor("base_inertia_ratio", inertia, inertia_spread), inertia_spread < SEEN * inertia
    ratio = float(params.base_mass_ratio[0])
    ratio_spread = with_floor("base_mass_ratio", ratio, mass_spread / base * ratio)
    if told:
        notes.append("base_inertia_ratio is seen in turns about y alone, and taken for all axes")
    else:
        notes.append("the base turned too little about y to tell its inertia")
    result = Identification(
        "mass",
        robot.name,
        (
            Estimate.of_parameter(robot, "base_mass_ratio", ratio, ratio_spread),
            Estimate.of_parameter(robot, "base_inertia_ratio", inertia, inertia_spread, told=told),
            Estimate("total_mass", total, with_floor("total_mass", total, mass_spread), "kg", low=0.0),
            *_centre(robot, standing, forces, still, accuracy),
        ),
        notes=tuple(notes),
    )
    checks, series = _check(robot, standing, known, result.params(robot, known))
    return replace(result, checks=checks, series=series)


def _within(robot: RobotDescription, name: str, factor: float, params: PhysicalParams) -> float:
    """A factor that leaves a ratio within what the robot allows."""
    low, high = robot.allowed[name]
    now = float(getattr(params, name)[0])
    return float(np.clip(now * factor, low, high)) / now


def _turning(standing: GroundMotion, forces: Forces, during: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Columns: moment of the base's own inertia, and one constant a phase; and the moment that forces lack.

    What forces on the feet turn the robot with is more than its motion takes, or less, by as much as the base's
    inertia is more or less than it was taken to be. Constants are where the centre of mass is not as described.
    """
    phases = standing.phase[during]
    constants = [(phases == k).astype(float) for k in np.unique(phases)]
    return np.stack([forces.turning[during], *constants], axis=1), -forces.needed[during, 2]


def _centre(
    robot: RobotDescription, standing: GroundMotion, forces: Forces, still: NDArray[np.bool_], accuracy: float
) -> list[Estimate]:
    """Centre of mass of the whole robot, from its base's origin along x and y, from what each foot carries."""
    carried = forces.force[still, :, 1]
    total = carried.sum(axis=1)
    forward = (forces.foot[still, :, 0] * carried - forces.foot[still, :, 1] * forces.force[still, :, 0]).sum(axis=1)
    # A robot that leans is held up sideways too, at its feet: below the centre of mass by about their own depth.
    leaning = np.tan(standing.motion.roll_pitch[still, 0]) * -forces.foot[still, :, 1].mean(axis=1)
    left = (robot.leg_mounts[:, 1] * carried).sum(axis=1) + leaning * total
    reach = np.abs(robot.leg_mounts[:, :2]).mean(axis=0)
    estimates = []
    for axis, moment in enumerate((forward, left)):
        values = moment / total
        spread = float(np.hypot(block_deviation(values, standing.blocks[still]), accuracy * reach[axis]))
        estimates.append(Estimate(f"centre_of_mass_{'xy'[axis]}", float(values.mean()), spread, "m"))
    return estimates


def _check(
    robot: RobotDescription, standing: GroundMotion, before: PhysicalParams, after: PhysicalParams
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """How well forces on the feet and motion fit in phases that were not fitted."""
    kept = standing.during("nod back", uses=("check",))
    if not kept.any():
        return (), ()
    carried, lacking, turning = np.empty(2), np.empty(2), np.empty((2, int(kept.sum())))
    for k, params in enumerate((before, after)):
        dynamics = InverseDynamics(robot, params)
        forces = dynamics.forces(standing.motion)
        carried[k] = abs(float(forces.force[kept, :, 1].sum(axis=1).mean()) - GRAVITY * dynamics.mass)
        lacking[k], turning[k] = np.std(forces.needed[kept, 2]), forces.turning[kept]
    # What forces on the feet leave for the base's own turning.
    measured = (forces.turning - forces.needed[:, 2])[kept]
    measured = measured - np.mean(measured - turning[1])
    time = standing.time[kept] - standing.time[kept][0]
    labels = "turning of the base about y, not fitted", "time [s]", "moment [N m]"
    checks = (
        Check("weight on the feet", float(carried[0]), float(carried[1]), "N"),
        Check("moment about y", float(lacking[0]), float(lacking[1]), "N m"),
    )
    return checks, (Series(*labels, time, measured, turning[0], turning[1]),)
