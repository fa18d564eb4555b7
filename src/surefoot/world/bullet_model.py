"""A robot's description in Bullet: a client of its own with the fused URDF, closed loops and a ground plane."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.native_output import quiet
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.rotations import matrix_quat
from surefoot.world.bullet_import import import_pybullet
from surefoot.world.bullet_tick import pin_kernel
from surefoot.world.drive import RACK_HEIGHT
from surefoot.world.fused_urdf import FusedUrdf, frame_of, fuse_urdf, write_fused
from surefoot.world.interface import WorldConfig

Array = NDArray[np.float64]

SOLVER_ITERATIONS = 50
"""At most; the solver stops earlier when nothing changes any more.

With 50, loops stay closed within .02 mm on a slow trot (.09 mm with constraint motors) and .4 mm at a gallop of 2 m/s,
and a trot is within .6 mm of one with 1000 for a second. With 10, a step costs 17 % less, but constraint motors open
the loops by 1.2 mm, and the robot ends elsewhere.
"""
FLOOR_CELL = 0.1
"""Distance [m] of the points at which an uneven floor has its heights, linear between."""
FLOOR_CELLS = (280, 120)
"""Points of an uneven floor along x and y: 28 m by 12 m. Bullet takes about 1 kB for each."""
FLOOR_BEHIND = 4.0
"""Length [m] of an uneven floor behind the place where robots start; the floor ends on all sides."""
LOOP_ERP = 0.2
"""Share of a loop's gap that is closed in a step."""
_SPEED_CUT = 1e6
"""Bullet cuts all generalized speeds at this [m/s, rad/s]; its own 100 would stop motors, and hide a divergence."""


@dataclass(frozen=True)
class BulletSettings:
    """Settings of Bullet that decide how bodies and contacts are solved."""

    solver_iterations: int = SOLVER_ITERATIONS
    """Iterations of the constraint solver, at most."""
    cone_friction: bool = True
    """A cone of friction; without it Bullet takes a pyramid and solves no spinning friction."""
    gravity: float = GRAVITY
    """[m/s2]"""
    feet: Literal["sphere", "shank"] = "sphere"
    """What feet stand on: the sphere of the URDF, or the lower link as a box that ends at the foot."""
    ground: Literal["plane", "box"] = "plane"
    """The floor: a plane, or the top of a box 200 m wide; Bullet finds other contacts between boxes."""


PUBLISHED = BulletSettings(cone_friction=False, gravity=10.0, feet="shank", ground="box")
"""The simulator that was published with the Minitaur's description (pybullet_envs, minitaur_gym_env): no cone friction,
300 solver iterations over 6 steps, gravity 10 m/s2, lower links as boxes on a box (on a plane, `trot` falls in 5 of 10
episodes; there it never does)."""


@dataclass(frozen=True)
class Pins:
    """The constraints that close L loops, each with its place in its second link's inertial frame."""

    constraints: list[int]
    """Numbers of the constraints."""
    links: list[int]
    """Their second links."""
    places: Array
    """Places of the pins [m], (L, 3)."""
    axes: Array
    """Unit vectors (L, 3) along the pins: forces along them do not move a pin in its bore."""


@dataclass(frozen=True)
class BulletModel:
    """Indices of links and joints in a client, the same for all clients. Bullet's link frames are inertial frames.

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
    pins: Pins

    @property
    def num_joints(self) -> int:
        """Number of joints, motors and knees."""
        return len(self.joints)

    @property
    def knees(self) -> list[int]:
        """Indices of the joints without a motor."""
        return [joint for joint in self.joints.values() if joint not in self.motors]


def open_client(robot: RobotDescription, config: WorldConfig, settings: BulletSettings) -> tuple[int, BulletModel]:
    """Return a new client with the robot over a ground plane at z = 0, motors off.

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
            return client, _load(p, client, robot, config, settings)
        except Exception:
            p.disconnect(client)
            raise


def _load(
    p: ModuleType, client: int, robot: RobotDescription, config: WorldConfig, settings: BulletSettings
) -> BulletModel:
    fused = fuse_urdf(robot.urdf, visuals=False)
    base, base_frame = fused.place[robot.base]
    if base != robot.urdf.root:
        raise SurefootError(f"{robot.urdf.path}: base '{robot.base}' moves against root '{robot.urdf.root}'")
    p.setTimeStep(robot.timing.servo_step, physicsClientId=client)
    p.setGravity(0, 0, -settings.gravity, physicsClientId=client)
    p.setPhysicsEngineParameter(
        numSolverIterations=settings.solver_iterations,
        enableConeFriction=int(settings.cone_friction),
        numSubSteps=0,
        erp=LOOP_ERP,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    if settings.ground == "box":
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[100.0, 100.0, 5.0], physicsClientId=client)
    else:
        shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
    place = [0.0, 0.0, -5.0 if settings.ground == "box" else 0.0]
    ground = p.createMultiBody(0, shape, basePosition=place, physicsClientId=client)
    p.changeDynamics(ground, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
    text = fused.text if settings.feet == "sphere" else _with_shanks(fused, robot)
    with tempfile.TemporaryDirectory() as folder:
        try:
            body = p.loadURDF(
                str(write_fused(text, Path(folder))),
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
    shapes = [_foot_sphere(fused, robot, leg.foot) for leg in robot.legs]
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
        base_quat=matrix_quat(at_base[:3, :3] @ axes),
        mass={name: (item.mass, item.principal()[0]) for name, item in fused.bodies.items()},
        pins=_close_loops(p, client, robot, fused, body, links),
    )
    _set_up_dynamics(p, client, model)
    check_masses(p, client, model, model.mass)
    return model


def _foot_sphere(fused: FusedUrdf, robot: RobotDescription, link: str) -> tuple[Array, float]:
    """Return the centre [m] of a foot's sphere in its link's inertial frame, and its radius [m]."""
    name, _ = fused.place[link]
    found = ElementTree.fromstring(fused.text).findall(f"link[@name='{name}']/collision")
    spheres = [(item.find("geometry/sphere"), frame_of(item.find("origin"))) for item in found]
    spheres = [(sphere, frame) for sphere, frame in spheres if sphere is not None]
    if len(spheres) != 1:
        raise SurefootError(f"{robot.urdf.path}: a foot has {len(spheres)} spheres to stand on; Bullet needs one")
    sphere, frame = spheres[0]
    assert sphere is not None
    body = fused.bodies[name]
    centre: Array = body.principal()[1].T @ (frame[:3, 3] - body.centre)
    return centre, float(sphere.get("radius", ""))


def _with_shanks(fused: FusedUrdf, robot: RobotDescription) -> str:
    """Return the fused URDF with feet that are boxes: each lower link as wide as its visual, as long as to its foot."""
    tree = ElementTree.fromstring(fused.text)
    seen = ElementTree.parse(robot.urdf.path).getroot()
    length = robot.leg_geometry.foot
    for leg in robot.legs:
        box = seen.find(f"link[@name='{leg.foot}']/visual/geometry/box")
        link = tree.find(f"link[@name='{fused.place[leg.foot][0]}']")
        if box is None or link is None:
            raise SurefootError(
                f"{robot.urdf.path}: link '{leg.foot}' has no visual box; its collision box takes that width"
            )
        for old in link.findall("collision"):
            link.remove(old)
        shape = ElementTree.SubElement(link, "collision")
        ElementTree.SubElement(shape, "origin", xyz=f"0 0 {length / 2}", rpy="0 0 0")
        width, depth, _ = box.get("size", "").split()
        ElementTree.SubElement(ElementTree.SubElement(shape, "geometry"), "box", size=f"{width} {depth} {length}")
    return ElementTree.tostring(tree, encoding="unicode")


def _set_up_dynamics(p: ModuleType, client: int, model: BulletModel) -> None:
    """Remove damping and default motors, and set the contact of the feet; all else is stiff against the ground."""
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
    contact = model.robot.contact
    set_foot_contact(p, client, model, contact.friction, contact.stiffness, contact.spinning_friction)


def set_foot_contact(
    p: ModuleType, client: int, model: BulletModel, friction: float, stiffness: float, spinning: float
) -> None:
    """Give the feet a friction coefficient, a stiffness [N/m] and a spinning friction [m]; damping is the sheet's."""
    for link in model.feet:
        p.changeDynamics(
            model.body,
            link,
            lateralFriction=friction,
            # Bullet takes it as a length: it bounds the torque about the normal by this times the normal force.
            spinningFriction=spinning,
            contactStiffness=stiffness,
            # Bullet takes a stiffness only together with a damping.
            contactDamping=model.robot.contact.damping,
            physicsClientId=client,
        )


def set_knee_friction(p: ModuleType, client: int, model: BulletModel, friction: float) -> None:
    """Give all knees Coulomb friction [N m]: a joint motor with target speed 0 and at most this torque."""
    count = len(model.knees)
    p.setJointMotorControlArray(
        model.body, model.knees, p.VELOCITY_CONTROL, forces=[friction] * count, physicsClientId=client
    )


def move_pins(p: ModuleType, client: int, model: BulletModel, play: float, shift: Array) -> None:
    """Move pins with play in their bores, as the forces through them have it after a step; see `pin_kernel`.

    Args:
        p: PyBullet.
        client: number of the client.
        model: its robot.
        play: radial clearance [m].
        shift: displacement of each pin in its bore, in its link's inertial frame (L, 3) [m]; updated.
    """
    pins = model.pins
    states = p.getLinkStates(model.body, pins.links, physicsClientId=client)
    # Bullet states the force on the first link, where the bore is; the pin feels the opposite.
    forces = np.array([p.getConstraintState(number, physicsClientId=client) for number in pins.constraints])
    pin_kernel(np.array([state[1] for state in states]), -forces, pins.axes, play, shift)
    place_pins(p, client, pins, shift)


def place_pins(p: ModuleType, client: int, pins: Pins, shift: Array) -> None:
    """Displace pins in their bores, in their links' inertial frames (L, 3) [m]."""
    for number, place in zip(pins.constraints, (pins.places - shift).tolist(), strict=True):
        p.changeConstraint(number, jointChildPivot=place, physicsClientId=client)


def lay_floor(p: ModuleType, client: int, model: BulletModel, floor: int, unevenness: float) -> int:
    """Give the feet a floor whose heights have a standard deviation [m]; return the number of its body.

    The same unevenness gives the same floor. Its heights are independent at points `FLOOR_CELL` apart; it is level
    where robots start. All of the robot but its feet meets the plane at z = 0: a floor under every link costs time.

    Args:
        p: PyBullet.
        client: number of the client.
        model: its robot.
        floor: the body that the feet stand on so far; removed, unless it is the plane.
        unevenness: 0 for the plane.
    """
    if floor != model.ground:
        p.removeBody(floor, physicsClientId=client)
    for link in model.feet:
        p.setCollisionFilterPair(model.body, model.ground, link, -1, int(unevenness == 0.0), physicsClientId=client)
    if unevenness == 0.0:
        return model.ground
    seed, columns = int(np.float64(unevenness).view(np.uint64)), FLOOR_CELLS[1]
    draws = np.clip(np.random.default_rng(seed).standard_normal(FLOOR_CELLS), -3.0, 3.0)
    start = round(FLOOR_BEHIND / FLOOR_CELL)
    draws[start - 5 : start + 5, columns // 2 - 5 : columns // 2 + 5] = 0.0
    heights = unevenness * draws
    shape = p.createCollisionShape(
        p.GEOM_HEIGHTFIELD,
        meshScale=[FLOOR_CELL, FLOOR_CELL, 1.0],
        heightfieldData=heights.ravel(order="F").tolist(),  # the numbers along x follow each other
        numHeightfieldRows=FLOOR_CELLS[0],
        numHeightfieldColumns=columns,
        physicsClientId=client,
    )
    # Bullet puts the middle between the first and the last point, and between the lowest and the highest, at the
    # body's origin.
    ahead = 0.5 * FLOOR_CELL * FLOOR_CELLS[0] - FLOOR_BEHIND
    place = [ahead, 0.0, float(heights.min() + heights.max()) / 2]
    number: int = p.createMultiBody(0, shape, basePosition=place, physicsClientId=client)
    p.changeDynamics(number, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
    for link in set(model.links.values()) - set(model.feet):
        p.setCollisionFilterPair(model.body, number, link, -1, 0, physicsClientId=client)
    return number


def _close_loops(
    p: ModuleType, client: int, robot: RobotDescription, fused: FusedUrdf, body: int, links: dict[str, int]
) -> Pins:
    constraints, seconds, places, axes = [], [], [], []
    for loop in robot.loops:
        ends, points = [], []
        for link, point in zip(loop.links, loop.points, strict=True):
            name, frame = fused.place[link]
            in_link = (frame @ [*point, 1.0])[:3]
            _, turn = fused.bodies[name].principal()
            ends.append(links[name])
            points.append(turn.T @ (in_link - fused.bodies[name].centre))
        along = next(joint.axis for joint in robot.urdf.joints.values() if joint.child == name)
        at = [point.tolist() for point in points]
        constraints.append(
            p.createConstraint(
                body, ends[0], body, ends[1], p.JOINT_POINT2POINT, [0, 0, 0], *at, physicsClientId=client
            )
        )
        seconds.append(ends[1])
        places.append(points[1])
        axes.append(turn.T @ along)
    return Pins(constraints, seconds, np.array(places).reshape(-1, 3), np.array(axes).reshape(-1, 3))


def check_masses(p: ModuleType, client: int, model: BulletModel, mass: dict[str, tuple[float, Array]]) -> None:
    """Refuse if Bullet has other masses or principal moments than these; a base on a rack has none."""
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
