"""The mass experiment's fit: what the feet carry is the weight; what their forces turn, and how fast, the inertia."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.identify.accuracy import with_floor
from surefoot.identify.fits.motor import GAIN
from surefoot.identify.ground_motion import (
    GroundMotion,
    block_deviation,
    check_feet,
    check_stands,
    forces_of,
    ground_motion,
    regress,
)
from surefoot.identify.inverse_dynamics import Forces
from surefoot.identify.quality import check_recording
from surefoot.identify.recording import Recording
from surefoot.identify.registry import FitProgress
from surefoot.identify.result import Check, Estimate, Identification, Series
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

Array = NDArray[np.float64]

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
    tell: FitProgress | None,
) -> Identification:
    """What the mass experiment tells.

    Raises:
        SurefootError: data too poor to tell anything, or a robot that did not stand.
    """
    notes = list(check_recording(recording, robot))
    standing = ground_motion(robot, recording, known, sensors)
    still, turning = standing.during(*STILL), standing.during(*TURNING)
    check_stands(standing)
    accuracy = float(sensors.get("torque_accuracy", GAIN / np.sqrt(robot.num_motors)))
    if "torque_gain" not in sensors:
        notes.append("the motors were not identified before: their torque reports are taken as they are")
    params = known.rows(np.zeros(1, np.int64))
    for k in range(ROUNDS):
        forces, dynamics = forces_of(robot, standing, params)
        check_feet(standing, forces, dynamics)
        weight = forces.force[still, :, 1].sum(axis=1)
        base = dynamics.base_mass
        total, legs = float(weight.mean()) / GRAVITY, dynamics.mass - base
        columns, lacking = _turning(standing, forces, turning)
        found, covariance = regress(columns, lacking, standing.blocks[turning])
        params.base_mass_ratio[0] *= _within(robot, "base_mass_ratio", (total - legs) / base, params)
        params.base_inertia_ratio[0] *= _within(robot, "base_inertia_ratio", 1 + float(found[0]), params)
        if tell is not None:
            tell(f"round {k + 1}: {total:.3f} kg", float("nan"))
    forces, dynamics = forces_of(robot, standing, params)
    mass_spread = float(np.hypot(block_deviation(weight, standing.blocks[still]) / GRAVITY, accuracy * total))
    inertia = float(params.base_inertia_ratio[0])
    # Moments carry the scale of forces, and the legs' inertia with the base's.
    inertia_spread = inertia * float(np.hypot(np.sqrt(covariance[0, 0]), 2 * accuracy))
    ratio = float(params.base_mass_ratio[0])
    estimates = [
        _estimate(robot, "base_mass_ratio", ratio, mass_spread / base * ratio),
        _estimate(robot, "base_inertia_ratio", inertia, inertia_spread, told=inertia_spread < SEEN * inertia),
        Estimate("total_mass", total, with_floor("total_mass", total, mass_spread), "kg", low=0.0),
        *_centre(robot, standing, forces, still, accuracy),
    ]
    if not estimates[1].told:
        notes.append("the base turned too little about y to tell its inertia")
    else:
        notes.append("base_inertia_ratio is seen in turns about y alone, and taken for all axes")
    result = Identification("mass", robot.name, tuple(estimates))
    after = result.params(robot, known)
    checks, series = _check(robot, standing, known, after)
    return Identification(
        "mass", robot.name, tuple(estimates), checks, (), tuple(notes), series, {}, recording.digest,
        str(recording.meta["date"]),
    )  # fmt: skip


def _within(robot: RobotDescription, name: str, factor: float, params: PhysicalParams) -> float:
    """A factor that leaves a ratio within what the robot allows."""
    low, high = robot.allowed[name]
    now = float(getattr(params, name)[0])
    return float(np.clip(now * factor, low, high)) / now


def _estimate(robot: RobotDescription, name: str, value: float, deviation: float, told: bool = True) -> Estimate:
    low, high = robot.allowed[name]
    unit = PhysicalParams.unit(name)
    return Estimate(name, value, with_floor(name, value, deviation), unit, None, told, low, high)


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
    kept = standing.during("nod back", use="check")
    if not kept.any():
        return (), ()
    carried, lacking, moments = [], [], []
    for params in (before, after):
        forces, dynamics = forces_of(robot, standing, params)
        carried.append(abs(float(forces.force[kept, :, 1].sum(axis=1).mean()) - GRAVITY * dynamics.mass))
        left = forces.needed[kept, 2]
        lacking.append(float(np.std(left)))
        moments.append((forces.turning[kept], _pushed(forces)[kept]))
    time = standing.time[kept] - standing.time[kept][0]
    measured = moments[1][1] - np.mean(moments[1][1] - moments[1][0])
    series = Series(
        "turning of the base about y, not fitted", "time [s]", "moment [N m]", time, measured, moments[0][0],
        moments[1][0],
    )  # fmt: skip
    return (
        Check("weight on the feet", carried[0], carried[1], "N"),
        Check("moment about y", lacking[0], lacking[1], "N m"),
    ), (series,)


def _pushed(forces: Forces) -> Array:
    """Moment about y (T,) [N m] that forces on the feet leave for the base's own turning."""
    return forces.turning - forces.needed[:, 2]
