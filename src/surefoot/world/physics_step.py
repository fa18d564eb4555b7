"""Physics step of a robot: the longest stable one, and a longer one for training than that of its data sheet."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np

from surefoot.arrays import Array
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.actuator import JointActuatorData
from surefoot.world.mujoco_model import build_model, foot_geoms, resting_qpos

_MAX_DAMPER_STEP = 1.5
"""Maximum step, in units of m / B, for a damper B that is computed at the start of the step; it is unstable above 2."""


def longest_servo_step(robot: RobotDescription) -> float:
    """Return the longest stable physics step of a robot [s], rounded down."""
    return round_down(step_limits(robot, build_model(robot))[1])


def with_physics_step(robot: RobotDescription, longest: float) -> RobotDescription:
    """Return a robot whose servo and physics step is as long as is stable.

    Args:
        robot: the robot.
        longest: maximum step [s]. A robot whose data sheet has a longer one keeps it.
    """
    own = robot.timing.servo_step
    step = min(longest, longest_servo_step(robot)) if longest > own else own
    return robot if step <= own else replace(robot, timing=replace(robot.timing, servo_step=step))


def round_down(limits: dict[str, float]) -> float:
    """Return the smallest limit [s], rounded down to 0.01 ms."""
    return max(math.floor(1e5 * min(limits.values())), 1) / 1e5


def step_limits(robot: RobotDescription, model: mujoco.MjModel) -> tuple[str, dict[str, float]]:
    """Return a message with the frequencies of legs, servos and feet, and the longest stable step [s] by cause."""
    message = f"leg as a pendulum {math.sqrt(GRAVITY / robot.leg_geometry.length) / math.tau:.2f} Hz"
    data = mujoco.MjData(model)
    data.qpos[:] = resting_qpos(robot, model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    limits = {}
    if isinstance(robot.actuator, JointActuatorData):
        # Effective inertia of each motor's joint, with a free base.
        dofs = [int(model.joint(name).dofadr[0]) for name in robot.motor_names]
        turned = 1.0 / np.diag(np.linalg.inv(inertia))[dofs]
        kp, kd, friction = map(np.asarray, (robot.actuator.kp, robot.actuator.kd, robot.actuator.friction))
        servo, damping = np.sqrt(kp / turned), kd / (2 * np.sqrt(np.maximum(kp * turned, 1e-12)))
        message += f", servos {span(servo / math.tau)} Hz at damping ratios {span(damping)}"
        limits["the servos' damping"] = 0.5 * float(np.min(turned / np.maximum(kd, 1e-9)))
        limits["the servos' stiffness"] = 0.3 / float(servo.max())
        limits["Coulomb friction"] = 0.1 * float(np.min(turned / np.maximum(friction, 1e-9)))
    masses = [_foot_mass(model, data, inertia, int(geom)) for geom in foot_geoms(robot, model)]
    contact = math.sqrt(robot.contact.stiffness / min(masses))
    limits["the feet's stiffness"] = 0.5 / contact
    limits["the feet's damping"] = _MAX_DAMPER_STEP * min(masses) / robot.contact.damping
    return f"{message}, feet on the ground {contact / math.tau:.0f} Hz", limits


def _foot_mass(model: mujoco.MjModel, data: mujoco.MjData, inertia: Array, geom: int) -> float:
    """Return the effective mass [kg] of a foot for vertical forces."""
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[geom], int(model.geom_bodyid[geom]))
    return 1.0 / float(jacobian[2] @ np.linalg.solve(inertia, jacobian[2]))


def span(values: Array) -> str:
    """Return the range of values as text."""
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.3g}" if math.isclose(low, high, rel_tol=5e-3) else f"{low:.3g} to {high:.3g}"
