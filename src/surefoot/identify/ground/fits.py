"""Fits of the experiments on the ground.

Mass experiment: the sum of the vertical foot forces is the weight, and the moment of the foot forces against the
measured pitch acceleration gives the inertia of the base. Contact experiment: dragged feet give the friction; nodding,
in which the body rocks on compliant feet, gives their stiffness and damping.
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
from surefoot.identify.ground.plans import fore_aft_signs, lateral_signs
from surefoot.identify.model import GAIN_DEVIATION
from surefoot.identify.recording import Recording
from surefoot.identify.result import Check, FitProgress, Identification, ParameterEstimate, Series, add_model_error
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

STILL_PHASES = ("stand still", "squat slowly")
"""Phases without fast motion, in which the mean force on the feet is the weight."""
NODDING_PHASES = ("nod",)
"""Phases in which the base rotates fast about y."""
ROUNDS = 4
MAX_INERTIA_DEVIATION = 0.15
"""Relative standard deviation above which the inertia of the base is not identifiable."""
SLIDING_SPEED = 0.15
"""Speed of a foot relative to the ground [m/s] above which it certainly slides."""
MIN_CONTACT_FORCE = 2.0
"""Normal force [N] above which a foot counts as touching the ground."""
MIN_SAMPLES = 40
"""Minimum number of samples with a sliding foot, and with all feet on the ground."""
RELATIVE_ACCURACY = 0.04
"""Minimum relative standard deviation of friction: errors of leg masses, torque reports and the rounded feet affect all
forces."""
STIFFNESS_ACCURACY = 0.2
"""Minimum relative standard deviation of stiffness and damping: an uneven floor and feet that also give way along the
ground change the depth of the feet. It was set on the robots of results/identified."""
DETREND_TIME = 0.5
"""Length [s] of the moving average that is subtracted from heights and forces, because gyro errors accumulate."""


def fit_mass(
    robot: RobotDescription, recording: Recording, prior: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """Return the result of the mass experiment; see `Experiment.fit`."""
    standing = ground_motion(robot, recording, prior, sensors)
    still, nodding = standing.during(*STILL_PHASES), standing.during(*NODDING_PHASES)
    notes = []
    accuracy = float(sensors.get("torque_accuracy", GAIN_DEVIATION / np.sqrt(robot.num_motors)))
    if "torque_gain" not in sensors:
        notes.append("the motors were not identified before, so their torque reports are used without correction")
    params = prior.rows(np.zeros(1, np.int64))
    for k in range(ROUNDS):
        dynamics = InverseDynamics(robot, params)
        forces = dynamics.forces(standing.motion)
        check_feet(standing, forces, dynamics)
        weight = _weight(standing, forces, still)
        base = dynamics.base_mass
        total, legs = float(weight.mean()) / GRAVITY, dynamics.mass - base
        excess, variance = _inertia_excess(standing, forces, nodding)
        _scale(robot, params, "base_mass_ratio", (total - legs) / base)
        _scale(robot, params, "base_inertia_ratio", 1 + excess)
        report(f"round {k + 1}: {total:.3f} kg", float("nan"))
    forces = InverseDynamics(robot, params).forces(standing.motion)
    mass_spread = float(np.hypot(block_deviation(weight, standing.blocks[still]) / GRAVITY, accuracy * total))
    inertia = float(params.base_inertia_ratio[0])
    # The moment is proportional to the reported torques, and the inertia of the legs acts together with the base's.
    inertia_spread = inertia * float(np.hypot(np.sqrt(variance), 2 * accuracy))
    identifiable = inertia_spread < MAX_INERTIA_DEVIATION * inertia
    inertia_spread = add_model_error("base_inertia_ratio", inertia, inertia_spread)
    ratio = float(params.base_mass_ratio[0])
    ratio_spread = add_model_error("base_mass_ratio", ratio, mass_spread / base * ratio)
    if identifiable:
        notes.append("base_inertia_ratio is identified from rotation about y only, and used for all axes")
    else:
        notes.append("the base rotated too little about y: its inertia is not identifiable")
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


def _weight(standing: GroundMotion, forces: Forces, during: NDArray[np.bool_]) -> Array:
    """Return the weight [N] (T,) that the feet carry: their force along the vertical of the base, over its cosine."""
    carried: Array = forces.force[during, :, 1].sum(axis=1) / np.cos(standing.motion.roll_pitch[during]).prod(axis=1)
    return carried


def _inertia_excess(standing: GroundMotion, forces: Forces, during: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the relative excess of the base's inertia about y over the current parameters, and its variance.

    The moment of the foot forces exceeds the moment that the modelled motion requires by the moment of the excess
    inertia, and by a constant in each phase if the centre of mass differs from the description.
    """
    phases = standing.phase[during]
    constants = [(phases == k).astype(float) for k in np.unique(phases)]
    columns = np.stack([forces.base_moment[during], *constants], axis=1)
    solution, covariance = regress(columns, -forces.required[during, 2], standing.blocks[during])
    return float(solution[0]), float(covariance[0, 0])


def _centre_of_mass(
    robot: RobotDescription, standing: GroundMotion, forces: Forces, still: NDArray[np.bool_], accuracy: float
) -> list[ParameterEstimate]:
    """Return the robot's centre of mass along x and y, relative to the origin of the base, from the foot forces."""
    carried = forces.force[still, :, 1]
    total = carried.sum(axis=1)
    forward = (forces.foot[still, :, 0] * carried - forces.foot[still, :, 1] * forces.force[still, :, 0]).sum(axis=1)
    # When the robot leans, the feet also carry sideways forces, which act about one leg length below the base.
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
    """Return the errors of weight and moment about y in held-out phases, before and after the fit."""
    held_out = standing.during("nod back", uses=("check",))
    if not held_out.any():
        return (), ()
    weight_error, moment_error = np.empty(2), np.empty(2)
    simulated = np.empty((2, int(held_out.sum())))
    for k, params in enumerate((before, after)):
        dynamics = InverseDynamics(robot, params)
        forces = dynamics.forces(standing.motion)
        weight_error[k] = abs(float(_weight(standing, forces, held_out).mean()) - GRAVITY * dynamics.mass)
        moment_error[k], simulated[k] = np.std(forces.required[held_out, 2]), forces.base_moment[held_out]
    # The measured moment that remains for the rotation of the base itself.
    measured = (forces.base_moment - forces.required[:, 2])[held_out]
    measured = measured - np.mean(measured - simulated[1])
    time = standing.time[held_out] - standing.time[held_out][0]
    labels = "rotation of the base about y, not fitted", "time [s]", "moment [N m]"
    checks = (
        Check("weight on the feet", float(weight_error[0]), float(weight_error[1]), "N"),
        Check("moment about y", float(moment_error[0]), float(moment_error[1]), "N m"),
    )
    return checks, (Series(*labels, time, measured, simulated[0], simulated[1]),)


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
    notes = ["feet are assumed to be as stiff along the ground as normal to it; this is not measured"]
    if not friction.identifiable:
        notes.insert(0, "the dragged feet did not slide: friction is not identifiable")
    estimates = (friction, stiffness, damping)
    return Identification("contact", robot.name, estimates, notes=tuple(notes), series=(*points, deflection))


def _friction(
    robot: RobotDescription, standing: GroundMotion, forces: Forces, prior: PhysicalParams
) -> tuple[ParameterEstimate, tuple[Series, ...]]:
    """Fit Coulomb's law F_x = -mu F_z sign(v) + c to feet that slide along x; c absorbs errors of torque reports."""
    speed, dragged = _sliding_speed(robot, standing, forces), _dragged_legs(robot, standing)
    during_drag = standing.during("drag")
    coefficients, variances, along, down = [], [], [], []
    for leg in range(forces.force.shape[1]):
        slides = during_drag & dragged[:, leg] & (np.abs(speed[:, leg]) > SLIDING_SPEED)
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
    within_leg = float(np.sqrt(np.mean(variances)))
    deviation = float(np.hypot(np.hypot(spread, within_leg) / np.sqrt(count), RELATIVE_ACCURACY * value))
    x = np.array(down)
    order = np.argsort(x)[:: max(len(x) // 400, 1)]
    labels = "dragged feet", "normal force, signed against the motion [N]", "force along the ground [N]"
    curves = x[order], np.array(along)[order], np.full(len(order), np.nan), value * x[order]
    return ParameterEstimate.within_bounds(robot, "contact_friction", value, deviation), (
        Series(*labels, *curves, points=True),
    )


def _dragged_legs(robot: RobotDescription, standing: GroundMotion) -> NDArray[np.bool_]:
    """Return a mask (T, L) of the dragged legs: one diagonal in the first phase "drag", the other in the second."""
    phases = [k for k, name in enumerate(standing.names) if name == "drag"]
    if not phases:
        raise SurefootError("the recording has no phase 'drag'; it is not of the experiment contact")
    diagonal = np.where(standing.phase == phases[0], 1.0, np.where(standing.phase == phases[-1], -1.0, 0.0))
    return np.asarray(diagonal[:, None] == fore_aft_signs(robot) * lateral_signs(robot))


def _sliding_speed(robot: RobotDescription, standing: GroundMotion, forces: Forces) -> Array:
    """Return the speed of each foot along x (T, L) [m/s], relative to the feet that are not dragged and stand still.

    The rotation of the base adds w_y z - w_z y at a foot at (x, y, z).
    """
    rate = standing.motion.angular_velocity
    foot = np.gradient(forces.foot[:, :, 0], STEP * SUBSAMPLE_STRIDE, axis=0)
    foot = foot + rate[:, 1:2] * forces.foot[:, :, 1] - rate[:, 2:3] * robot.leg_mounts[:, 1]
    stands = ~_dragged_legs(robot, standing)
    speed: Array = foot - np.sum(foot * stands, axis=1, keepdims=True) / np.sum(stands, axis=1, keepdims=True)
    return speed


def _compliance(
    robot: RobotDescription, standing: GroundMotion, forces: Forces
) -> tuple[ParameterEstimate, ParameterEstimate, Series]:
    """Fit stiffness k and damping b of the feet: F = k d + b dd/dt, with force F and depth d.

    F and d are differences between front and back feet, which do not depend on the height of the base. The difference
    in depth follows from the pitch of the base, by the gyro, and the leg lengths.
    """
    roll, pitch = standing.motion.roll_pitch.T
    across, lift = robot.leg_mounts[:, 1], forces.foot[:, :, 1]
    height = -np.sin(pitch)[:, None] * forces.foot[:, :, 0] + np.cos(pitch)[:, None] * (
        np.sin(roll)[:, None] * across + np.cos(roll)[:, None] * lift
    )
    front = fore_aft_signs(robot) > 0
    depth = height[:, ~front].mean(axis=1) - height[:, front].mean(axis=1)
    force = forces.force[:, front, 1].mean(axis=1) - forces.force[:, ~front, 1].mean(axis=1)
    step = STEP * SUBSAMPLE_STRIDE
    columns = np.stack([_detrend(depth, step), _detrend(np.gradient(depth, step), step)], axis=1)
    used = standing.during("nod") & (forces.force[:, :, 1].min(axis=1) > MIN_CONTACT_FORCE)
    if used.sum() < MIN_SAMPLES:
        raise SurefootError(
            f"all feet touch the ground in only {used.sum()} samples while the robot nods; at least {MIN_SAMPLES} are "
            "needed: run it again"
        )
    columns, measured = columns[used], _detrend(force, step)[used]
    values, covariance = regress(columns, measured, standing.blocks[used])
    spread = np.hypot(np.sqrt(np.diag(covariance)), STIFFNESS_ACCURACY * values)
    (k, b), (k_spread, b_spread) = values.tolist(), spread.tolist()
    time = standing.time[used] - standing.time[used][0]
    nominal, fitted = columns @ [robot.contact.stiffness, robot.contact.damping], columns @ values
    labels = "difference of front and back feet, nodding", "time [s]", "force [N]"
    return (
        ParameterEstimate.within_bounds(robot, "contact_stiffness", k, k_spread, identifiable=k_spread < 0.3 * k),
        ParameterEstimate("contact_damping", b, b_spread, "N s/m", None, b_spread < 0.5 * b),
        Series(*labels, time, measured, nominal, fitted),
    )


def _detrend(values: Array, step: float) -> Array:
    """Return values (T,) minus their moving average."""
    half = round(DETREND_TIME / step)
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    slow: Array = np.convolve(np.pad(values, half, mode="edge"), kernel, "valid")
    return values - slow
