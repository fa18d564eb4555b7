"""Checks of a robot's description before anything is trained on it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge, warn_if
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

MAX_STANDING_TORQUE = 0.6
"""Share of a motor's torque that standing may take: a trot stands on half of the legs."""
VISUAL_TOLERANCE = 0.02
"""Share of the straight leg by which what is drawn of a leg may end beyond or short of its foot's sphere."""
FOOT_TOLERANCE = 0.05
"""Share by which radii of feet may differ."""
MAX_TILT = 0.2
"""Roll or pitch [rad] of a robot that stands."""
MAX_SAG = 0.2
"""Share of its resting height by which a standing robot may sag."""
STAND_TIME = 2.0
"""How long it must stand [s]."""
_MIN_SATURATED_FRACTION = 0.5
"""Share of the time at its limit from which a motor is why a robot does not stand."""
_TORQUE_REMEDY = "stand with straighter legs (leg_space.rest), or take stronger motors or a lighter robot"
_MAX_DAMPER_STEP = 1.5
"""Steps, in times m / B, up to which a damper B that is computed at the step's start is stable; 2 is the limit."""


def run_description_checks(robot: RobotDescription) -> Iterator[CheckResult]:
    """Yield the results for masses, limits, mirrored sides, feet, standing, frequencies and physics step."""
    model = build_model(robot)
    yield from check_file(robot)
    yield check_masses(robot)
    yield _check_torque_limits(robot)
    yield check_sides(robot)
    yield _check_feet(robot, model)
    yield from _check_stand(robot, model)
    frequencies, limits = _step_limits(robot, model)
    yield CheckResult("frequencies", True, frequencies, value=math.sqrt(GRAVITY / robot.leg_geometry.length) / math.tau)
    step, cause, longest = robot.timing.servo_step, min(limits, key=lambda name: limits[name]), _round_down(limits)
    message = f"{1e3 * step:g} ms; at most {1e3 * limits[cause]:.2g} ms by {cause}"
    yield judge("physics step", step <= limits[cause], message, "", f"set timing.servo_step to {longest:g}", longest)


def longest_servo_step(robot: RobotDescription) -> float:
    """Return the longest physics step [s] that is stable for a robot, rounded down."""
    return _round_down(_step_limits(robot, build_model(robot))[1])


def _round_down(limits: dict[str, float]) -> float:
    """Return the smallest limit [s], rounded down to hundredths of a millisecond."""
    return max(math.floor(1e5 * min(limits.values())), 1) / 1e5


def _check_torque_limits(robot: RobotDescription) -> CheckResult:
    if not isinstance(robot.actuator, JointActuatorData):
        return CheckResult("torque limits", True, "DC motors: by voltage and the torque-current curve")
    torque, unit = np.asarray(robot.actuator.torque_limit), robot.weight * robot.leg_geometry.length
    message = f"{_span(torque)} N m, {_span(torque / unit)} m g l"
    rule = f"; over {MIN_PLACEHOLDER_TORQUE:g} m g l is a placeholder"
    remedy = "state the actuator's real torque in actuator.torque_limit"
    real = bool((torque <= MIN_PLACEHOLDER_TORQUE * unit).all())
    return judge("torque limits", real, message, rule, remedy, float(torque.max()))


def _check_feet(robot: RobotDescription, model: mujoco.MjModel) -> CheckResult:
    """Compare the radii of the feet left to right and front to back, and their lowest points with what is drawn."""
    radii = model.geom_size[foot_geoms(robot, model), 0]
    equal = bool(np.ptp(radii) <= FOOT_TOLERANCE * radii.max())
    sizes = f"{1e3 * radii.mean():.3g} mm"
    if not equal:
        sizes = choices(f"{name} {1e3 * radius:.3g} mm" for name, radius in zip(robot.leg_names, radii, strict=True))
    rule = f"; left and right, front and back may differ by {FOOT_TOLERANCE:.0%}"
    remedy = "correct the radii of the feet's spheres in the URDF, or go on if the robot is built so"
    message = f"{len(robot.legs)} spheres of {sizes}"
    if not equal:
        return CheckResult("feet", False, message + rule, remedy, float(radii.mean()))
    beyond = visual_overhang(robot)
    worst = int(np.argmax(np.abs(beyond)))
    warning = None
    if abs(beyond[worst]) > VISUAL_TOLERANCE * robot.leg_geometry.length:
        where = "below" if beyond[worst] > 0 else "above"
        apart = f"{1e3 * abs(beyond[worst]):.2g} mm {where} its sphere"
        warning = f"{message}; what is drawn of {robot.leg_names[worst]} ends {apart}"
    remedy = "correct place and radius of the feet's spheres (links NAME_foot) in robot.urdf, if the drawing is right"
    return warn_if("feet", warning, message, remedy, float(radii.mean()))


def visual_overhang(robot: RobotDescription) -> Array:
    """Return how far legs are drawn beyond their feet's spheres (L,) [m], along the shank; 0 without a drawing."""
    beyond = np.zeros(len(robot.legs))
    if robot.looks is None or not isinstance(robot.leg_geometry, SerialLegs):
        return beyond
    try:
        parts = robot.appearance().parts
    except SurefootError:  # physics needs no drawing
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
    # What standing asks for: without a limit, where the robot stands then.
    asked = np.abs((free if stands_unlimited else own).torque[-1])
    there = np.array([available_torque(robot, k) for k in range(robot.num_motors)])
    worst = int(np.argmax(asked / there))
    asks = f"{robot.motor_names[worst]} is asked for {asked[worst]:.3g} N m, {describe_torque(robot, worst)}"
    saturated = float(own.saturation.mean(axis=0).max()) >= _MIN_SATURATED_FRACTION
    if not stands and saturated:
        rule += f"; {asks}"
        remedy = f"{_TORQUE_REMEDY}, or correct actuator.torque_limit" if stands_unlimited else remedy
    yield judge("stands", stands, message, rule, remedy, tilt)
    share = float(asked[worst] / there[worst])
    long = continuous_torque(robot, worst)
    passed = share <= MAX_STANDING_TORQUE and bool(asked[worst] <= long)
    rule = f"; at most {MAX_STANDING_TORQUE:.0%} of it, as a trot stands on half of the legs, and no more than for long"
    if stands or stands_unlimited:
        yield judge("torque to stand", passed, f"{asks}: {share:.0%}", rule, _TORQUE_REMEDY, share)


def _stand(robot: RobotDescription) -> MotorLoad:
    """Simulate a robot that stands in its resting pose."""
    return measure_load(robot, lambda time: robot.resting_angles, STAND_TIME, WorldConfig(threads=1), math.inf)


def _tilt_and_height(load: MotorLoad) -> tuple[float, float]:
    """Return tilt [rad] and height of the base [m] at the end."""
    return float(np.abs(load.end.roll_pitch_yaw[0, :2]).max()), float(load.end.base_position_world[0, 2])


def _stands(load: MotorLoad, expected: float) -> bool:
    """Return whether a robot stands at the end, its base at about `expected` [m]."""
    tilt, height = _tilt_and_height(load)
    return load.finished and tilt < MAX_TILT and height > (1 - MAX_SAG) * expected


def _step_limits(robot: RobotDescription, model: mujoco.MjModel) -> tuple[str, dict[str, float]]:
    """Return the frequencies of legs, servos and feet in words, and the longest stable step [s] by its cause."""
    message = f"leg as a pendulum {math.sqrt(GRAVITY / robot.leg_geometry.length) / math.tau:.2f} Hz"
    data = mujoco.MjData(model)
    data.qpos[:] = resting_qpos(robot, model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    limits = {}
    if isinstance(robot.actuator, JointActuatorData):
        # With the base free, each motor turns the inertia that its own torque accelerates.
        dofs = [int(model.joint(name).dofadr[0]) for name in robot.motor_names]
        turned = 1.0 / np.diag(np.linalg.inv(inertia))[dofs]
        kp, kd, friction = map(np.asarray, (robot.actuator.kp, robot.actuator.kd, robot.actuator.friction))
        servo, damping = np.sqrt(kp / turned), kd / (2 * np.sqrt(np.maximum(kp * turned, 1e-12)))
        message += f", servos {_span(servo / math.tau)} Hz at damping ratios {_span(damping)}"
        limits["the servos' damping"] = 0.5 * float(np.min(turned / np.maximum(kd, 1e-9)))
        limits["the servos' stiffness"] = 0.3 / float(servo.max())
        limits["Coulomb friction"] = 0.1 * float(np.min(turned / np.maximum(friction, 1e-9)))
    masses = [_foot_mass(model, data, inertia, int(geom)) for geom in foot_geoms(robot, model)]
    contact = math.sqrt(robot.contact.stiffness / min(masses))
    limits["the feet's stiffness"] = 0.5 / contact
    limits["the feet's damping"] = _MAX_DAMPER_STEP * min(masses) / robot.contact.damping
    return f"{message}, feet on the ground {contact / math.tau:.0f} Hz", limits


def _foot_mass(model: mujoco.MjModel, data: mujoco.MjData, inertia: Array, geom: int) -> float:
    """Return the mass [kg] that a vertical force on a foot accelerates."""
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[geom], int(model.geom_bodyid[geom]))
    return 1.0 / float(jacobian[2] @ np.linalg.solve(inertia, jacobian[2]))


def _span(values: Array) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.3g}" if math.isclose(low, high, rel_tol=5e-3) else f"{low:.3g} to {high:.3g}"
