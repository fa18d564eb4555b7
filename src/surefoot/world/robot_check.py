"""What can be wrong with a robot's description, found before anything is trained on it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge
from surefoot.errors import SurefootError, choices
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.actuator import PLACEHOLDER_TORQUE, JointActuatorData
from surefoot.robot.rigid_body import are_moments
from surefoot.world.mujoco_model import build_model, foot_geoms, resting_qpos
from surefoot.world.sim_world import SimWorld

STANDING_SHARE = 0.6
"""Share of a motor's torque that standing may take: a trot stands on half of the legs."""
ALIKE = 0.02
"""Share by which mirrored masses and lengths may differ."""
TILT = 0.2
"""Roll or pitch [rad] of a robot that stands."""
SINK = 0.2
"""Share of its resting height by which a standing robot may sag."""
_DAMPER = 1.5
"""Steps, in times m / B, up to which a damper B that is computed at the step's start is stable; 2 is the limit."""
STEP = "physics step"
"""Name of the check of the physics step."""
STAND_TIME = 2.0
"""How long it must stand [s]."""


def check_robot(robot: RobotDescription) -> Iterator[CheckResult]:
    """Yield what is found of a robot's masses, limits, feet, sides, stand, frequencies and physics step."""
    yield _masses(robot)
    yield _limits(robot)
    yield _sides(robot)
    model = build_model(robot)
    radius = float(model.geom_size[foot_geoms(robot, model), 0].mean())
    yield CheckResult("feet", True, f"{len(robot.legs)} spheres of {1e3 * radius:.0f} mm")
    yield from _stand(robot, model)
    yield from _dynamics(robot, model)


def _masses(robot: RobotDescription) -> CheckResult:
    links = robot.urdf.fuse_fixed_links().links
    odd = [name for name, link in links.items() if not are_moments(np.linalg.eigvalsh(link.body.inertia))]
    share = max(link.mass for link in links.values()) / robot.urdf.total_mass
    told = f"{robot.urdf.total_mass:.2f} kg, {share:.0%} in one body"
    rule = f"; no rigid body has the inertia of {choices(odd)}: none of the moments may be over the sum of the others"
    return judge("masses", not odd, told, rule, "correct these inertias in the URDF", robot.urdf.total_mass)


def _limits(robot: RobotDescription) -> CheckResult:
    if not isinstance(robot.actuator, JointActuatorData):
        return CheckResult("torque limits", True, "DC motors: by voltage and the torque-current curve")
    torque = np.broadcast_to(robot.actuator.torque_limit, robot.num_motors)
    unit = robot.weight * robot.leg_geometry.length
    told = f"{_span(torque)} N m, {_span(torque / unit)} m g l"
    rule = f"; over {PLACEHOLDER_TORQUE:g} m g l is a placeholder"
    todo = "state the actuator's real torque in actuator.torque_limit"
    real = bool((torque <= PLACEHOLDER_TORQUE * unit).all())
    return judge("torque limits", real, told, rule, todo, float(torque.max()))


def _sides(robot: RobotDescription) -> CheckResult:
    """Compare what is left with what is right of the middle plane."""
    links, joints = robot.urdf.fuse_fixed_links().links, robot.urdf.joints
    masses = {leg.name: sum(links[joints[name].child].mass for name in (*leg.motors, *leg.knees)) for leg in robot.legs}
    differing = []
    for k, leg in enumerate(robot.legs):
        mirror = robot.leg_mounts[k] * [1.0, -1.0, 1.0]
        other = int(np.argmin(np.linalg.norm(robot.leg_mounts - mirror, axis=1)))
        apart = float(np.linalg.norm(robot.leg_mounts[other] - mirror))
        heavier = abs(masses[leg.name] - masses[robot.legs[other].name]) / masses[leg.name]
        if other == k or apart > ALIKE * robot.leg_geometry.length or heavier > ALIKE:
            differing.append(leg.name)
    told = "left and right are mirror images"
    if differing:
        told = f"{choices(differing)}: no mirror image within {ALIKE:.0%} of the leg's length and mass"
    todo = "correct the places of the hips and the masses of the legs, or go on if the robot is built so"
    return judge("left and right", not differing, told, "", todo)


def _stand(robot: RobotDescription, model: mujoco.MjModel) -> Iterator[CheckResult]:
    todo = "choose another leg_space.rest, stiffer gains or the right masses"
    try:
        world = SimWorld(robot, 1)
    except SurefootError as error:
        yield CheckResult("stands", False, str(error), todo)
        return
    expected = float(resting_qpos(robot, model)[2])
    for _ in range(round(STAND_TIME / robot.timing.control_step)):
        world.step(world.resting_angles[None])
    truth = world.truth()
    tilt, height = float(np.abs(truth.roll_pitch_yaw[0, :2]).max()), float(truth.base_position_world[0, 2])
    stands = not world.divergences and tilt < TILT and height > (1 - SINK) * expected
    told = f"after {STAND_TIME:g} s: tilt {tilt:.2f} rad, base at {height:.3f} m of {expected:.3f} m"
    rule = f"; tilt must stay under {TILT:g} rad, the base above {1 - SINK:.0%}"
    yield judge("stands", stands, told, rule, todo, tilt)
    if stands and isinstance(robot.actuator, JointActuatorData):
        share = np.abs(truth.motor_torque[0]) / np.broadcast_to(robot.actuator.torque_limit, robot.num_motors)
        worst = int(np.argmax(share))
        told = f"{robot.motor_names[worst]} has {share[worst]:.0%} of its limit"
        rule = f"; at most {STANDING_SHARE:.0%}, as a trot stands on half of the legs"
        passed, todo = bool(share.max() <= STANDING_SHARE), "stand with straighter legs"
        yield judge("torque to stand", passed, told, rule, todo, float(share.max()))


def longest_servo_step(robot: RobotDescription) -> float | None:
    """Return the longest physics step [s] for a robot; None if its own is not longer."""
    *_, found = _dynamics(robot, build_model(robot))
    return float(found.value or 0.0) if found.passed is False else None


def _dynamics(robot: RobotDescription, model: mujoco.MjModel) -> Iterator[CheckResult]:
    """Compare the frequencies of legs, servos and feet with the physics step."""
    length, step = robot.leg_geometry.length, robot.timing.servo_step
    natural = math.sqrt(GRAVITY / length) / (2 * math.pi)
    told = f"leg as a pendulum {natural:.2f} Hz"
    data = mujoco.MjData(model)
    data.qpos[:] = resting_qpos(robot, model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    # With the base free, each motor feels the inertia that its own force meets.
    dofs = [int(model.joint(name).dofadr[0]) for name in robot.motor_names]
    felt = 1.0 / np.diag(np.linalg.inv(inertia))[dofs]
    limits = {}
    if isinstance(robot.actuator, JointActuatorData):
        kp, kd, friction = (
            np.broadcast_to(value, robot.num_motors)
            for value in (robot.actuator.kp, robot.actuator.kd, robot.actuator.friction)
        )
        servo, damping = np.sqrt(kp / felt), kd / (2 * np.sqrt(np.maximum(kp * felt, 1e-12)))
        told += f", servos {_span(servo / (2 * math.pi))} Hz at damping ratios {_span(damping)}"
        limits["the servos' damping"] = 0.5 * float(np.min(felt / np.maximum(kd, 1e-9)))
        limits["the servos' stiffness"] = 0.3 / float(servo.max())
        limits["Coulomb friction"] = 0.1 * float(np.min(felt / np.maximum(friction, 1e-9)))
    feet = foot_geoms(robot, model)
    mass = np.array([_foot_mass(model, data, inertia, int(geom)) for geom in feet]).min()
    contact = math.sqrt(robot.contact.stiffness / mass)
    told += f", feet on the ground {contact / (2 * math.pi):.0f} Hz"
    limits["the feet's stiffness"] = 0.5 / contact
    limits["the feet's damping"] = _DAMPER * mass / robot.contact.damping
    yield CheckResult("frequencies", True, told, value=natural)
    what = min(limits, key=lambda name: limits[name])
    told = f"{1e3 * step:g} ms; at most {1e3 * limits[what]:.2g} ms by {what}"
    # Rounded down, to hundredths of a millisecond.
    longest = max(math.floor(1e5 * limits[what]), 1) / 1e5
    yield judge(STEP, step <= limits[what], told, "", f"set timing.servo_step to {longest:g}", longest)


def _foot_mass(model: mujoco.MjModel, data: mujoco.MjData, inertia: Array, geom: int) -> float:
    """Return the mass [kg] that a vertical force on a foot meets."""
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[geom], int(model.geom_bodyid[geom]))
    return 1.0 / float(jacobian[2] @ np.linalg.solve(inertia, jacobian[2]))


def _span(values: Array) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.3g}" if math.isclose(low, high, rel_tol=5e-3) else f"{low:.3g} to {high:.3g}"
