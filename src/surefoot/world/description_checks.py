"""Checks of a robot's description before training: masses, limits, symmetry, feet, standing and physics step."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, pass_if, warn_if
from surefoot.errors import SurefootError, choices
from surefoot.robot import GRAVITY, RobotDescription, SerialLegs
from surefoot.robot.actuator import MIN_PLACEHOLDER_TORQUE, JointActuatorData
from surefoot.world.body_checks import check_file, check_masses, check_sides
from surefoot.world.interface import WorldConfig
from surefoot.world.motor_load import (
    MotorLoad,
    available_torque,
    continuous_torque,
    describe_torque,
    measure_load,
    without_torque_limits,
)
from surefoot.world.mujoco_model import build_model, foot_geoms, resting_qpos
from surefoot.world.physics_step import round_down, span, step_limits

MAX_STANDING_TORQUE = 0.6
"""Maximum torque for standing, as a fraction of the motor's torque: a trot stands on half of the legs."""
VISUAL_TOLERANCE = 0.02
"""Maximum distance between the end of a leg's visual mesh and its foot's sphere, as a fraction of the straight leg."""
FOOT_TOLERANCE = 0.05
"""Maximum relative difference between the radii of feet."""
MAX_TILT = 0.2
"""Maximum roll or pitch [rad] of a standing robot."""
MAX_SAG = 0.2
"""Maximum sag of a standing robot, as a fraction of its resting height."""
STAND_TIME = 2.0
"""Time for which a robot must stand [s]."""
_MIN_SATURATED_FRACTION = 0.5
"""Fraction of time at its torque limit above which a motor is the reason why a robot does not stand."""
_TORQUE_REMEDY = "stand with straighter legs (leg_space.rest), or use stronger motors or a lighter robot"


def run_description_checks(robot: RobotDescription) -> Iterator[CheckResult]:
    """Yield the results of all checks: masses, limits, symmetry, feet, standing, frequencies and physics step."""
    model = build_model(robot)
    yield from check_file(robot)
    yield check_masses(robot)
    yield _check_torque_limits(robot)
    yield check_sides(robot)
    yield _check_feet(robot, model)
    yield from _check_stand(robot, model)
    frequencies, limits = step_limits(robot, model)
    yield CheckResult("frequencies", True, frequencies, value=math.sqrt(GRAVITY / robot.leg_geometry.length) / math.tau)
    step, cause, longest = robot.timing.servo_step, min(limits, key=lambda name: limits[name]), round_down(limits)
    message = f"{1e3 * step:g} ms; at most {1e3 * limits[cause]:.2g} ms by {cause}"
    yield pass_if("physics step", step <= limits[cause], message, "", f"set timing.servo_step to {longest:g}", longest)


def _check_torque_limits(robot: RobotDescription) -> CheckResult:
    if not isinstance(robot.actuator, JointActuatorData):
        return CheckResult("torque limits", True, "DC motors: limited by voltage and the torque-current curve")
    torque, unit = np.asarray(robot.actuator.torque_limit), robot.weight * robot.leg_geometry.length
    message = f"{span(torque)} N m, {span(torque / unit)} m g l"
    rule = f"; values over {MIN_PLACEHOLDER_TORQUE:g} m g l are placeholders"
    remedy = "set actuator.torque_limit to the actuator's real torque"
    real = bool((torque <= MIN_PLACEHOLDER_TORQUE * unit).all())
    return pass_if("torque limits", real, message, rule, remedy, float(torque.max()))


def _check_feet(robot: RobotDescription, model: mujoco.MjModel) -> CheckResult:
    """Compare the radii of the feet with each other, and their lowest points with the visual meshes."""
    radii = model.geom_size[foot_geoms(robot, model), 0]
    equal = bool(np.ptp(radii) <= FOOT_TOLERANCE * radii.max())
    sizes = f"{1e3 * radii.mean():.3g} mm"
    if not equal:
        sizes = choices(f"{name} {1e3 * radius:.3g} mm" for name, radius in zip(robot.leg_names, radii, strict=True))
    rule = f"; they may differ by at most {FOOT_TOLERANCE:.0%}"
    remedy = "correct the radii of the feet's spheres in the URDF, or continue if the robot is built so"
    message = f"{len(robot.legs)} spheres of {sizes}"
    if not equal:
        return CheckResult("feet", False, message + rule, remedy, float(radii.mean()))
    overhang = visual_overhang(robot)
    worst = int(np.argmax(np.abs(overhang)))
    warning = None
    if abs(overhang[worst]) > VISUAL_TOLERANCE * robot.leg_geometry.length:
        where = "below" if overhang[worst] > 0 else "above"
        distance = f"{1e3 * abs(overhang[worst]):.2g} mm {where} its sphere"
        warning = f"{message}; the visual mesh of {robot.leg_names[worst]} ends {distance}"
    remedy = "if the mesh is right, correct position and radius of the feet's spheres (links NAME_foot) in robot.urdf"
    return warn_if("feet", warning, message, remedy, float(radii.mean()))


def visual_overhang(robot: RobotDescription) -> Array:
    """Return how far the visual mesh of each leg extends beyond its foot's sphere along the shank (L,) [m].

    It is negative if the mesh ends before the sphere, and 0 without visual meshes.
    """
    beyond = np.zeros(len(robot.legs))
    if robot.visuals is None or not isinstance(robot.leg_geometry, SerialLegs):
        return beyond
    try:
        parts = robot.appearance().parts
    except SurefootError:  # visual meshes are optional
        return beyond
    joints = robot.urdf.joints
    frames = robot.urdf.frames()
    for k, leg in enumerate(robot.legs):
        shank = joints[leg.motors[-1]].child
        knee, foot = frames[shank], frames[leg.foot][:3, 3]
        length = float(np.linalg.norm(foot - knee[:3, 3]))
        points = [
            part.vertices @ frames[part.link][:3, :3].T + frames[part.link][:3, 3]
            for part in parts
            if part.link in (shank, leg.foot)
        ]
        if points and length > 0:
            along = (np.concatenate(points) - knee[:3, 3]) @ (foot - knee[:3, 3]) / length
            radius = robot.urdf.links[leg.foot].collisions[0].size[0]
            beyond[k] = float(along.max()) - length - radius
    return beyond


def _check_stand(robot: RobotDescription, model: mujoco.MjModel) -> Iterator[CheckResult]:
    remedy = "choose another leg_space.rest, stiffer gains or the right masses"
    expected = float(resting_qpos(robot, model)[2])
    try:
        own, free = (_stand(one) for one in (robot, without_torque_limits(robot)))
    except SurefootError as error:
        yield CheckResult("stands", False, str(error), remedy)
        return
    tilt, height = _tilt_and_height(own)
    stands, stands_unlimited = (_stands(load, expected) for load in (own, free))
    message = f"after {STAND_TIME:g} s: tilt {tilt:.2f} rad, base at {height:.3f} m of {expected:.3f} m"
    rule = f"; tilt must stay under {MAX_TILT:g} rad, the base above {1 - MAX_SAG:.0%}"
    # The torque for standing is measured without torque limits, if the robot then stands.
    needed = np.abs((free if stands_unlimited else own).torque[-1])
    available = np.array([available_torque(robot, k) for k in range(robot.num_motors)])
    worst = int(np.argmax(needed / available))
    need = f"{robot.motor_names[worst]} needs {needed[worst]:.3g} N m, {describe_torque(robot, worst)}"
    saturated = float(own.saturation.mean(axis=0).max()) >= _MIN_SATURATED_FRACTION
    if not stands and saturated:
        rule += f"; {need}"
        remedy = f"{_TORQUE_REMEDY}, or correct actuator.torque_limit" if stands_unlimited else remedy
    yield pass_if("stands", stands, message, rule, remedy, tilt)
    fraction = float(needed[worst] / available[worst])
    continuous = continuous_torque(robot, worst)
    passed = fraction <= MAX_STANDING_TORQUE and bool(needed[worst] <= continuous)
    rule = (
        f"; at most {MAX_STANDING_TORQUE:.0%} of it, as a trot stands on half of the legs, and no more than the "
        "continuous torque"
    )
    if stands or stands_unlimited:
        yield pass_if("torque to stand", passed, f"{need}: {fraction:.0%}", rule, _TORQUE_REMEDY, fraction)


def _stand(robot: RobotDescription) -> MotorLoad:
    """Simulate a robot that holds its resting pose."""
    return measure_load(robot, lambda time: robot.resting_angles, STAND_TIME, WorldConfig(threads=1), math.inf)


def _tilt_and_height(load: MotorLoad) -> tuple[float, float]:
    """Return the tilt [rad] and height [m] of the base at the end."""
    return float(np.abs(load.end.roll_pitch_yaw[0, :2]).max()), float(load.end.base_position_world[0, 2])


def _stands(load: MotorLoad, expected: float) -> bool:
    """Return whether a robot stands at the end, with its base at about the height `expected` [m]."""
    tilt, height = _tilt_and_height(load)
    return load.finished and tilt < MAX_TILT and height > (1 - MAX_SAG) * expected
