"""A robot's description as a MuJoCo model: the URDF, closed loops, compliant feet and a ground plane."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription

CONTACT_IMPEDANCE = 0.5
"""MuJoCo's d for a foot's contact, see `contact_solref`."""
FRICTION_RATIO = 10.0
"""How much stiffer the ground resists sliding than sinking; at 1 a standing foot would creep at f / damping."""
LOOP_SOLREF = (0.004, 1.0)
LOOP_SOLIMP = (0.99, 0.99, 0.001, 0.5, 2.0)


def contact_solref(stiffness: float, damping: float, inverse_weight: float) -> tuple[float, float]:
    """MuJoCo's `solref` that makes a contact a spring and damper in SI units.

    MuJoCo's contact force f solves f R = a_ref - a, with a_ref = -b v - k r and R = (1 - d)/d A, where A is the inverse of
    the mass seen at the contact. So f = (k/R)(-r) + (b/R)(-v) - a/R: a spring K = k/R, a damper B = b/R, and an
    added mass 1/R, which at d = 1/2 is the mass that the contact sees. (MuJoCo documentation, "Constraint model".)

    Args:
        stiffness: K [N/m].
        damping: B [N s/m].
        inverse_weight: A [1/kg], MuJoCo's `body_invweight0` of the touching body.
    """
    regularization = (1 - CONTACT_IMPEDANCE) / CONTACT_IMPEDANCE * inverse_weight
    # MuJoCo divides a direct stiffness by d^2 and a direct damping by d.
    return (
        -stiffness * regularization * CONTACT_IMPEDANCE**2,
        -damping * regularization * CONTACT_IMPEDANCE,
    )


def build_spec(robot: RobotDescription) -> mujoco.MjSpec:
    """The robot with a free base over a ground plane at z = 0, ready to compile; gravity 9.81 m/s2."""
    try:
        spec = mujoco.MjSpec.from_file(str(robot.urdf.path))
    except ValueError as error:
        raise SurefootError(f"{robot.urdf.path}: MuJoCo refuses it: {error}") from error
    spec.compiler.discardvisual = True
    spec.compiler.fusestatic = True
    spec.body(robot.base).add_freejoint()
    option = spec.option
    option.timestep = robot.timing.servo_step
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = FRICTION_RATIO
    option.iterations = 4
    option.tolerance = 1e-6
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_ISLAND
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=0, condim=3
    )
    feet = {leg.foot: leg.name for leg in robot.legs}
    for body in spec.bodies[1:]:
        for geom in body.geoms:
            # Parts of the robot touch the ground and not each other.
            geom.contype, geom.conaffinity, geom.condim = 0, 1, 3
            if body.name in feet:
                geom.name = f"{feet[body.name]}_foot"
                geom.priority = 1
                geom.friction = [robot.contact.friction, 0.0, 0.0]
                geom.solimp = [CONTACT_IMPEDANCE, CONTACT_IMPEDANCE, 0.001, 0.5, 2.0]
    for loop in robot.loops:
        equality = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE, solref=LOOP_SOLREF, solimp=LOOP_SOLIMP
        )
        names = []
        for link, point in zip(loop.links, loop.points, strict=True):
            names.append(f"{link}_pin")
            spec.body(link).add_site(name=names[-1], pos=point)
        equality.name1, equality.name2 = names
    return spec


def build_model(robot: RobotDescription) -> mujoco.MjModel:
    """The compiled model, with the feet's compliance set for the nominal masses."""
    model = build_spec(robot).compile()
    set_contact_compliance(robot, model)
    return model


def foot_geoms(robot: RobotDescription, model: mujoco.MjModel) -> NDArray[np.int64]:
    """Geom ids of the feet, in the order of the legs."""
    return np.array([model.geom(f"{leg.name}_foot").id for leg in robot.legs])


def set_contact_compliance(robot: RobotDescription, model: mujoco.MjModel) -> None:
    """Set the feet's `solref` for the masses that the model has now."""
    for geom in foot_geoms(robot, model):
        weight = model.body_invweight0[model.geom_bodyid[geom], 0]
        model.geom_solref[geom] = contact_solref(robot.contact.stiffness, robot.contact.damping, weight)


def resting_qpos(robot: RobotDescription, model: mujoco.MjModel) -> NDArray[np.float64]:
    """Generalized coordinates of the robot in its resting pose, loops closed, lowest foot on the ground."""
    qpos = model.qpos0.copy()
    angles = robot.resting_angles
    data = mujoco.MjData(model)
    for motor, name in enumerate(robot.motor_names):
        qpos[model.joint(name).qposadr[0]] = robot.motor_sign[motor] * angles[motor]
    for leg in robot.legs:
        theta = [angles[robot.motor_names.index(name)] for name in leg.motors]
        for name, knee in zip(leg.knees, robot.leg_geometry.knee_angles(*theta), strict=True):
            qpos[model.joint(name).qposadr[0]] = knee
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    feet = foot_geoms(robot, model)
    qpos[2] -= float(np.min(data.geom_xpos[feet, 2] - model.geom_size[feet, 0]))
    return qpos
