"""A robot's description in Bullet: a client of its own with the fused URDF, closed loops and a ground plane."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.native_output import quiet
from surefoot.robot import RobotDescription
from surefoot.world.bullet_import import import_pybullet
from surefoot.world.drive import RACK_HEIGHT
from surefoot.world.fused_urdf import FusedUrdf, fuse_urdf, write_fused
from surefoot.world.interface import WorldConfig

Array = NDArray[np.float64]

SOLVER_ITERATIONS = 50
"""At most; the solver stops earlier when nothing changes any more.

With 50, loops stay closed within .02 mm on a slow trot (.09 mm with constraint motors) and .4 mm at a gallop of 2 m/s,
and a trot is within .6 mm of one with 1000 for a second. With 10, a step costs 17 % less, but constraint motors open
the loops by 1.2 mm, and the robot ends elsewhere.
"""
LOOP_ERP = 0.2
"""Share of a loop's gap that is closed in a step."""
_SPEED_CUT = 1e6
"""Bullet cuts all generalized speeds at this [m/s, rad/s]; its own 100 would stop motors, and hide a divergence."""


@dataclass(frozen=True)
class BulletModel:
    """Where everything is in a client's robot, the same for all clients. Bullet's frame of a link is the inertial one.

    L links besides the base, each with one joint; M motors, F feet.
    """

    robot: RobotDescription
    rack: bool
    fused: FusedUrdf
    ground: int
    body: int
    links: dict[str, int]
    """Link index by name of the fused link; -1 is the base."""
    joints: dict[str, int]
    motors: list[int]
    """Joint indices in the robot's motor order."""
    feet: list[int]
    """Link indices in the order of the legs."""
    foot_centre: Array
    """Centre of each foot in its link's inertial frame [m], (F, 3)."""
    foot_radius: Array
    base_centre: Array
    """Centre of mass of the base in the base link's frame [m], (3,)."""
    base_quat: Array
    """Orientation of the base's inertial frame in the base link's frame, (4,), w x y z."""
    mass: dict[str, tuple[float, Array]]
    """Nominal mass [kg] and principal moments [kg m2] of each fused link."""

    @property
    def num_joints(self) -> int:
        """Number of joints, motors and knees."""
        return len(self.joints)


def open_client(robot: RobotDescription, config: WorldConfig) -> tuple[int, BulletModel]:
    """A new client with the robot over a ground plane at z = 0, gravity 9.81 m/s2, motors off.

    Raises:
        SurefootError: Bullet has no room for another client, or reads other masses than the file has.
    """
    p = import_pybullet()
    with quiet():
        try:
            client = p.connect(p.DIRECT)
        except p.error:
            client = -1
        if client < 0:
            raise SurefootError("Bullet has no room for another robot in this process; simulate fewer at once")
        try:
            return client, _load(p, client, robot, config)
        except Exception:
            p.disconnect(client)
            raise


def _load(p: ModuleType, client: int, robot: RobotDescription, config: WorldConfig) -> BulletModel:
    fused = fuse_urdf(robot.urdf, visuals=False)
    base, base_frame = fused.place[robot.base]
    if base != robot.urdf.root:
        raise SurefootError(f"{robot.urdf.path}: base '{robot.base}' moves against root '{robot.urdf.root}'")
    p.setTimeStep(robot.timing.servo_step, physicsClientId=client)
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    p.setPhysicsEngineParameter(
        numSolverIterations=SOLVER_ITERATIONS,
        numSubSteps=0,
        erp=LOOP_ERP,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    ground = p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client), physicsClientId=client)
    p.changeDynamics(ground, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
    with tempfile.TemporaryDirectory() as folder:
        try:
            body = p.loadURDF(
                str(write_fused(fused.text, Path(folder))),
                [0, 0, RACK_HEIGHT],
                useFixedBase=config.rack,
                flags=p.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=client,
            )
        except p.error as error:
            raise SurefootError(f"{robot.urdf.path}: Bullet refuses it: {error}") from error
    infos = [
        p.getJointInfo(body, j, physicsClientId=client) for j in range(p.getNumJoints(body, physicsClientId=client))
    ]
    joints = {info[1].decode(): info[0] for info in infos}
    links = {base: -1} | {info[12].decode(): info[0] for info in infos}
    feet = [links[fused.place[leg.foot][0]] for leg in robot.legs]
    shapes = [_foot_shape(p, client, robot, body, link) for link in feet]
    _, axes = fused.bodies[base].principal()
    at_base = np.linalg.inv(base_frame)
    model = BulletModel(
        robot=robot,
        rack=config.rack,
        fused=fused,
        ground=ground,
        body=body,
        links=links,
        joints=joints,
        motors=[joints[name] for name in robot.motor_names],
        feet=feet,
        foot_centre=np.array([centre for centre, _ in shapes]),
        foot_radius=np.array([radius for _, radius in shapes]),
        base_centre=(at_base @ [*fused.bodies[base].centre, 1.0])[:3],
        base_quat=quaternion(at_base[:3, :3] @ axes),
        mass={name: (item.mass, item.principal()[0]) for name, item in fused.bodies.items()},
    )
    _set_up_dynamics(p, client, model)
    _close_loops(p, client, model)
    check_masses(p, client, model, model.mass)
    return model


def _foot_shape(p: ModuleType, client: int, robot: RobotDescription, body: int, link: int) -> tuple[Array, float]:
    """Centre [m] in the link's inertial frame and radius [m] of a foot's sphere."""
    spheres = [
        shape for shape in p.getCollisionShapeData(body, link, physicsClientId=client) if shape[2] == p.GEOM_SPHERE
    ]
    if len(spheres) != 1:
        raise SurefootError(f"{robot.urdf.path}: a foot has {len(spheres)} spheres to stand on; Bullet needs one")
    return np.array(spheres[0][5]), spheres[0][3][0]


def _set_up_dynamics(p: ModuleType, client: int, model: BulletModel) -> None:
    """No damping, no default motors, the feet's contact; only feet meet the ground softly.

    Spinning friction c bounds the torque about the normal by c f_n: a length [m], and with the sheet's .3 m so much
    that a foot does not turn on the spot at all. A robot that rolls to one side turns its feet about the vertical when
    its legs swing, and has to drag them. The MuJoCo world knows no such friction.
    """
    for link in model.links.values():
        p.changeDynamics(
            model.body,
            link,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            restitution=0.0,
            lateralFriction=1.0,
            spinningFriction=0.0,
            rollingFriction=0.0,
            maxJointVelocity=_SPEED_CUT,
            physicsClientId=client,
        )
    count = model.num_joints
    p.setJointMotorControlArray(
        model.body, list(range(count)), p.VELOCITY_CONTROL, forces=[0.0] * count, physicsClientId=client
    )
    set_foot_contact(p, client, model, model.robot.contact.friction, model.robot.contact.stiffness)


def set_foot_contact(p: ModuleType, client: int, model: BulletModel, friction: float, stiffness: float) -> None:
    """Give the feet a friction coefficient and a stiffness [N/m]; spinning friction and damping are the sheet's."""
    for link in model.feet:
        p.changeDynamics(
            model.body,
            link,
            lateralFriction=friction,
            spinningFriction=model.robot.contact.spinning_friction,
            contactStiffness=stiffness,
            # Bullet takes a stiffness only together with a damping.
            contactDamping=model.robot.contact.damping,
            physicsClientId=client,
        )


def _close_loops(p: ModuleType, client: int, model: BulletModel) -> None:
    for loop in model.robot.loops:
        ends, places = [], []
        for link, point in zip(loop.links, loop.points, strict=True):
            name, frame = model.fused.place[link]
            in_link = (frame @ [*point, 1.0])[:3]
            _, axes = model.fused.bodies[name].principal()
            ends.append(model.links[name])
            places.append((axes.T @ (in_link - model.fused.bodies[name].centre)).tolist())
        p.createConstraint(
            model.body, ends[0], model.body, ends[1], p.JOINT_POINT2POINT, [0, 0, 0], *places, physicsClientId=client
        )


def check_masses(p: ModuleType, client: int, model: BulletModel, mass: dict[str, tuple[float, Array]]) -> None:
    """Refuse to go on if Bullet has other masses or principal moments than these; a base on a rack has none."""
    for name, (value, moments) in mass.items():
        link = model.links[name]
        if link < 0 and model.rack:
            continue
        info = p.getDynamicsInfo(model.body, link, physicsClientId=client)
        if not (np.isclose(info[0], value, rtol=1e-9) and np.allclose(info[2], moments, rtol=1e-6, atol=0.0)):
            raise SurefootError(
                f"{model.robot.urdf.path}: link '{name}': Bullet has mass {info[0]:g} kg and moments {info[2]}; "
                f"they must be {value:g} kg and {tuple(moments.tolist())}"
            )


def scale_masses(
    p: ModuleType,
    client: int,
    model: BulletModel,
    base_mass: float,
    leg_mass: float,
    base_inertia: float,
    leg_inertia: float,
) -> None:
    """Multiply the nominal masses and moments of the base and of all other links, and check that Bullet has them."""
    scaled = {}
    for name, (mass, moments) in model.mass.items():
        link = model.links[name]
        if link < 0 and model.rack:
            continue
        mass = mass * (base_mass if link < 0 else leg_mass)
        moments = moments * (base_inertia if link < 0 else leg_inertia)
        # Given a mass alone, Bullet would take the inertia of the collision shape.
        p.changeDynamics(model.body, link, mass=mass, localInertiaDiagonal=moments.tolist(), physicsClientId=client)
        scaled[name] = (mass, moments)
    check_masses(p, client, model, scaled)


def quaternion(turn: Array) -> Array:
    """Unit quaternion (4,), w x y z, of a rotation (3, 3)."""
    w = np.sqrt(max(0.0, 1 + turn[0, 0] + turn[1, 1] + turn[2, 2])) / 2
    x = np.sqrt(max(0.0, 1 + turn[0, 0] - turn[1, 1] - turn[2, 2])) / 2
    y = np.sqrt(max(0.0, 1 - turn[0, 0] + turn[1, 1] - turn[2, 2])) / 2
    z = np.sqrt(max(0.0, 1 - turn[0, 0] - turn[1, 1] + turn[2, 2])) / 2
    signed = np.array(
        [
            w,
            np.copysign(x, turn[2, 1] - turn[1, 2]),
            np.copysign(y, turn[0, 2] - turn[2, 0]),
            np.copysign(z, turn[1, 0] - turn[0, 1]),
        ]
    )
    unit: Array = signed / np.linalg.norm(signed)
    return unit
