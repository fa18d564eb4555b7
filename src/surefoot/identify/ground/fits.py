"""Fits of the experiments on the ground.

Mass: what the feet carry is the weight; what their forces turn, and how fast, the inertia. Contact: friction from
dragged feet, stiffness and damping from a body that nods on them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.fitting import GAIN
from surefoot.identify.ground.inverse_dynamics import Forces, InverseDynamics
from surefoot.identify.ground.motion import (
    STEP,
    THIN,
    GroundMotion,
    block_deviation,
    check_feet,
    ground_motion,
    regress,
)
from surefoot.identify.ground.plans import ends, sides
from surefoot.identify.recording import Recording
from surefoot.identify.result import FitProgress
from surefoot.identify.result import Check, Identification, ParameterEstimate, Series, with_floor
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

STILL = ("stand still", "squat slowly")
"""Phases in which nothing is fast: what the feet carry on average is the weight."""
TURNING = ("nod",)
"""Phases in which the base turns fast about y."""
ROUNDS = 4
SEEN = 0.15
"""Standard deviation of what is told of the base's inertia, in shares of it, beyond which it is not identifiable."""
SLIDING = 0.15
"""Speed of a foot over the ground [m/s] from which on it slides for sure."""
LEAST = 2.0
"""Force [N] with which a foot must touch the ground to count."""
FEWEST = 40
"""Values with a sliding foot, and with all feet on the ground, that are needed."""
SURE = 0.04
"""What friction, stiffness and damping are known to at best, of their value: the legs' masses, torques and the feet's
roundness are in all forces."""
TREND = 0.5
"""Slow changes of heights and forces, over so many seconds, are taken away: the gyro adds up its errors."""


def fit_mass(
    robot: RobotDescription, recording: Recording, known: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """What the mass experiment tells; see `Experiment.fit`."""
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
        report(f"round {k + 1}: {total:.3f} kg", float("nan"))
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
            ParameterEstimate.within_bounds(robot, "base_mass_ratio", ratio, ratio_spread),
            ParameterEstimate.within_bounds(robot, "base_inertia_ratio", inertia, inertia_spread, identifiable=told),
            ParameterEstimate("total_mass", total, with_floor("total_mass", total, mass_spread), "kg", low=0.0),
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
) -> list[ParameterEstimate]:
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
        estimates.append(ParameterEstimate(f"centre_of_mass_{'xy'[axis]}", float(values.mean()), spread, "m"))
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


def fit_contact(
    robot: RobotDescription, recording: Recording, known: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """What the contact experiment tells; see `Experiment.fit`."""
    standing = ground_motion(robot, recording, known, sensors)
    dynamics = InverseDynamics(robot, known)
    forces = dynamics.forces(standing.motion)
    check_feet(standing, forces, dynamics)
    friction, points = _friction(robot, standing, forces, known)
    stiffness, damping, sunk = _compliance(robot, standing, forces)
    notes = ["feet are taken to be as stiff along the ground as into it; that is not measured"]
    if not friction.identifiable:
        notes.insert(0, "feet that were dragged did not slide: their friction is not identifiable")
    found = (friction, stiffness, damping)
    return Identification("contact", robot.name, found, notes=tuple(notes), series=(*points, sunk))


def _friction(
    robot: RobotDescription, standing: GroundMotion, forces: Forces, known: PhysicalParams
) -> tuple[ParameterEstimate, tuple[Series, ...]]:
    """Coulomb's law on feet that slide along x: F_x = -mu F_z sign(v) + c, c from errors of the torque reports."""
    speed = _sliding_speed(robot, standing, forces)
    dragged = standing.during("drag")
    found, weights, along, down = [], [], [], []
    for leg in range(forces.force.shape[1]):
        slides = dragged & _light(robot, standing)[:, leg]
        slides &= (np.abs(speed[:, leg]) > SLIDING) & (forces.force[:, leg, 1] > LEAST)
        if slides.sum() < FEWEST:
            continue
        columns = np.stack([forces.force[slides, leg, 1] * -np.sign(speed[slides, leg]), np.ones(slides.sum())], axis=1)
        values, covariance = regress(columns, forces.force[slides, leg, 0], standing.blocks[slides])
        found.append(float(values[0]))
        weights.append(float(covariance[0, 0]))
        along += (forces.force[slides, leg, 0] - values[1]).tolist()
        down += columns[:, 0].tolist()
    if not found:
        before, (low, high) = float(known.contact_friction[0]), robot.allowed["contact_friction"]
        return ParameterEstimate.within_bounds(robot, "contact_friction", before, high - low, identifiable=False), ()
    value = float(np.mean(found))
    spread = float(np.std(found, ddof=1)) if len(found) > 1 else SURE * value * 2
    own = float(np.sqrt(np.mean(weights)))
    deviation = float(np.hypot(np.hypot(spread, own) / np.sqrt(len(found)), SURE * value))
    x = np.array(down)
    order = np.argsort(x)[:: max(len(x) // 400, 1)]
    labels = "dragged feet", "weight on the foot, against its motion [N]", "force along the ground [N]"
    nothing = np.full(len(order), np.nan)
    series = Series(*labels, x[order], np.array(along)[order], nothing, value * x[order], points=True)
    return ParameterEstimate.within_bounds(robot, "contact_friction", value, deviation), (series,)


def _light(robot: RobotDescription, standing: GroundMotion) -> NDArray[np.bool_]:
    """Legs (T, L) that are dragged: the first phase of that name drags one diagonal, the second the other."""
    phases = [k for k, name in enumerate(standing.names) if name == "drag"]
    dragged = np.where(standing.phase == phases[0], 1.0, np.where(standing.phase == phases[-1], -1.0, 0.0))
    light: NDArray[np.bool_] = dragged[:, None] == ends(robot) * sides(robot)
    return light


def _sliding_speed(robot: RobotDescription, standing: GroundMotion, forces: Forces) -> Array:
    """Speed of each foot along x (T, L) [m/s], beside that of the feet that are not dragged, which stand.

    The base turns meanwhile: at a foot at (x, y, z) of it that adds w_y z - w_z y.
    """
    rate = standing.motion.angular_velocity
    own = np.gradient(forces.foot[:, :, 0], STEP * THIN, axis=0)
    own = own + rate[:, 1:2] * forces.foot[:, :, 1] - rate[:, 2:3] * robot.leg_mounts[:, 1]
    stands = ~_light(robot, standing)
    speed: Array = own - np.sum(own * stands, axis=1, keepdims=True) / np.sum(stands, axis=1, keepdims=True)
    return speed


def _compliance(
    robot: RobotDescription, standing: GroundMotion, forces: Forces
) -> tuple[ParameterEstimate, ParameterEstimate, Series]:
    """F = k d + b dd/dt for differences of front and back feet: the base's own height is not known, and not needed.

    How much deeper front feet are than back feet follows from the base's pitch, which the gyro tells, and the legs'
    lengths.
    """
    roll, pitch = standing.motion.roll_pitch.T
    across, lift = robot.leg_mounts[:, 1], forces.foot[:, :, 1]
    height = -np.sin(pitch)[:, None] * forces.foot[:, :, 0] + np.cos(pitch)[:, None] * (
        np.sin(roll)[:, None] * across + np.cos(roll)[:, None] * lift
    )
    front = ends(robot) > 0
    deeper = height[:, ~front].mean(axis=1) - height[:, front].mean(axis=1)
    more = forces.force[:, front, 1].mean(axis=1) - forces.force[:, ~front, 1].mean(axis=1)
    step = STEP * THIN
    columns = np.stack([_quick(deeper, step), _quick(np.gradient(deeper, step), step)], axis=1)
    used = standing.during("nod") & (forces.force[:, :, 1].min(axis=1) > LEAST)
    if used.sum() < FEWEST:
        raise SurefootError(
            f"all feet touch the ground in only {used.sum()} of the values while the robot nods; at least {FEWEST} are "
            "needed: run it again"
        )
    values, covariance = regress(columns[used], _quick(more, step)[used], standing.blocks[used])
    spread = np.sqrt(np.diag(covariance))
    stiffness, damping = (float(np.hypot(s, SURE * v)) for s, v in zip(spread, values, strict=True))
    time = standing.time[used] - standing.time[used][0]
    sheet, fitted = columns[used] @ [robot.contact.stiffness, robot.contact.damping], columns[used] @ values
    labels = "difference of front and back feet, nodding", "time [s]", "force [N]"
    series = Series(*labels, time, _quick(more, step)[used], sheet, fitted)
    told = bool(stiffness < 0.3 * values[0])
    return (
        ParameterEstimate.within_bounds(robot, "contact_stiffness", float(values[0]), stiffness, identifiable=told),
        ParameterEstimate("contact_damping", float(values[1]), damping, "N s/m", None, bool(damping < 0.5 * values[1])),
        series,
    )


def _quick(values: Array, step: float) -> Array:
    """Values (T,) less their moving average."""
    half = round(TREND / step)
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    slow: Array = np.convolve(np.pad(values, half, mode="edge"), kernel, "valid")
    return values - slow
