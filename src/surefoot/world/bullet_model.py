"""A robot's description in Bullet: a client of its own with the fused URDF, closed loops and the ground."""

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
from surefoot.native_output import quiet
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.rigid_body import RigidBody
from surefoot.robot.self_collision import collision_pairs
from surefoot.robot.urdf import Joint, Link, Shape, Urdf
from surefoot.robot.urdf_file import format_urdf
from surefoot.rotations import matrix_quat
from surefoot.world.actuation import CONTACT_PARAMS, RACK_HEIGHT, RATIOS
from surefoot.world.bullet_kernels import contact_planes, pin_kernel, sole_kernel, sphere_centres
from surefoot.world.ground import FLAT, Ground, uneven_floor
from surefoot.world.ground_contact import friction_factor
from surefoot.world.interface import WorldConfig

SOLVER_ITERATIONS = 50
"""With 50, loops stay closed within .02 mm on a slow trot (.09 mm with constraint motors) and .4 mm at a gallop of
2 m/s, and a trot is within .6 mm of one with 1000 for a second. With 10, a step costs 17 % less, but constraint motors
open the loops by 1.2 mm, and the robot ends elsewhere.
"""
LOOP_ERP = 0.2
"""Share of a loop's gap that is closed in a step."""
_NO_OFFSET = np.zeros(3)
_MAX_SPEED = 1e6
"""Bullet cuts all generalized speeds at this [m/s, rad/s]; its own 100 would stop motors, and hide a divergence."""
ROTOR_RATIO = 300.0
"""Turns of a rotor for a turn of its joint in Bullet; the more, the less it resists the turning of what it is on."""
_ROTOR_PREFIX, _FOOT_PREFIX = "rotor of ", "sphere of "
_ROTOR_MASS = 1e-9
_MASSLESS_BODY = RigidBody(_ROTOR_MASS, np.zeros(3), 1e-12 * np.eye(3))
_MIN_ROTOR_INERTIA = 1e-6
_MAX_VERTICES, _MAX_INDICES = 131_072, 524_288
"""Of a mesh in PyBullet."""
_PLANE_TOLERANCE = 1e-12
"""Difference of numbers of a plane, see `contact_planes`, below which it stays where it is."""


@dataclass(frozen=True)
class BulletSettings:
    """Settings of Bullet that decide how bodies and contacts are solved."""

    solver_iterations: int = SOLVER_ITERATIONS
    """Iterations of the constraint solver, at most; it stops earlier when nothing changes any more."""
    cone_friction: bool = True
    """A cone of friction; without it Bullet takes a pyramid and solves no spinning friction."""
    gravity: float = GRAVITY
    """[m/s2]"""
    feet: Literal["sphere", "shank"] = "sphere"
    """What feet stand on: the sphere of the URDF, or the lower link as a box that ends at the foot."""
    ground: Literal["plane", "box"] = "plane"
    """The floor: a plane, or the top of a box 200 m wide; Bullet finds other contacts between boxes."""


PUBLISHED = BulletSettings(cone_friction=False, gravity=10.0, feet="shank", ground="box")
"""The simulator that was published with the description of the paper's robot (pybullet_envs): no cone friction,
300 solver iterations over 6 steps, gravity 10 m/s2, lower links as boxes on a box (on a plane, `trot` falls in 5 of 10
episodes; there it never does)."""
PARAMETERS = (*CONTACT_PARAMS, *RATIOS, "knee_friction", "knee_play", "floor_unevenness")
"""Physical parameters that are a client's own; servo, motors and sensors have the others."""


def import_pybullet() -> ModuleType:
    """Import PyBullet without its banner; a `ModuleNotFoundError`, if it is not installed."""
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    with quiet():
        import pybullet
    module: ModuleType = pybullet
    return module


class BulletModel:
    """A robot in a Bullet client of its own, on the ground, motors off; the client ends with the object.

    With `pairs`, links that may collide, as `collision_pairs` returns them: it takes a tenth of a second.

    Bullet's link frames are inertial frames. L links besides the base, each with one joint; M motors, F feet, P pins
    that close loops. Indices of links and joints are the same in all clients.

    Raises:
        SurefootError: Bullet has no room for another client, or reads other masses than the file has.
        ModuleNotFoundError: PyBullet is not installed.
    """

    client: int
    ground: int
    """Body of the world's ground, on which all but the feet may stand."""
    planes: list[int]
    """Planes that feet stand on, one for each foot on an uneven floor; on a ground with cells there follows one for
    each foot at walls. None, if feet stand on the ground itself."""
    body: int
    """The robot's."""
    links: dict[str, int]
    """Link index by name of the fused link; -1 is the base."""
    joints: dict[str, int]
    motors: list[int]
    """Joint indices in the robot's motor order."""
    knees: list[int]
    """Indices of the joints without a motor."""
    rotors: dict[int, int]
    """Index of the joint of each rotor by that of the joint it drives."""
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
    """Nominal mass [kg] and principal moments [kg m2] of each fused link that moves."""
    pins: list[int]
    """Numbers of the constraints that close loops."""
    pin_shift: Array
    """Displacement of each pin with play in its bore, in its link's inertial frame [m], (P, 3)."""
    soles: bool
    """The feet's friction is that of `contact`, with a stiffness along the ground of its own, not Bullet's."""
    values: dict[str, float]
    """The `PARAMETERS` that the client has."""
    rotor_inertia: Array
    """Inertia of each rotor at its joint [kg m2], (M,)."""
    base_offset: Array
    """Centre of mass of the base, less the description's [m], (3,)."""

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
        with quiet():
            try:
                self.client = self._p.connect(self._p.DIRECT)
            except self._p.error:
                self.client = -1
            if self.client < 0:
                raise SurefootError("Bullet has no room for another robot in this process; simulate fewer at once")
            self.close = weakref.finalize(self, self._p.disconnect, self.client)
            self._load(settings)

    def _load(self, settings: BulletSettings) -> None:
        p, client, robot, links = self._p, self.client, self.robot, self._fused.links
        places = robot.urdf.places
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
                raise SurefootError(f"{robot.urdf.path}: Bullet refuses it: {error}") from error
        count = p.getNumJoints(self.body, physicsClientId=client)
        infos = [p.getJointInfo(self.body, joint, physicsClientId=client) for joint in range(count)]
        numbers = {info[1].decode(): info[0] for info in infos}
        self.joints = {name: number for name, number in numbers.items() if not name.startswith((_ROTOR_PREFIX, _FOOT_PREFIX))}
        self.links = {base: -1} | {info[12].decode(): info[0] for info in infos if info[0] in self.joints.values()}
        tops = {f"{_FOOT_PREFIX}{leg.foot}": places[leg.foot][0] for leg in robot.legs}
        self._spheres = [] if self._ground.is_flat else [numbers[name] for name in tops]
        if pairs:
            bodies = self.links | dict(zip(tops, self._spheres, strict=False))
            for one, other in itertools.combinations(bodies, 2):
                apart = int({tops.get(one, one), tops.get(other, other)} in pairs)
                p.setCollisionFilterPair(self.body, self.body, bodies[one], bodies[other], apart, client)
        self.motors = [self.joints[name] for name in robot.motor_names]
        geared = [name for name in robot.motor_names if f"{_ROTOR_PREFIX}{name}" in numbers]
        self.rotors = {self.joints[name]: numbers[f"{_ROTOR_PREFIX}{name}"] for name in geared}
        self.knees = [joint for joint in self.joints.values() if joint not in self.motors]
        self.feet = self._spheres or [self.links[places[leg.foot][0]] for leg in robot.legs]
        self._touching = [*self.links.values(), *self._spheres] if pairs or self._spheres else [-1, *self.feet]
        centres, radii = zip(*(self._foot_sphere(leg.foot) for leg in robot.legs), strict=True)
        self.foot_centre, self.foot_radius = np.array(centres), np.array(radii)
        if self._spheres:
            self.foot_centre[:] = 0.0
        _, axes = links[base].body.principal()
        at_base = np.linalg.inv(base_frame)
        self.base_centre = (at_base @ [*links[base].body.centre, 1.0])[:3]
        self.base_quat = matrix_quat(at_base[:3, :3] @ axes)
        # A base on a rack has no mass.
        moving = {name: link.body for name, link in links.items() if not (self.rack and name == base)}
        self.mass = {name: (body.mass, body.principal()[0]) for name, body in moving.items()}
        self._close_loops()
        nominal = robot.nominal_params()
        self.values = {name: float(nominal[name]) for name in PARAMETERS}
        self.rotor_inertia = np.broadcast_to(nominal["rotor_inertia"], robot.num_motors).astype(float)
        self._set_up_dynamics()
        self.check_masses(self.mass)
        self._gear_rotors()
        if self._spheres:
            self._set_floor(self.values["floor_unevenness"])

    def _add_ground(self, ground: Ground, box: bool = False) -> int:
        """Return the number of a body to stand on, which does not move; a flat one is a plane or the top of a box."""
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
        """Return the URDF with the spheres of feet on links of their own, which are fixed to where they were.

        So planes that feet stand on leave the shank alone, which meets the ground itself.
        """
        links, joints = dict(urdf.links), dict(urdf.joints)
        for leg in self.robot.legs:
            (sphere,) = self.robot.urdf.links[leg.foot].collisions
            top, frame = self.robot.urdf.places[leg.foot]
            place, name = np.eye(4), f"{_FOOT_PREFIX}{leg.foot}"
            place[:3, 3] = (frame @ sphere.frame)[:3, 3]
            others = [shape for shape in links[top].collisions if not np.allclose(shape.frame[:3, 3], place[:3, 3])]
            links[top] = replace(links[top], collisions=tuple(others))
            links[name] = Link(_MASSLESS_BODY, (), (replace(sphere, link=name, frame=np.eye(4)),))
            joints[name] = Joint(name, "fixed", top, name, (1.0, 0.0, 0.0), place)
        return Urdf(urdf.path, links, joints)

    def _with_rotors(self, urdf: Urdf) -> Urdf:
        """Return the URDF with a rotor beside every joint with a motor, on the link that the motor is fixed to.

        Bullet has no inertia of joints. One that is added to the link that the joint turns would resist the turning of
        the link before it too; a rotor that turns n times as fast, with 1 / n^2 of the inertia, does so by 1 / n.
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
        """Couple rotors to their joints, and give them their inertia."""
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
        """Put rotors where joints at angles (M,) [rad] and speeds (M,) [rad/s] of the motors have them."""
        for motor, angle, speed in zip(self.motors, angles, speeds, strict=True):
            if motor in self.rotors:
                position = (ROTOR_RATIO * angle, ROTOR_RATIO * speed)
                self._p.resetJointState(self.body, self.rotors[motor], *position, self.client)

    def _foot_sphere(self, foot: str) -> tuple[Array, float]:
        """Return the centre [m] of a foot's sphere in its link's inertial frame, and its radius [m]."""
        (sphere,) = self.robot.urdf.links[foot].collisions
        top, frame = self.robot.urdf.places[foot]
        return self._fused.links[top].body.in_principal((frame @ sphere.frame)[:3, 3]), sphere.size[0]

    def _with_shanks(self, urdf: Urdf) -> Urdf:
        """Return the URDF with boxes for feet: each lower link as wide as its visual, as long as to its foot."""
        links, length = dict(urdf.links), self.robot.five_bar.foot
        frame = np.eye(4)
        frame[2, 3] = length / 2
        for leg in self.robot.legs:
            box = next((shape for shape in self.robot.urdf.links[leg.foot].visuals if shape.kind == "box"), None)
            if box is None:
                raise SurefootError(
                    f"{urdf.path}: link '{leg.foot}' has no visual box; its collision box takes that width"
                )
            top, _ = self.robot.urdf.places[leg.foot]
            links[top] = replace(links[top], collisions=(Shape(top, "box", (*box.size[:2], length / 2), frame),))
        return Urdf(urdf.path, links, urdf.joints)

    def _close_loops(self) -> None:
        p, body, robot = self._p, self.body, self.robot
        self.pins, self._pin_links, places, axes = [], [], [], []
        for loop in robot.loops:
            ends, points = [], []
            for link, point in zip(loop.links, loop.points, strict=True):
                name, frame = robot.urdf.places[link]
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
        """Remove damping and default motors, and set the contact of the feet; all else is stiff against the ground."""
        for link in (*self.links.values(), *self.rotors.values(), *self._spheres):
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
        """Give joints motors with target speed 0 and at most a torque [N m]."""
        forces = [torque] * len(joints)
        p = self._p
        p.setJointMotorControlArray(self.body, joints, p.VELOCITY_CONTROL, forces=forces, physicsClientId=self.client)

    def apply(self, values: dict[str, float], rotor_inertia: Array) -> None:
        """Give the robot other `PARAMETERS` and rotors; what depends on those that stay is left as it is."""
        changed = {name for name in PARAMETERS if values[name] != self.values[name]}
        rotors_changed = not np.array_equal(rotor_inertia, self.rotor_inertia)
        self.values, self.rotor_inertia = values, rotor_inertia.copy()
        if changed.intersection(CONTACT_PARAMS):
            self._set_foot_contact()
        if changed.intersection(RATIOS):
            self._scale_masses()
        if rotors_changed:
            self._set_rotor_inertia()
        if "knee_friction" in changed:
            self._set_joint_friction(self.knees, values["knee_friction"])
        if "floor_unevenness" in changed:
            self._set_floor(values["floor_unevenness"])

    def _set_foot_contact(self) -> None:
        _, stiffness, spinning, shear = (self.values[name] for name in CONTACT_PARAMS)
        # Bullet's own friction holds a foot where it is, without give.
        self.soles = shear != 1.0 and not self.rack
        self._sole_law = (stiffness * shear, self.robot.contact.damping, self.robot.timing.servo_step)
        self._reset_soles()
        for link in self.feet:
            self._p.changeDynamics(
                self.body,
                link,
                # Bullet takes it as a length: it bounds the torque about the normal by this times the normal force.
                spinningFriction=spinning,
                contactStiffness=stiffness,
                # Bullet takes a stiffness only together with a damping.
                contactDamping=self.robot.contact.damping,
                physicsClientId=self.client,
            )
        self._foot_friction = np.full(len(self.feet), np.nan)
        self.update_friction()

    def update_friction(self) -> None:
        """Give the feet the friction of the places where they are."""
        ground, friction = self._ground, np.full(len(self.feet), self.values["contact_friction"])
        if ground.friction.size:
            grid = ground.patch_grid
            friction *= [friction_factor(ground.friction, grid, x, y) for x, y, _ in self.foot_positions()]
        for k in np.flatnonzero(friction != self._foot_friction):
            lateral = 0.0 if self.soles else float(friction[k])
            self._p.changeDynamics(self.body, self.feet[k], lateralFriction=lateral, physicsClientId=self.client)
        self._foot_friction = friction

    def _scale_masses(self) -> None:
        """Multiply the nominal masses and moments of base and other links, and check that Bullet has them."""
        base_mass, leg_mass, base_inertia, leg_inertia = (self.values[name] for name in RATIOS)
        scaled = {}
        for name, (mass, moments) in self.mass.items():
            link = self.links[name]
            mass = mass * (base_mass if link < 0 else leg_mass)
            moments = moments * (base_inertia if link < 0 else leg_inertia)
            # Given a mass alone, Bullet would take the inertia of the collision shape.
            self._p.changeDynamics(
                self.body, link, mass=mass, localInertiaDiagonal=moments.tolist(), physicsClientId=self.client
            )
            scaled[name] = (mass, moments)
        self.check_masses(scaled)

    def check_masses(self, mass: dict[str, tuple[float, Array]]) -> None:
        """Refuse if Bullet has other masses or principal moments than these, by name of the link."""
        for name, (value, moments) in mass.items():
            info = self._p.getDynamicsInfo(self.body, self.links[name], physicsClientId=self.client)
            if not (np.isclose(info[0], value, rtol=1e-9) and np.allclose(info[2], moments, rtol=1e-6, atol=0.0)):
                raise SurefootError(
                    f"{self.robot.urdf.path}: link '{name}': Bullet has mass {info[0]:g} kg and moments {info[2]}; "
                    f"they must be {value:g} kg and {tuple(moments.tolist())}"
                )

    def _set_floor(self, unevenness: float) -> None:
        """Give the feet another floor, see `uneven_floor`; all of the robot but its feet stays on `ground`.

        Each foot has planes of its own: a height field or a mesh would push a foot whose centre is below its surface,
        as that of soft feet is, down and out. An uneven floor lifts and lowers a ground with cells.
        """
        p, client = self._p, self.client
        for plane in self.planes:
            p.removeBody(plane, physicsClientId=client)
        self._floor = uneven_floor(unevenness)
        standing = self.feet if unevenness or self._spheres else []
        self.planes = [self._add_ground(FLAT) for _ in [*standing, *self._spheres]]
        self._planes_at = np.full((len(self.planes), 4), np.nan)
        for foot in self.feet:
            p.setCollisionFilterPair(self.body, self.ground, foot, -1, int(not standing), physicsClientId=client)
        for foot, plane in zip([*standing, *self._spheres], self.planes, strict=True):
            for link in {*self.links.values(), *self._spheres} - {foot}:
                p.setCollisionFilterPair(self.body, plane, link, -1, 0, physicsClientId=client)

    def place_planes(self) -> None:
        """Put the planes that feet stand on, and those at walls, where the ground is deepest in them."""
        feet = self.foot_positions()
        if not self._spheres:
            self._place_on_floor(feet[:, :2])
            return
        planes, height = np.empty_like(self._planes_at), self._floor.height(feet[:, :2])
        contact_planes(self._ground.corners, self._ground.grid, feet, height, self.foot_radius, planes)
        # One that stays keeps Bullet's contacts with it.
        moved = ~(np.abs(planes - self._planes_at) < _PLANE_TOLERANCE).all(axis=1)
        self._planes_at[moved] = planes[moved]
        for k in np.flatnonzero(moved):
            x, y, z, offset = planes[k]
            quat = np.array([-y, x, 0.0, 1.0 + z]) / np.sqrt(2.0 + 2.0 * z)
            origin = (offset * planes[k, :3]).tolist()
            self._p.resetBasePositionAndOrientation(self.planes[k], origin, quat.tolist(), self.client)

    def _place_on_floor(self, points: Array) -> None:
        """Put the planes of an uneven floor where its triangles under the feet at points (F, 2) are."""
        triangles = self._floor.plane_at(points)
        heights, slopes = triangles[:, 0], triangles[:, 1:]
        for k in np.flatnonzero((slopes != self._planes_at[:, :2]).any(axis=1)):
            (x, y), height = slopes[k], heights[k] - slopes[k] @ points[k]
            quat = np.array([y, -x, 0.0, 1.0 + np.sqrt(1.0 + x * x + y * y)])
            quat /= np.linalg.norm(quat)
            self._p.resetBasePositionAndOrientation(self.planes[k], [0, 0, height], quat.tolist(), self.client)
        self._planes_at[:, :2] = slopes

    def contact_points(self) -> list[tuple[Any, ...]]:
        """Return Bullet's contact points of the robot with what its feet stand on."""
        bodies = self.planes[: len(self.feet)] or [self.ground]
        return [point for body in bodies for point in self._p.getContactPoints(self.body, body, -2, -2, self.client)]

    def foot_positions(self) -> Array:
        """Return the centres of the feet in the world frame [m], (F, 3)."""
        states = self._p.getLinkStates(self.body, self.feet, computeForwardKinematics=1, physicsClientId=self.client)
        feet = np.empty((len(self.feet), 3))
        sphere_centres(np.array([[*state[0], *state[1]] for state in states]), self.foot_centre, feet)
        return feet

    def update_pins(self) -> None:
        """Move pins with play in their bores, as the forces through them have it after a step; see `pin_kernel`."""
        p, client = self._p, self.client
        states = p.getLinkStates(self.body, self._pin_links, physicsClientId=client)
        # Bullet states the force on the first link, where the bore is; the pin feels the opposite.
        forces = np.array([p.getConstraintState(number, physicsClientId=client) for number in self.pins])
        quats = np.array([state[1] for state in states])
        pin_kernel(quats, -forces, self._pin_axes, self.values["knee_play"], self.pin_shift)
        self._place_pins()

    def _reset_soles(self) -> None:
        self._sole_stretch = np.zeros((len(self.feet), 3))
        self._sole_force, self._sole_place = np.zeros((2, len(self.feet), 3))

    def apply_sole_forces(self) -> None:
        """Apply the forces along the ground on the feet, which Bullet forgets after a step."""
        p, client = self._p, self.client
        for link, force, place in zip(self.feet, self._sole_force.tolist(), self._sole_place.tolist(), strict=True):
            if any(force):
                p.applyExternalForce(self.body, link, force, place, p.WORLD_FRAME, client)

    def update_soles(self, points: Sequence[tuple[Any, ...]]) -> None:
        """Move soles with their feet, from Bullet's contact points after a step; see `sole_kernel`."""
        loads = np.zeros((len(self.feet), 3))
        for point in points:
            if point[3] in self.feet:
                loads[self.feet.index(point[3])] += point[9] * np.array(point[7])
        states = self._p.getLinkStates(self.body, self.feet, computeLinkVelocity=1, physicsClientId=self.client)
        links = np.array([[*state[0], *state[1], *state[6], *state[7]] for state in states])
        feet = (self.foot_centre, self.foot_radius)
        law, output = (self._foot_friction, self._sole_law), (self._sole_force, self._sole_place)
        sole_kernel(links, loads, *feet, *law, self._sole_stretch, *output)

    def clear_contacts(self) -> None:
        """Forget the contacts that Bullet remembers and the soles' stretch, and centre pins with play."""
        self._reset_soles()
        if self._spheres:
            self._planes_at[:] = np.nan
        if self.pin_shift.any():
            self.pin_shift[:] = 0.0
            self._place_pins()
        # A link that gets its collision filter again is taken out of Bullet's pairs, and put back.
        for link in self._touching:
            self._p.setCollisionFilterGroupMask(self.body, link, 1, -1, self.client)

    def _place_pins(self) -> None:
        for number, place in zip(self.pins, (self._pin_places - self.pin_shift).tolist(), strict=True):
            self._p.changeConstraint(number, jointChildPivot=place, physicsClientId=self.client)


@functools.lru_cache(maxsize=1)
def _mesh(ground: Ground) -> tuple[list[list[float]], list[int]]:
    """Return the corners of a ground's triangles and their indices; refuse more than PyBullet takes."""
    corners = ground.triangles().reshape(-1, 3)
    vertices, indices = np.unique(corners, axis=0, return_inverse=True)
    if len(vertices) > _MAX_VERTICES or len(corners) > _MAX_INDICES:
        raise SurefootError(
            f"the ground has {len(corners) // 3} triangles with {len(vertices)} corners; Bullet takes at most "
            f"{_MAX_INDICES // 3} with {_MAX_VERTICES}: make the terrain smaller or coarser, or take world mujoco"
        )
    return vertices.tolist(), indices.ravel().tolist()
