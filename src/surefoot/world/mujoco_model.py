"""MuJoCo model of a robot: the URDF, closed loops and the ground."""

from __future__ import annotations

import functools
import math
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.native_output import mujoco_errors
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.self_collision import collision_pairs
from surefoot.world.actuation import RACK_HEIGHT
from surefoot.world.ground import FLAT, Ground
from surefoot.world.interface import WorldConfig
from surefoot.world.urdf_probe import check_urdf

LOOP_SOLREF = (0.004, 1.0)
LOOP_SOLIMP = (0.99, 0.99, 0.001, 0.5, 2.0)
MOTOR_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Impedance of constraint motors: the hardest constraint in MuJoCo."""
WALL_WIDTH = 0.05
"""Maximum width of walls in height fields [m], see `body_heights`."""
MOTOR_ITERATIONS = 50
"""Solver iterations with constraint motors: their torque limits need more iterations than only closed loops."""


def build_model(robot: RobotDescription, config: WorldConfig | None = None) -> mujoco.MjModel:
    """Return the compiled MuJoCo model of a robot, see `build_spec`."""
    spec = build_spec(robot, config)
    with mujoco_errors(robot.urdf.path):
        return spec.compile()


def build_spec(robot: RobotDescription, config: WorldConfig | None = None) -> mujoco.MjSpec:
    """Return the MuJoCo specification of a robot with a free or fixed (rack) base and the ground.

    Feet use the contact model of `surefoot.world.contact`, so their geoms have no collisions. The other collision
    shapes of the URDF collide with the ground by MuJoCo's contacts, and with each other in the pairs of
    `collision_pairs`.
    """
    check_urdf(robot.urdf.path)
    with mujoco_errors(robot.urdf.path):
        spec = mujoco.MjSpec.from_file(str(robot.urdf.path))
    spec.compiler.discardvisual = True
    config = config or WorldConfig()
    base = spec.body(robot.base)
    # Otherwise, a fixed base would be fused with the ground.
    spec.compiler.fusestatic = not config.rack
    if config.rack:
        base.pos = (0.0, 0.0, RACK_HEIGHT)
    else:
        base.add_freejoint()
    option = spec.option
    option.gravity = (0.0, 0.0, -GRAVITY)
    option.timestep = robot.timing.servo_step
    option.iterations = 4
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_ISLAND
    _add_ground(spec, config.ground)
    feet = {leg.foot: leg.name for leg in robot.legs}
    for body in spec.bodies[1:]:
        for number, geom in enumerate(body.geoms):
            geom.contype, geom.conaffinity, geom.condim = 0, 1, 3
            if body.name in feet:
                geom.name = f"{feet[body.name]}_foot"
                # Bit 2 collides with nothing; without any bit, MuJoCo would drop the geom as a visual.
                geom.conaffinity = 2
            else:
                geom.name = f"{body.name}_shape_{number}"
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            # Friction is the data sheet's, in every engine, whatever the URDF's <dynamics> says.
            joint.damping, joint.frictionloss = np.zeros_like(joint.damping), 0.0
    rotors = np.broadcast_to(robot.nominal_params()["rotor_inertia"], robot.num_motors)
    for name, inertia in zip(robot.motor_names, rotors, strict=True):
        spec.joint(name).armature = inertia
    if config.actuator == "constraint":
        # Bounded joint friction, to which `MujocoEngine` gives a target speed.
        option.iterations = MOTOR_ITERATIONS
        for name in robot.motor_names:
            joint = spec.joint(name)
            # Any value above 0 creates the constraint; the engine sets the limit.
            joint.frictionloss = 1.0
            joint.solimp_friction = MOTOR_SOLIMP
    for loop in robot.loops:
        pins = [f"{link}_pin" for link in loop.links]
        for link, pin, point in zip(loop.links, pins, loop.points, strict=True):
            spec.body(link).add_site(name=pin, pos=point)
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            name1=pins[0],
            name2=pins[1],
            solref=LOOP_SOLREF,
            solimp=LOOP_SOLIMP,
        )
    for pair in collision_pairs(robot):
        for one, other in product(*(spec.body(link).geoms for link in pair)):
            spec.add_pair(geomname1=one.name, geomname2=other.name)
    return spec


@functools.lru_cache(maxsize=1)
def body_heights(ground: Ground) -> tuple[Array, float]:
    """Return the height field (X, Y) [m] with which bodies other than feet collide, and the spacing of its points [m].

    MuJoCo's height fields have no vertical walls. A wall becomes a slope between two points, at most `WALL_WIDTH` wide,
    which starts at the wall, so that no leg touches it before the wall. Feet use the exact walls.
    """
    if ground.is_flat:
        return np.zeros((0, 0)), ground.cell
    parts = max(round(ground.cell / WALL_WIDTH), 1) if has_steps(ground) else 1
    cell, inset = ground.cell / parts, 1e-6
    x, y = (
        np.arange(n * parts + 1) * cell + low for n, low in zip(ground.corners.shape[:2], ground.grid, strict=False)
    )
    around = [
        ground.height(np.stack(np.meshgrid(x + a * inset, y + b * inset, indexing="ij"), axis=-1))
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    lowest: Array = np.min(around, axis=0)
    return lowest, cell


def _add_ground(spec: mujoco.MjSpec, ground: Ground) -> None:
    """Add the ground with which bodies other than feet collide: a plane, or the height field of `body_heights`."""
    kind, place, size = mujoco.mjtGeom.mjGEOM_PLANE, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    if not ground.is_flat:
        heights, cell = body_heights(ground)
        rows, columns = heights.shape
        low, high = float(heights.min()), float(heights.max())
        # MuJoCo's diagonals go from low x, y to high x, y. A quarter turn makes them equal to the diagonals of
        # `Ground`.
        spec.add_hfield(
            name="ground",
            nrow=rows,
            ncol=columns,
            size=[0.5 * cell * (columns - 1), 0.5 * cell * (rows - 1), max(high - low, 1e-3), 1.0],
            userdata=((heights[::-1] - low) / max(high - low, 1e-3)).ravel(),
        )
        kind, place, size = mujoco.mjtGeom.mjGEOM_HFIELD, [*ground.center, low], [0.0, 0.0, 0.0]
    geom = spec.worldbody.add_geom(name="ground", type=kind, size=size, pos=place, contype=1, conaffinity=0, condim=3)
    if not ground.is_flat:
        geom.hfieldname, geom.quat = "ground", [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]


def has_steps(ground: Ground) -> bool:
    """Return whether a ground has walls between cells."""
    corners = ground.corners
    return bool(
        (corners[1:, :, 0] != corners[:-1, :, 1]).any() or (corners[:, 1:, :, 0] != corners[:, :-1, :, 1]).any()
    )


def foot_geoms(robot: RobotDescription, model: mujoco.MjModel) -> NDArray[np.int64]:
    """Return the geom ids of the feet, in the order of the legs."""
    return np.array([model.geom(f"{leg.name}_foot").id for leg in robot.legs])


def resting_qpos(robot: RobotDescription, model: mujoco.MjModel, ground: Ground = FLAT) -> Array:
    """Return the generalized coordinates of the resting pose, with closed loops and the lowest foot on the ground.

    On a rack, the base stays at its place.
    """
    qpos = model.qpos0.copy()
    for name, angle in robot.joint_angles(robot.resting_angles).items():
        qpos[model.joint(name).qposadr[0]] = angle
    if not model.body(robot.base).jntnum[0]:
        return qpos
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    feet = foot_geoms(robot, model)
    places = data.geom_xpos[feet]
    qpos[2] -= float(np.min(places[:, 2] - model.geom_size[feet, 0] - ground.height(places[:, :2])))
    return qpos
