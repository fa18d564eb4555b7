"""Bullet model of a robot: a physics client with the fused URDF, closed loops and the ground."""

from __future__ import annotations

import functools
import itertools
import sys
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.native_output import discard_output
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.rigid_body import RigidBody
from surefoot.robot.self_collision import collision_pairs
from surefoot.robot.urdf import Joint, Link, Shape, Urdf
from surefoot.robot.urdf_file import format_urdf
from surefoot.rotations import matrix_quat
from surefoot.world.actuation import CONTACT_PARAMS, MASS_RATIOS, RACK_HEIGHT
from surefoot.world.bullet_kernels import contact_planes, pin_kernel, sole_kernel, sphere_centres
from surefoot.world.ground import FLAT, Ground, uneven_floor
from surefoot.world.ground_contact import friction_factor
from surefoot.world.interface import WorldConfig

SOLVER_ITERATIONS = 50
"""Iterations of the constraint solver. With 50, loops stay closed within 0.02 mm in a slow trot (0.09 mm with
constraint motors) and 0.4 mm in a gallop at 2 m/s, and one second of a trot is within 0.6 mm of the result with 1000.
With 10, a step costs 17 % less, but constraint motors open the loops by 1.2 mm, and the robot ends at another place."""
LOOP_ERP = 0.2
"""Fraction of a loop's position error that is corrected per step."""
_NO_OFFSET = np.zeros(3)
_MAX_SPEED = 1e6
"""Limit of all generalized speeds in Bullet [m/s, rad/s]. Its default of 100 would slow motors and hide divergence."""
ROTOR_RATIO = 300.0
"""Gear ratio between a rotor and its joint. The higher it is, the less the rotor resists rotations of its own link."""
_ROTOR_PREFIX, _FOOT_PREFIX = "rotor of ", "sphere of "
_ROTOR_MASS = 1e-9
_MASSLESS_BODY = RigidBody(_ROTOR_MASS, np.zeros(3), 1e-12 * np.eye(3))
_MIN_ROTOR_INERTIA = 1e-6
_MAX_VERTICES, _MAX_INDICES = 131_072, 524_288
"""Maximum sizes of a mesh in PyBullet."""
_PLANE_TOLERANCE = 1e-12
"""Maximum change of the numbers of a contact plane (see `contact_planes`) for which it is not moved."""


@dataclass(frozen=True)
class BulletSettings:
    """Solver and contact settings of Bullet."""

    solver_iterations: int = SOLVER_ITERATIONS
    """Maximum iterations of the constraint solver, which stops earlier when it has converged."""
    cone_friction: bool = True
    """Use a friction cone instead of a pyramid. With a pyramid, Bullet does not solve spinning friction."""
    gravity: float = GRAVITY
    """Gravity [m/s2]."""
    feet: Literal["sphere", "shank"] = "sphere"
    """Collision shape of feet: the sphere of the URDF, or the lower link as a box that ends at the foot."""
    ground: Literal["plane", "box"] = "plane"
    """Flat ground: a plane, or the top of a box 200 m wide, with which boxes have other contact points."""


PUBLISHED = BulletSettings(cone_friction=False, gravity=10.0, feet="shank", ground="box")
"""Settings of the simulator that was published with the paper's robot (pybullet_envs): no friction cone, 300 solver
iterations over 6 steps, gravity 10 m/s2, and lower links as boxes on a box. On a plane instead of a box, `trot` falls
in 5 of 10 episodes; on the box it never does."""
CLIENT_PARAMETERS = (*CONTACT_PARAMS, *MASS_RATIOS, "knee_friction", "knee_play", "floor_unevenness")
"""Physical parameters that Bullet's client implements. Servos, motors and sensors implement all others."""


def import_pybullet() -> ModuleType:
    """Import PyBullet without its banner.

    Raises:
        ModuleNotFoundError: PyBullet is not installed.
    """
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    with discard_output():
        import pybullet
    module: ModuleType = pybullet
    return module


class BulletModel:
    """A robot on the ground in its own Bullet client, with motors off. The client is closed with the object.

    Bullet's link frames are inertial frames. The robot has L links in addition to the base, each with one joint, M
    motors, F feet, and P pins that close loops. Indices of links and joints are the same in all clients.

    Args:
        robot: the robot.
        config: configuration of the world.
        settings: settings of Bullet.
        pairs: links that may collide. Defaults to `collision_pairs(robot)`, which takes a tenth of a second.
        base_offset: offset of the base's centre of mass from the description's (3,) [m].

    Raises:
        SurefootError: Bullet can't hold another client, or reads other masses than the file has.
        ModuleNotFoundError: PyBullet is not installed.
    """

    client: int
    """Id of the physics client."""
    ground: int
    """Id of the ground's body, with which all links except feet may collide."""
    planes: list[int]
    """Ids of the contact planes of feet: one per foot on an uneven floor; on a ground with cells followed by one wall
    plane per foot. Empty if feet touch the ground's body."""
    body: int
    """Id of the robot's body."""
    links: dict[str, int]
    """Link indices by name of the fused link; -1 is the base."""
    joints: dict[str, int]
    """Joint indices by name."""
    motors: list[int]
    """Joint indices in the robot's motor order."""
    knees: list[int]
    """Indices of joints without a motor."""
    rotors: dict[int, int]
    """Joint index of each rotor, by the index of the joint that it drives."""
    feet: list[int]
    """Link indices of the feet, in the order of the legs."""
    foot_centre: Array
    """Centre of each foot in its link's inertial frame (F, 3) [m]."""
    foot_radius: Array
    """Radius of each foot (F,) [m]."""
    base_centre: Array
    """Centre of mass of the base in the base link's frame (3,) [m]."""
    base_quat: Array
    """Orientation of the base's inertial frame in the base link's frame (4,), w x y z."""
    mass: dict[str, tuple[float, Array]]
    """Nominal mass [kg] and principal moments [kg m2] of each moving fused link."""
    pins: list[int]
    """Ids of the constraints that close loops."""
    pin_shift: Array
    """Displacement of each pin with play in its bore, in its link's inertial frame (P, 3) [m]."""
    soles: bool
    """Whether the feet use the friction of `contact` with a shear stiffness, instead of Bullet's friction."""
    values: dict[str, float]
    """Current values of `CLIENT_PARAMETERS`."""
    rotor_inertia: Array
    """Inertia of each rotor, reflected to its joint (M,) [kg m2]."""
    base_offset: Array
    """Offset of the base's centre of mass from the description's (3,) [m]."""

    def __init__(
        self,
        robot: RobotDescription,
        config: WorldConfig,
        settings: BulletSettings,
        pairs: Sequence[tuple[str, str]] | None = None,
        base_offset: Array = _NO_OFFSET,
    ) -> None:
        self._pairs = collision_pairs(robot) if pairs is None else pairs
        self.robot, self.rack, self._p, self._ground = robot, config.rack, import_pybullet(), config.ground
        self.base_offset = base_offset.copy()
        self._fused = robot.urdf.fuse_fixed_links({robot.base: base_offset})
        with discard_output():
            try:
                self.client = self._p.connect(self._p.DIRECT)
            except self._p.error:
                self.client = -1
            if self.client < 0:
                raise SurefootError("Bullet can't hold another robot in this process; simulate fewer robots at once")
            self.close = weakref.finalize(self, self._p.disconnect, self.client)
            self._load(settings)

    def _load(self, settings: BulletSettings) -> None:
        p, client, robot, links = self._p, self.client, self.robot, self._fused.links
        places = robot.urdf.fused_frames
        base, base_frame = places[robot.base]
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
        self.ground, self.planes = self._add_ground(self._ground, settings.ground == "box"), []
        pairs = {frozenset(places[link][0] for link in pair) for pair in self._pairs}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "fused.urdf"
            urdf = self._fused if settings.feet == "sphere" else self._with_shanks(self._fused)
            urdf = urdf if self._ground.is_flat else self._with_feet(urdf)
            urdf = self._with_rotors(urdf) if robot.actuator.kind == "joint" else urdf
            path.write_text(format_urdf(urdf, robot.name, principal=True), encoding="utf-8")
            try:
                self.body = p.loadURDF(
                    str(path),
                    [0, 0, RACK_HEIGHT],
                    useFixedBase=self.rack,
                    flags=p.URDF_USE_INERTIA_FROM_FILE | (p.URDF_USE_SELF_COLLISION if pairs else 0),
                    physicsClientId=client,
                )
            except p.error as error:
                raise SurefootError(f"{robot.urdf.path}: Bullet rejects it: {error}") from error
        count = p.getNumJoints(self.body, physicsClientId=client)
        infos = [p.getJointInfo(self.body, joint, physicsClientId=client) for joint in range(count)]
        numbers = {info[1].decode(): info[0] for info in infos}
        self.joints = {
            name: number for name, number in numbers.items() if not name.startswith((_ROTOR_PREFIX, _FOOT_PREFIX))
        }
        self.links = {base: -1} | {info[12].decode(): info[0] for info in infos if info[0] in self.joints.values()}
        tops = {f"{_FOOT_PREFIX}{leg.foot}": places[leg.foot][0] for leg in robot.legs}
        self._foot_spheres = [] if self._ground.is_flat else [numbers[name] for name in tops]
        if pairs:
            bodies = self.links | dict(zip(tops, self._foot_spheres, strict=False))
            for one, other in itertools.combinations(bodies, 2):
                apart = int({tops.get(one, one), tops.get(other, other)} in pairs)
                p.setCollisionFilterPair(self.body, self.body, bodies[one], bodies[other], apart, client)
        self.motors = [self.joints[name] for name in robot.motor_names]
        geared = [name for name in robot.motor_names if f"{_ROTOR_PREFIX}{name}" in numbers]
        self.rotors = {self.joints[name]: numbers[f"{_ROTOR_PREFIX}{name}"] for name in geared}
        self.knees = [joint for joint in self.joints.values() if joint not in self.motors]
        self.feet = self._foot_spheres or [self.links[places[leg.foot][0]] for leg in robot.legs]
        self._colliding_links = (
            [*self.links.values(), *self._foot_spheres] if pairs or self._foot_spheres else [-1, *self.feet]
        )
        centres, radii = zip(*(self._foot_sphere(leg.foot) for leg in robot.legs), strict=True)
        self.foot_centre, self.foot_radius = np.array(centres), np.array(radii)
        if self._foot_spheres:
            self.foot_centre[:] = 0.0
        _, axes = links[base].body.principal()
        at_base = np.linalg.inv(base_frame)
        self.base_centre = (at_base @ [*links[base].body.centre, 1.0])[:3]
        self.base_quat = matrix_quat(at_base[:3, :3] @ axes)
        # In Bullet, a fixed base has no mass.
        moving = {name: link.body for name, link in links.items() if not (self.rack and name == base)}
        self.mass = {name: (body.mass, body.principal()[0]) for name, body in moving.items()}
        self._close_loops()
        nominal = robot.nominal_params()
        self.values = {name: float(nominal[name]) for name in CLIENT_PARAMETERS}
        self.rotor_inertia = np.broadcast_to(nominal["rotor_inertia"], robot.num_motors).astype(float)
        self._set_up_dynamics()
        self.check_masses(self.mass)
        self._gear_rotors()
        if self._foot_spheres:
            self._set_floor(self.values["floor_unevenness"])

    def _add_ground(self, ground: Ground, box: bool = False) -> int:
        """Add a static ground body and return its id; a flat ground is a plane or the top of a box."""
        p, client, place = self._p, self.client, [0.0, 0.0, 0.0]
        if not ground.is_flat:
            vertices, indices = _mesh(ground)
            shape = p.createCollisionShape(
                p.GEOM_MESH,
                vertices=vertices,
                indices=indices,
                flags=p.GEOM_FORCE_CONCAVE_TRIMESH,
                physicsClientId=client,
            )
        elif box:
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[100.0, 100.0, 5.0], physicsClientId=client)
            place[2] = -5.0
        else:
            shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        number: int = p.createMultiBody(0, shape, basePosition=place, physicsClientId=client)
        p.changeDynamics(number, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
        return number

    def _with_feet(self, urdf: Urdf) -> Urdf:
        """Return the URDF with the spheres of feet on separate links at the same positions.

        Feet then collide with contact planes, and shanks with the ground's body.
        """
        links, joints = dict(urdf.links), dict(urdf.joints)
        for leg in self.robot.legs:
            (sphere,) = self.robot.urdf.links[leg.foot].collisions
            top, frame = self.robot.urdf.fused_frames[leg.foot]
            place, name = np.eye(4), f"{_FOOT_PREFIX}{leg.foot}"
            place[:3, 3] = (frame @ sphere.frame)[:3, 3]
            others = [shape for shape in links[top].collisions if not np.allclose(shape.frame[:3, 3], place[:3, 3])]
            links[top] = replace(links[top], collisions=tuple(others))
            links[name] = Link(_MASSLESS_BODY, (), (replace(sphere, link=name, frame=np.eye(4)),))
            joints[name] = Joint(name, "fixed", top, name, (1.0, 0.0, 0.0), place)
        return Urdf(urdf.path, links, joints)

    def _with_rotors(self, urdf: Urdf) -> Urdf:
        """Return the URDF with a rotor for each motor joint, on the link to which the motor is fixed.

        Bullet has no joint inertia (armature). Inertia added to the driven link would also resist rotations of the link
        before it. A rotor that turns n times as fast with 1 / n^2 of the inertia reduces this to 1 / n.
        """
        rotor = Link(RigidBody(_ROTOR_MASS, np.zeros(3), 1e-9 * np.eye(3)), (), ())
        links, joints = dict(urdf.links), dict(urdf.joints)
        for joint in urdf.joints.values():
            if joint.name in self.robot.motor_names:
                name = f"{_ROTOR_PREFIX}{joint.name}"
                links[name] = rotor
                joints[name] = replace(joint, name=name, kind="continuous", child=name, limits=None)
        return Urdf(urdf.path, links, joints)

    def _gear_rotors(self) -> None:
        """Couple rotors to their joints by gears, and set their inertia."""
        p, body = self._p, self.body
        for joint, rotor in self.rotors.items():
            ends = (body, joint, body, rotor, p.JOINT_GEAR, [0, 0, 1], [0, 0, 0], [0, 0, 0])
            gear = p.createConstraint(*ends, physicsClientId=self.client)
            p.changeConstraint(gear, gearRatio=-1.0 / ROTOR_RATIO, maxForce=1e9, physicsClientId=self.client)
        self._set_rotor_inertia()

    def _set_rotor_inertia(self) -> None:
        for joint, inertia in zip(self.motors, self.rotor_inertia.tolist(), strict=True):
            if joint in self.rotors:
                moments = [max(inertia, _MIN_ROTOR_INERTIA) / ROTOR_RATIO**2] * 3
                self._p.changeDynamics(
                    self.body,
                    self.rotors[joint],
                    mass=_ROTOR_MASS,
                    localInertiaDiagonal=moments,
                    physicsClientId=self.client,
                )

    def set_rotors(self, angles: list[float], speeds: list[float]) -> None:
        """Set the rotors' angles and speeds for motor joint angles (M,) [rad] and speeds (M,) [rad/s]."""
        for motor, angle, speed in zip(self.motors, angles, speeds, strict=True):
            if motor in self.rotors:
                position = (ROTOR_RATIO * angle, ROTOR_RATIO * speed)
                self._p.resetJointState(self.body, self.rotors[motor], *position, self.client)

    def _foot_sphere(self, foot: str) -> tuple[Array, float]:
        """Return the centre of a foot's sphere in its link's inertial frame (3,) [m], and its radius [m]."""
        (sphere,) = self.robot.urdf.links[foot].collisions
        top, frame = self.robot.urdf.fused_frames[foot]
        return self._fused.links[top].body.in_principal((frame @ sphere.frame)[:3, 3]), sphere.size[0]

    def _with_shanks(self, urdf: Urdf) -> Urdf:
        """Return the URDF with boxes for feet: each lower link as wide as its visual, and as long as to its foot."""
        links, length = dict(urdf.links), self.robot.five_bar.foot
        frame = np.eye(4)
        frame[2, 3] = length / 2
        for leg in self.robot.legs:
            box = next((shape for shape in self.robot.urdf.links[leg.foot].visuals if shape.kind == "box"), None)
            if box is None:
                raise SurefootError(
                    f"{urdf.path}: link '{leg.foot}' has no visual box, which defines the width of its collision box"
                )
            top, _ = self.robot.urdf.fused_frames[leg.foot]
            links[top] = replace(links[top], collisions=(Shape(top, "box", (*box.size[:2], length / 2), frame),))
        return Urdf(urdf.path, links, urdf.joints)

    def _close_loops(self) -> None:
        p, body, robot = self._p, self.body, self.robot
        self.pins, self._pin_links, places, axes = [], [], [], []
        for loop in robot.loops:
            ends, points = [], []
            for link, point in zip(loop.links, loop.points, strict=True):
                name, frame = robot.urdf.fused_frames[link]
                at_link = self._fused.links[name].body
                ends.append(self.links[name])
                points.append(at_link.in_principal((frame @ [*point, 1.0])[:3]))
            along = next(joint.axis for joint in robot.urdf.joints.values() if joint.child == name)
            at = [point.tolist() for point in points]
            self.pins.append(
                p.createConstraint(
                    body, ends[0], body, ends[1], p.JOINT_POINT2POINT, [0, 0, 0], *at, physicsClientId=self.client
                )
            )
            self._pin_links.append(ends[1])
            places.append(points[1])
            axes.append(at_link.principal()[1].T @ along)
        self._pin_places, self._pin_axes = np.reshape(places, (-1, 3)), np.reshape(axes, (-1, 3))
        self.pin_shift = np.zeros_like(self._pin_places)

    def _set_up_dynamics(self) -> None:
        """Remove damping and default motors, and set the foot contact; contacts of other links are stiff."""
        for link in (*self.links.values(), *self.rotors.values(), *self._foot_spheres):
            self._p.changeDynamics(
                self.body,
                link,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                restitution=0.0,
                lateralFriction=1.0,
                spinningFriction=0.0,
                rollingFriction=0.0,
                maxJointVelocity=_MAX_SPEED,
                physicsClientId=self.client,
            )
        self._set_joint_friction([*self.joints.values(), *self.rotors.values()], 0.0)
        self._set_foot_contact()

    def _set_joint_friction(self, joints: list[int], torque: float) -> None:
        """Set Coulomb friction of joints [N m], as motors with target speed 0 and a torque limit."""
        forces = [torque] * len(joints)
        p = self._p
        p.setJointMotorControlArray(self.body, joints, p.VELOCITY_CONTROL, forces=forces, physicsClientId=self.client)

    def apply(self, values: dict[str, float], rotor_inertia: Array) -> None:
        """Set `CLIENT_PARAMETERS` and rotor inertias (M,) [kg m2], and update only what depends on changed values."""
        changed = {name for name in CLIENT_PARAMETERS if values[name] != self.values[name]}
        rotors_changed = not np.array_equal(rotor_inertia, self.rotor_inertia)
        self.values, self.rotor_inertia = values, rotor_inertia.copy()
        if changed.intersection(CONTACT_PARAMS):
            self._set_foot_contact()
        if changed.intersection(MASS_RATIOS):
            self._scale_masses()
        if rotors_changed:
            self._set_rotor_inertia()
        if "knee_friction" in changed:
            self._set_joint_friction(self.knees, values["knee_friction"])
        if "floor_unevenness" in changed:
            self._set_floor(values["floor_unevenness"])

    def _set_foot_contact(self) -> None:
        _, stiffness, spinning, shear = (self.values[name] for name in CONTACT_PARAMS)
        # Bullet's own friction is rigid along the ground.
        self.soles = shear != 1.0 and not self.rack
        self._sole_law = (stiffness * shear, self.robot.contact.damping, self.robot.timing.servo_step)
        self._reset_soles()
        for link in self.feet:
            self._p.changeDynamics(
                self.body,
                link,
                # In Bullet this is a length: the torque about the normal is at most this times the normal force.
                spinningFriction=spinning,
                contactStiffness=stiffness,
                # Bullet uses a stiffness only together with a damping.
                contactDamping=self.robot.contact.damping,
                physicsClientId=self.client,
            )
        self._foot_friction = np.full(len(self.feet), np.nan)
        self.update_friction()

    def update_friction(self) -> None:
        """Set the friction of the feet for their positions on the ground."""
        ground, friction = self._ground, np.full(len(self.feet), self.values["contact_friction"])
        if ground.friction.size:
            grid = ground.patch_grid
            friction *= [friction_factor(ground.friction, grid, x, y) for x, y, _ in self.foot_positions()]
        for k in np.flatnonzero(friction != self._foot_friction):
            lateral = 0.0 if self.soles else float(friction[k])
            self._p.changeDynamics(self.body, self.feet[k], lateralFriction=lateral, physicsClientId=self.client)
        self._foot_friction = friction

    def _scale_masses(self) -> None:
        """Set scaled masses and moments of the base and other links, and check that Bullet has them."""
        base_mass, leg_mass, base_inertia, leg_inertia = (self.values[name] for name in MASS_RATIOS)
        scaled = {}
        for name, (mass, moments) in self.mass.items():
            link = self.links[name]
            mass = mass * (base_mass if link < 0 else leg_mass)
            moments = moments * (base_inertia if link < 0 else leg_inertia)
            # Given only a mass, Bullet would use the inertia of the collision shape.
            self._p.changeDynamics(
                self.body, link, mass=mass, localInertiaDiagonal=moments.tolist(), physicsClientId=self.client
            )
            scaled[name] = (mass, moments)
        self.check_masses(scaled)

    def check_masses(self, mass: dict[str, tuple[float, Array]]) -> None:
        """Raise a `SurefootError` if Bullet has other masses or principal moments than these, by name of the link."""
        for name, (value, moments) in mass.items():
            info = self._p.getDynamicsInfo(self.body, self.links[name], physicsClientId=self.client)
            if not (np.isclose(info[0], value, rtol=1e-9) and np.allclose(info[2], moments, rtol=1e-6, atol=0.0)):
                raise SurefootError(
                    f"{self.robot.urdf.path}: link '{name}': Bullet has mass {info[0]:g} kg and moments {info[2]}; "
                    f"they must be {value:g} kg and {tuple(moments.tolist())}"
                )

    def _set_floor(self, unevenness: float) -> None:
        """Set an uneven floor for the feet, see `uneven_floor`; other links keep colliding with `ground`.

        Each foot has its own contact planes, because a height field or mesh would push a foot down and out whose centre
        is below the surface, as can be the case with soft feet. On a ground with cells, the uneven floor is added to
        its heights.
        """
        p, client = self._p, self.client
        for plane in self.planes:
            p.removeBody(plane, physicsClientId=client)
        self._floor = uneven_floor(unevenness)
        standing = self.feet if unevenness or self._foot_spheres else []
        self.planes = [self._add_ground(FLAT) for _ in [*standing, *self._foot_spheres]]
        self._plane_poses = np.full((len(self.planes), 4), np.nan)
        for foot in self.feet:
            p.setCollisionFilterPair(self.body, self.ground, foot, -1, int(not standing), physicsClientId=client)
        for foot, plane in zip([*standing, *self._foot_spheres], self.planes, strict=True):
            for link in {*self.links.values(), *self._foot_spheres} - {foot}:
                p.setCollisionFilterPair(self.body, plane, link, -1, 0, physicsClientId=client)

    def place_planes(self) -> None:
        """Move the contact planes and wall planes to the deepest contacts of the feet."""
        feet = self.foot_positions()
        if not self._foot_spheres:
            self._place_on_floor(feet[:, :2])
            return
        planes, height = np.empty_like(self._plane_poses), self._floor.height(feet[:, :2])
        contact_planes(self._ground.corners, self._ground.grid, feet, height, self.foot_radius, planes)
        # Planes that are not moved keep Bullet's contact cache.
        moved = ~(np.abs(planes - self._plane_poses) < _PLANE_TOLERANCE).all(axis=1)
        self._plane_poses[moved] = planes[moved]
        for k in np.flatnonzero(moved):
            x, y, z, offset = planes[k]
            quat = np.array([-y, x, 0.0, 1.0 + z]) / np.sqrt(2.0 + 2.0 * z)
            origin = (offset * planes[k, :3]).tolist()
            self._p.resetBasePositionAndOrientation(self.planes[k], origin, quat.tolist(), self.client)

    def _place_on_floor(self, points: Array) -> None:
        """Move the planes of an uneven floor to its triangles under the feet at points (F, 2) [m]."""
        triangles = self._floor.plane_at(points)
        heights, slopes = triangles[:, 0], triangles[:, 1:]
        for k in np.flatnonzero((slopes != self._plane_poses[:, :2]).any(axis=1)):
            (x, y), height = slopes[k], heights[k] - slopes[k] @ points[k]
            quat = np.array([y, -x, 0.0, 1.0 + np.sqrt(1.0 + x * x + y * y)])
            quat /= np.linalg.norm(quat)
            self._p.resetBasePositionAndOrientation(self.planes[k], [0, 0, height], quat.tolist(), self.client)
        self._plane_poses[:, :2] = slopes

    def contact_points(self) -> list[tuple[Any, ...]]:
        """Return Bullet's contact points between the robot and the bodies that feet touch."""
        bodies = self.planes[: len(self.feet)] or [self.ground]
        return [point for body in bodies for point in self._p.getContactPoints(self.body, body, -2, -2, self.client)]

    def foot_positions(self) -> Array:
        """Return the foot centres in the world frame (F, 3) [m]."""
        states = self._p.getLinkStates(self.body, self.feet, computeForwardKinematics=1, physicsClientId=self.client)
        feet = np.empty((len(self.feet), 3))
        sphere_centres(np.array([[*state[0], *state[1]] for state in states]), self.foot_centre, feet)
        return feet

    def update_pins(self) -> None:
        """Move pins with play in their bores according to the forces on them after a step; see `pin_kernel`."""
        p, client = self._p, self.client
        states = p.getLinkStates(self.body, self._pin_links, physicsClientId=client)
        # Bullet returns the force on the first link, with the bore; the force on the pin is the opposite.
        forces = np.array([p.getConstraintState(number, physicsClientId=client) for number in self.pins])
        quats = np.array([state[1] for state in states])
        pin_kernel(quats, -forces, self._pin_axes, self.values["knee_play"], self.pin_shift)
        self._place_pins()

    def _reset_soles(self) -> None:
        self._shear_stretch = np.zeros((len(self.feet), 3))
        self._sole_force, self._sole_place = np.zeros((2, len(self.feet), 3))

    def apply_sole_forces(self) -> None:
        """Apply the tangential ground forces on the feet, which Bullet drops after each step."""
        p, client = self._p, self.client
        for link, force, place in zip(self.feet, self._sole_force.tolist(), self._sole_place.tolist(), strict=True):
            if any(force):
                p.applyExternalForce(self.body, link, force, place, p.WORLD_FRAME, client)

    def update_soles(self, points: Sequence[tuple[Any, ...]]) -> None:
        """Update the shear and the forces of the soles from Bullet's contact points after a step; see `sole_kernel`."""
        loads = np.zeros((len(self.feet), 3))
        for point in points:
            if point[3] in self.feet:
                loads[self.feet.index(point[3])] += point[9] * np.array(point[7])
        states = self._p.getLinkStates(self.body, self.feet, computeLinkVelocity=1, physicsClientId=self.client)
        links = np.array([[*state[0], *state[1], *state[6], *state[7]] for state in states])
        feet = (self.foot_centre, self.foot_radius)
        law, output = (self._foot_friction, self._sole_law), (self._sole_force, self._sole_place)
        sole_kernel(links, loads, *feet, *law, self._shear_stretch, *output)

    def clear_contacts(self) -> None:
        """Clear Bullet's contact cache and the shear of the soles, and centre pins with play."""
        self._reset_soles()
        if self._foot_spheres:
            self._plane_poses[:] = np.nan
        if self.pin_shift.any():
            self.pin_shift[:] = 0.0
            self._place_pins()
        # Setting the collision filter of a link removes it from Bullet's cached pairs and adds it again.
        for link in self._colliding_links:
            self._p.setCollisionFilterGroupMask(self.body, link, 1, -1, self.client)

    def _place_pins(self) -> None:
        for number, place in zip(self.pins, (self._pin_places - self.pin_shift).tolist(), strict=True):
            self._p.changeConstraint(number, jointChildPivot=place, physicsClientId=self.client)


@functools.lru_cache(maxsize=1)
def _mesh(ground: Ground) -> tuple[list[list[float]], list[int]]:
    """Return the vertices of a ground's triangles and their indices.

    Raises:
        SurefootError: a ground that is too large for PyBullet.
    """
    corners = ground.triangles().reshape(-1, 3)
    vertices, indices = np.unique(corners, axis=0, return_inverse=True)
    if len(vertices) > _MAX_VERTICES or len(corners) > _MAX_INDICES:
        raise SurefootError(
            f"the ground has {len(corners) // 3} triangles with {len(vertices)} corners; Bullet allows at most "
            f"{_MAX_INDICES // 3} with {_MAX_VERTICES}: make the terrain smaller or coarser, or use world mujoco"
        )
    return vertices.tolist(), indices.ravel().tolist()
