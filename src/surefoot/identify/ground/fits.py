"""Fits of the experiments on the ground.

Mass: the feet carry the weight, and their forces turn the base, whose inertia resists. Contact: friction from dragged
feet, stiffness and damping from a body that nods on them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.ground.inverse_dynamics import Forces, InverseDynamics
from surefoot.identify.ground.motion import (
    STEP,
    SUBSAMPLE_STRIDE,
    GroundMotion,
    block_deviation,
    check_feet,
    ground_motion,
    regress,
)
from surefoot.identify.ground.plans import ends, sides
from surefoot.identify.model import GAIN_DEVIATION
from surefoot.identify.recording import Recording
from surefoot.identify.result import Check, FitProgress, Identification, ParameterEstimate, Series, add_model_error
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

STILL = ("stand still", "squat slowly")
"""Phases without fast motion: the mean force on the feet is the weight."""
NODDING_PHASES = ("nod",)
"""Phases in which the base turns fast about y."""
ROUNDS = 4
MAX_INERTIA_DEVIATION = 0.15
"""Relative standard deviation of the base's inertia beyond which it is not identifiable."""
SLIDING_SPEED = 0.15
"""Speed of a foot over the ground [m/s] from which it certainly slides."""
MIN_CONTACT_FORCE = 2.0
"""Force [N] from which a foot counts as touching the ground."""
MIN_SAMPLES = 40
"""Values with a sliding foot, and with all feet on the ground, that are needed."""
RELATIVE_ACCURACY = 0.04
"""Least deviation of friction, stiffness and damping, as a share of the value: the legs' masses, torques and the feet's
roundness affect all forces."""
DETREND_TIME = 0.5
"""Time [s] of the moving average that is subtracted from heights and forces: the gyro's errors accumulate."""


def fit_mass(
    robot: RobotDescription, recording: Recording, prior: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """Return the result of the mass experiment; see `Experiment.fit`."""
    standing = ground_motion(robot, recording, prior, sensors)
    still, turning = standing.during(*STILL), standing.during(*NODDING_PHASES)
    notes = []
    accuracy = float(sensors.get("torque_accuracy", GAIN_DEVIATION / np.sqrt(robot.num_motors)))
    if "torque_gain" not in sensors:
        notes.append("the motors were not identified before: their torque reports are taken as they are")
    params = prior.rows(np.zeros(1, np.int64))
    for k in range(ROUNDS):
        dynamics = InverseDynamics(robot, params)
        forces = dynamics.forces(standing.motion)
        check_feet(standing, forces, dynamics)
        weight = forces.force[still, :, 1].sum(axis=1)
        base = dynamics.base_mass
        total, legs = float(weight.mean()) / GRAVITY, dynamics.mass - base
        excess, variance = _inertia_excess(standing, forces, turning)
        _scale(robot, params, "base_mass_ratio", (total - legs) / base)
        _scale(robot, params, "base_inertia_ratio", 1 + excess)
        report(f"round {k + 1}: {total:.3f} kg", float("nan"))
    forces = InverseDynamics(robot, params).forces(standing.motion)
    mass_spread = float(np.hypot(block_deviation(weight, standing.blocks[still]) / GRAVITY, accuracy * total))
    inertia = float(params.base_inertia_ratio[0])
    # Moments are in proportion to forces, and the legs' inertia acts with the base's.
    inertia_spread = inertia * float(np.hypot(np.sqrt(variance), 2 * accuracy))
    identifiable = inertia_spread < MAX_INERTIA_DEVIATION * inertia
    inertia_spread = add_model_error("base_inertia_ratio", inertia, inertia_spread)
    ratio = float(params.base_mass_ratio[0])
    ratio_spread = add_model_error("base_mass_ratio", ratio, mass_spread / base * ratio)
    if identifiable:
        notes.append("base_inertia_ratio is identified from turns about y alone, and taken for all axes")
    else:
        notes.append("the base turned too little about y: its inertia is not identifiable")
    result = Identification(
        "mass",
        robot.name,
        (
            ParameterEstimate.within_bounds(robot, "base_mass_ratio", ratio, ratio_spread),
            ParameterEstimate.within_bounds(
                robot, "base_inertia_ratio", inertia, inertia_spread, identifiable=identifiable
            ),
            ParameterEstimate("total_mass", total, add_model_error("total_mass", total, mass_spread), "kg", low=0.0),
            *_centre_of_mass(robot, standing, forces, still, accuracy),
        ),
        notes=tuple(notes),
    )
    checks, series = _check(robot, standing, prior, result.params(robot, prior))
    return replace(result, checks=checks, series=series)


def _scale(robot: RobotDescription, params: PhysicalParams, name: str, factor: float) -> None:
    """Multiply a ratio by a factor, within the robot's bounds."""
    ratio = getattr(params, name)
    ratio[0] *= float(np.clip(float(ratio[0]) * factor, *robot.allowed[name])) / float(ratio[0])


def _inertia_excess(standing: GroundMotion, forces: Forces, during: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the base's inertia about y over that of the parameters, less 1, and its variance.

    The moment of the forces on the feet exceeds what the motion needs by the moment of the excess inertia, and by a
    constant in each phase if the centre of mass is not as described.
    """
    phases = standing.phase[during]
    constants = [(phases == k).astype(float) for k in np.unique(phases)]
    columns = np.stack([forces.turning[during], *constants], axis=1)
    solution, covariance = regress(columns, -forces.needed[during, 2], standing.blocks[during])
    return float(solution[0]), float(covariance[0, 0])


def _centre_of_mass(
    robot: RobotDescription, standing: GroundMotion, forces: Forces, still: NDArray[np.bool_], accuracy: float
) -> list[ParameterEstimate]:
    """Return the robot's centre of mass, from its base's origin along x and y, by the forces on the feet."""
    carried = forces.force[still, :, 1]
    total = carried.sum(axis=1)
    forward = (forces.foot[still, :, 0] * carried - forces.foot[still, :, 1] * forces.force[still, :, 0]).sum(axis=1)
    # A robot that leans has sideways forces too, at its feet: below the centre of mass by about their own depth.
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
    """Return errors of the forces on the feet in held-out phases."""
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
    robot: RobotDescription, recording: Recording, prior: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """Return the result of the contact experiment; see `Experiment.fit`."""
    standing = ground_motion(robot, recording, prior, sensors)
    dynamics = InverseDynamics(robot, prior)
    forces = dynamics.forces(standing.motion)
    check_feet(standing, forces, dynamics)
    friction, points = _friction(robot, standing, forces, prior)
    stiffness, damping, deflection = _compliance(robot, standing, forces)
    notes = ["feet are taken to be as stiff along the ground as into it; that is not measured"]
    if not friction.identifiable:
        notes.insert(0, "feet that were dragged did not slide: their friction is not identifiable")
    estimates = (friction, stiffness, damping)
    return Identification("contact", robot.name, estimates, notes=tuple(notes), series=(*points, deflection))


def _friction(
    robot: RobotDescription, standing: GroundMotion, forces: Forces, prior: PhysicalParams
) -> tuple[ParameterEstimate, tuple[Series, ...]]:
    """Fit Coulomb's law to feet that slide along x: F_x = -mu F_z sign(v) + c, c from errors of the torque reports."""
    speed, light = _sliding_speed(robot, standing, forces), _dragged_legs(robot, standing)
    dragged = standing.during("drag")
    coefficients, variances, along, down = [], [], [], []
    for leg in range(forces.force.shape[1]):
        slides = dragged & light[:, leg] & (np.abs(speed[:, leg]) > SLIDING_SPEED)
        slides &= forces.force[:, leg, 1] > MIN_CONTACT_FORCE
        if slides.sum() < MIN_SAMPLES:
            continue
        columns = np.stack([forces.force[slides, leg, 1] * -np.sign(speed[slides, leg]), np.ones(slides.sum())], axis=1)
        solution, covariance = regress(columns, forces.force[slides, leg, 0], standing.blocks[slides])
        coefficients.append(float(solution[0]))
        variances.append(float(covariance[0, 0]))
        along += (forces.force[slides, leg, 0] - solution[1]).tolist()
        down += columns[:, 0].tolist()
    if not coefficients:
        before, (low, high) = float(prior.contact_friction[0]), robot.allowed["contact_friction"]
        return ParameterEstimate.within_bounds(robot, "contact_friction", before, high - low, identifiable=False), ()
    value, count = float(np.mean(coefficients)), len(coefficients)
    spread = float(np.std(coefficients, ddof=1)) if count > 1 else RELATIVE_ACCURACY * value * 2
    own = float(np.sqrt(np.mean(variances)))
    deviation = float(np.hypot(np.hypot(spread, own) / np.sqrt(count), RELATIVE_ACCURACY * value))
    x = np.array(down)
    order = np.argsort(x)[:: max(len(x) // 400, 1)]
    labels = "dragged feet", "weight on the foot, against its motion [N]", "force along the ground [N]"
    curves = x[order], np.array(along)[order], np.full(len(order), np.nan), value * x[order]
    return ParameterEstimate.within_bounds(robot, "contact_friction", value, deviation), (
        Series(*labels, *curves, points=True),
    )


def _dragged_legs(robot: RobotDescription, standing: GroundMotion) -> NDArray[np.bool_]:
    """Return the legs (T, L) that are dragged: one diagonal in the first phase of the name, the other in the second."""
    phases = [k for k, name in enumerate(standing.names) if name == "drag"]
    diagonal = np.where(standing.phase == phases[0], 1.0, np.where(standing.phase == phases[-1], -1.0, 0.0))
    return np.asarray(diagonal[:, None] == ends(robot) * sides(robot))


def _sliding_speed(robot: RobotDescription, standing: GroundMotion, forces: Forces) -> Array:
    """Return the speed of each foot along x (T, L) [m/s], relative to the feet that are not dragged, which stand.

    The base's turning adds w_y z - w_z y at a foot at (x, y, z).
    """
    rate = standing.motion.angular_velocity
    own = np.gradient(forces.foot[:, :, 0], STEP * SUBSAMPLE_STRIDE, axis=0)
    own = own + rate[:, 1:2] * forces.foot[:, :, 1] - rate[:, 2:3] * robot.leg_mounts[:, 1]
    stands = ~_dragged_legs(robot, standing)
    speed: Array = own - np.sum(own * stands, axis=1, keepdims=True) / np.sum(stands, axis=1, keepdims=True)
    return speed


def _compliance(
    robot: RobotDescription, standing: GroundMotion, forces: Forces
) -> tuple[ParameterEstimate, ParameterEstimate, Series]:
    """Fit F = k d + b dd/dt to differences of front and back feet, which do not depend on the base's height.

    The difference of depth follows from the base's pitch, by the gyro, and the legs' lengths.
    """
    roll, pitch = standing.motion.roll_pitch.T
    across, lift = robot.leg_mounts[:, 1], forces.foot[:, :, 1]
    height = -np.sin(pitch)[:, None] * forces.foot[:, :, 0] + np.cos(pitch)[:, None] * (
        np.sin(roll)[:, None] * across + np.cos(roll)[:, None] * lift
    )
    front = ends(robot) > 0
    deeper = height[:, ~front].mean(axis=1) - height[:, front].mean(axis=1)
    more = forces.force[:, front, 1].mean(axis=1) - forces.force[:, ~front, 1].mean(axis=1)
    step = STEP * SUBSAMPLE_STRIDE
    columns = np.stack([_detrend(deeper, step), _detrend(np.gradient(deeper, step), step)], axis=1)
    used = standing.during("nod") & (forces.force[:, :, 1].min(axis=1) > MIN_CONTACT_FORCE)
    if used.sum() < MIN_SAMPLES:
        raise SurefootError(
            f"all feet touch the ground in only {used.sum()} of the values while the robot nods; at least "
            f"{MIN_SAMPLES} are needed: run it again"
        )
    columns, measured = columns[used], _detrend(more, step)[used]
    values, covariance = regress(columns, measured, standing.blocks[used])
    spread = np.hypot(np.sqrt(np.diag(covariance)), RELATIVE_ACCURACY * values)
    (k, b), (k_spread, b_spread) = values.tolist(), spread.tolist()
    time = standing.time[used] - standing.time[used][0]
    sheet, fitted = columns @ [robot.contact.stiffness, robot.contact.damping], columns @ values
    labels = "difference of front and back feet, nodding", "time [s]", "force [N]"
    return (
        ParameterEstimate.within_bounds(robot, "contact_stiffness", k, k_spread, identifiable=k_spread < 0.3 * k),
        ParameterEstimate("contact_damping", b, b_spread, "N s/m", None, b_spread < 0.5 * b),
        Series(*labels, time, measured, sheet, fitted),
    )


def _detrend(values: Array, step: float) -> Array:
    """Return values (T,) less their moving average."""
    half = round(DETREND_TIME / step)
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    slow: Array = np.convolve(np.pad(values, half, mode="edge"), kernel, "valid")
    return values - slow
