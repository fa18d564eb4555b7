"""A batch of robots in Bullet, each in a physics client of its own.

Servo, motors, delays and sensors are the same compiled functions as in every other world; Bullet has only the bodies,
the loops and the contacts. Feet meet the ground by Bullet's own contact with the stiffness and damping of the data
sheet, which its solver takes implicitly: force = K d + B d' at the end of the step, not at its start.

A robot's state is one row of numbers, in Bullet's own frames: for Bullet, the base is where its centre of mass is,
turned like its principal axes. After every control step the row is written back to Bullet, whose quaternion of the
base would otherwise differ from it in the last bit: so a state that is saved and restored continues exactly.
"""

from __future__ import annotations

import weakref
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.rotations import quat_matrix, xyzw_matrix
from surefoot.world.bullet_import import import_pybullet
from surefoot.world.bullet_model import (
    PUBLISHED,
    BulletSettings,
    lay_floor,
    move_pins,
    open_client,
    place_pins,
    scale_masses,
    set_foot_contact,
    set_knee_friction,
)
from surefoot.world.bullet_tick import (
    JOINTS,
    OMEGA,
    VELOCITY,
    Layout,
    base_links,
    between,
    observe,
)
from surefoot.world.drive import RACK_HEIGHT, SPEED_LIMIT, Drive, racked_bases
from surefoot.world.interface import WorldConfig

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MAX_ROBOTS = 256
"""Robots in one process; PyBullet has room for 1024 clients. Each takes some 33 MB of memory."""


class _Setup(NamedTuple):
    """The physical parameters that were applied to a client."""

    contact: tuple[float, ...]
    """Friction coefficient, stiffness [N/m] and spinning friction [m] of the feet."""
    ratios: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    """Mass of base and legs, inertia of base and legs, to the description's."""
    knee_friction: float = 0.0
    floor_unevenness: float = 0.0


def _disconnect(p: ModuleType, clients: list[int]) -> None:
    for client in clients:
        p.disconnect(client)


class BulletEngine:
    """Bullet behind the engine interface: observe, advance, parameters, forces and snapshots of single robots.

    Args:
        robot: what to simulate.
        drive: shared servo, motor and sensor arrays; its first axis is the number of robots.
        config: actuator and rack. An engine steps its robots one after another: see `process_world` for several cores.
        settings: how Bullet solves bodies and contacts.

    Raises:
        SurefootError: more robots than a process can hold, or a robot that Bullet reads with other masses.
        ModuleNotFoundError: PyBullet is not installed.
    """

    name = "bullet"

    def __init__(
        self,
        robot: RobotDescription,
        drive: Drive,
        config: WorldConfig | None = None,
        settings: BulletSettings | None = None,
    ) -> None:
        self.robot, self.drive, self._config = robot, drive, config or WorldConfig()
        self._settings = settings or BulletSettings()
        self.gravity = self._settings.gravity
        num_envs = len(drive.ticks)
        if num_envs > MAX_ROBOTS:
            raise SurefootError(f"num_envs is {num_envs}; one process holds up to {MAX_ROBOTS} robots in Bullet")
        self._p = import_pybullet()
        self._clients: list[int] = []
        weakref.finalize(self, _disconnect, self._p, self._clients)
        for _ in range(num_envs):
            client, self.model = open_client(robot, self._config, self._settings)
            self._clients.append(client)
        model = self.model
        self._joints = list(range(model.num_joints))
        self._setups = [self._nominal_setup] * num_envs
        self._floors = [model.ground] * num_envs
        self._play = [0.0] * num_envs
        self._pins = np.zeros((num_envs, len(model.pins.links), 3))
        self._spoilt = np.zeros(num_envs, np.bool_)
        sign = robot.motor_sign.astype(np.float64)
        self._layout = Layout(sign, model.base_quat, model.rack)
        self._from_link = quat_matrix(model.base_quat)
        columns = JOINTS + np.array(model.motors)
        self._motor_columns = np.concatenate([columns, columns + model.num_joints])
        self._feet = {link: leg for leg, link in enumerate(model.feet)}
        self._applied = np.zeros((num_envs, len(sign)))
        self._seen = np.zeros((num_envs, JOINTS + 3 * len(sign)))
        self.diverged = np.zeros(num_envs, np.bool_)
        self._force = np.zeros((num_envs, 3))
        self._rows = np.zeros((num_envs, JOINTS + 2 * model.num_joints))
        for i in range(num_envs):
            self._rows[i] = self._read(i, self._joints)[: self._rows.shape[1]]
        self.initial_state = self._resting_state()

    def _resting_state(self) -> Array:
        """Return the resting pose, loops closed by the knees, lowest foot on the ground unless on a rack."""
        model = self.model
        row = np.zeros(self._rows.shape[1])
        for name, angle in self.robot.resting_joint_angles.items():
            row[JOINTS + model.joints[name]] = angle
        row[:3] = [*model.base_centre[:2], RACK_HEIGHT + model.base_centre[2]]
        row[3:7] = model.base_quat[[1, 2, 3, 0]]
        state = np.concatenate([row, np.zeros(3)])
        if not model.rack:
            before = self.get_state(0)
            self.set_state(0, state)
            state[2] -= float(np.min(self._foot_positions(0)[:, 2] - model.foot_radius))
            self.set_state(0, before)
        return state

    def _read(self, i: int, joints: list[int]) -> list[float]:
        """Read robot `i`'s base, then angles, speeds and motor torques of some of its joints, from Bullet."""
        p, body, client = self._p, self.model.body, self._clients[i]
        position, quat = p.getBasePositionAndOrientation(body, client)
        velocity, omega = p.getBaseVelocity(body, client)
        states = p.getJointStates(body, joints, client)
        angles, speeds, _, torques = zip(*states, strict=True)
        return [*position, *quat, *velocity, *omega, *angles, *speeds, *torques]

    def _write_base(self, i: int) -> None:
        p, body, client, row = self._p, self.model.body, self._clients[i], self._rows[i].tolist()
        p.resetBasePositionAndOrientation(body, row[:3], row[3:7], client)
        p.resetBaseVelocity(body, row[VELOCITY:OMEGA], row[OMEGA:JOINTS], client)

    def advance(self, servo_steps: Index) -> None:
        """Run every robot for its number of servo steps (N,); those that diverge stop and are marked.

        All take a step before any takes the next, so that what is compiled is called once for all of them.
        """
        drive, seen, applied, layout = self.drive, self._seen, self._applied, self._layout
        drive.energy[servo_steps > 0] = 0.0
        drive.contact_ticks[servo_steps > 0] = 0.0
        left = np.where(self.diverged, 0, servo_steps)
        rows = np.flatnonzero(left).tolist()
        constraint = bool(drive.constraint[0])
        between(layout, drive, seen, applied, left, self.diverged, False)
        for i in rows:
            self._look(i)
            if constraint:
                self._set_constraint_motors(i)
        turned = np.asarray(drive.friction.any(axis=1) | drive.viscous.any(axis=1) | (not constraint))
        pushed = np.asarray(self._force.any(axis=1))
        while going := np.flatnonzero(left).tolist():
            torques = applied.tolist()
            for i in going:
                self._step(i, torques[i] if turned[i] else None, pushed[i])
            between(layout, drive, seen, applied, left, self.diverged, True)
        for i in rows:
            self._end(i)

    def _step(self, i: int, torques: list[float] | None, pushed: np.bool_) -> None:
        """Step robot `i`, with joint torques and the force on its base if there are any."""
        p, model, client = self._p, self.model, self._clients[i]
        body, motors, seen = model.body, model.motors, self._seen[i]
        if torques is not None:
            p.setJointMotorControlArray(body, motors, p.TORQUE_CONTROL, forces=torques, physicsClientId=client)
        if pushed:  # Bullet forgets a force after a step, and when torques are set
            p.applyExternalForce(body, -1, self._force[i].tolist(), seen[:3].tolist(), p.WORLD_FRAME, client)
        p.stepSimulation(client)
        if self._play[i]:
            move_pins(p, client, model, self._play[i], self._pins[i])
        seen[:] = self._read(i, motors)
        points = p.getContactPoints(body, self._floors[i], physicsClientId=client)
        for leg in {self._feet[point[3]] for point in points if point[9] > 0.0 and point[3] in self._feet}:
            self.drive.contact_ticks[i, leg] += 1.0

    def _end(self, i: int) -> None:
        """Read robot `i`'s whole state from Bullet, and write it back."""
        row = self._rows[i]
        row[:] = self._read(i, self._joints)[: len(row)]
        # Knees are looked at here only: what is wrong with one shows at its motor, too, a step later.
        self.diverged[i] |= not np.abs(row).max() < SPEED_LIMIT
        self._spoilt[i] = self.diverged[i]
        if not self.diverged[i] and not self.model.rack:
            self._write_base(i)

    def _look(self, i: int) -> Array:
        """Return the base, angles and speeds that `observe` takes, from robot `i`'s row."""
        row, motors = self._rows[i], self.model.motors
        seen: Array = self._seen[i]
        seen[:JOINTS] = row[:JOINTS]
        seen[JOINTS : JOINTS + 2 * len(motors)] = row[self._motor_columns]
        return seen

    def _set_constraint_motors(self, i: int) -> None:
        """Give Bullet's joint motors their targets, gains and limits, which they keep until they get others.

        At the end of a step they turn at k (q_target - q) / dt; for k = k_p dt / (k_p dt + k_d) that is
        `actuator.constraint_speed`.
        """
        p, drive, motors = self._p, self.drive, self.model.motors
        kp, kd, dt = drive.kp[i], drive.kd[i], drive.limits[3]
        p.setJointMotorControlArray(
            self.model.body,
            motors,
            p.POSITION_CONTROL,
            targetPositions=(self._layout.sign * drive.target[i]).tolist(),
            targetVelocities=[0.0] * len(motors),
            positionGains=[float(kp * dt / (kp * dt + kd)) if kp > 0 else 0.0] * len(motors),
            velocityGains=[1.0] * len(motors),
            forces=drive.torque_limit[i].tolist(),
            physicsClientId=self._clients[i],
        )

    def observe(self, i: int) -> None:
        """Write the state of robot `i` to `drive.now`."""
        observe(self._layout, self.drive, i, self._look(i))

    def get_state(self, i: int) -> Array:
        """Return the whole state of robot `i` in the engine: its row and the force on its base.

        Contacts that Bullet remembers are forgotten here and when the state is set, and pins with play are centred, so
        that both continue alike.
        """
        self._forget(i)
        return np.concatenate([self._rows[i], self._force[i]])

    def set_state(self, i: int, state: Array) -> None:
        """Put robot `i` into a state from `get_state`."""
        if self._spoilt[i]:
            self._replace_client(i)
        p, body, client = self._p, self.model.body, self._clients[i]
        row = self._rows[i]
        row[:], self._force[i] = state[:-3], state[-3:]
        if not self.model.rack:
            self._write_base(i)
        joints = self.model.num_joints
        angles, speeds = row[JOINTS : JOINTS + joints].tolist(), row[JOINTS + joints :].tolist()
        for joint in self._joints:
            p.resetJointState(body, joint, angles[joint], speeds[joint], client)
        self._forget(i)
        self.diverged[i] = False

    def _replace_client(self, i: int) -> None:
        """Replace robot `i`'s client: Bullet's contact search does not recover from positions that are not finite."""
        self._p.disconnect(self._clients[i])
        self._clients[i], model = open_client(self.robot, self._config, self._settings)
        self._spoilt[i], self._floors[i] = False, model.ground
        setup, self._setups[i] = self._setups[i], self._nominal_setup
        self._apply(i, setup)

    def _forget(self, i: int) -> None:
        if self._pins[i].any():
            self._pins[i] = 0.0
            place_pins(self._p, self._clients[i], self.model.pins, self._pins[i])
        # A link that gets its collision filter again is taken out of Bullet's pairs, and put back.
        for link in (-1, *self.model.feet):
            self._p.setCollisionFilterGroupMask(self.model.body, link, 1, -1, self._clients[i])

    def set_base_velocity(self, i: int, linear_world: Array, angular_base: Array) -> None:
        """Set the base's velocity [m/s] in the world and angular velocity [rad/s] in the base frame."""
        if self.model.rack:
            return
        row = self._rows[i]
        turn = xyzw_matrix(row[3:7]) @ self._from_link.T
        omega = turn @ angular_base
        row[OMEGA:JOINTS] = omega
        row[VELOCITY:OMEGA] = linear_world + np.cross(omega, turn @ self.model.base_centre)
        self._write_base(i)

    def set_force(self, i: int, force_world: Array) -> None:
        """Set the force [N] on the base's centre of mass, in the world frame."""
        self._force[i] = force_world

    def raise_base(self, i: int, height: float) -> None:
        """Move the base of robot `i` up by a height [m]."""
        if not self.model.rack:
            self._rows[i, 2] += height
            self._write_base(i)

    def set_params(self, i: int, params: PhysicalParams, row: int) -> None:
        """Apply masses, inertias, knees, floor and the feet's contact of `params[row]` to robot `i`."""
        contact, ratios = (
            [float(getattr(params, name)[row]) for name in names]
            for names in (
                ("contact_friction", "contact_stiffness", "contact_spinning_friction"),
                ("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio"),
            )
        )
        knee_friction, unevenness = float(params.knee_friction[row]), float(params.floor_unevenness[row])
        self._apply(i, _Setup(tuple(contact), tuple(ratios), knee_friction, unevenness))
        self._forget(i)
        self._play[i] = float(params.knee_play[row])

    @property
    def _nominal_setup(self) -> _Setup:
        """What every new client has."""
        contact = self.robot.contact
        return _Setup((contact.friction, contact.stiffness, contact.spinning_friction))

    def _apply(self, i: int, setup: _Setup) -> None:
        p, model, client, now = self._p, self.model, self._clients[i], self._setups[i]
        if now.contact != setup.contact:
            set_foot_contact(p, client, model, *setup.contact)
        if now.ratios != setup.ratios:
            scale_masses(p, client, model, *setup.ratios)
        if now.knee_friction != setup.knee_friction:
            set_knee_friction(p, client, model, setup.knee_friction)
        if now.floor_unevenness != setup.floor_unevenness:
            self._floors[i] = lay_floor(p, client, model, self._floors[i], setup.floor_unevenness)
        self._setups[i] = setup

    def base(self) -> Array:
        """Return the base position [m], quaternion (w x y z) and velocity [m/s], all in the world frame, (N, 10)."""
        if self.model.rack:
            return racked_bases(len(self._clients))
        return base_links(self._rows, self.model.base_quat, self.model.base_centre)

    def foot_positions(self) -> Array:
        """Return the centres of the feet in the world frame [m], (N, L, 3)."""
        return np.array([self._foot_positions(i) for i in range(len(self._clients))])

    def _foot_positions(self, i: int) -> Array:
        states = self._p.getLinkStates(
            self.model.body, self.model.feet, computeForwardKinematics=1, physicsClientId=self._clients[i]
        )
        turns = xyzw_matrix(np.array([state[1] for state in states]))
        places = np.array([state[0] for state in states])
        feet: Array = places + np.einsum("lij,lj->li", turns, self.model.foot_centre)
        return feet


def bullet_engine(robot: RobotDescription, drive: Drive, config: WorldConfig) -> BulletEngine:
    """Return the Bullet engine."""
    return BulletEngine(robot, drive, config)


def published_bullet_engine(robot: RobotDescription, drive: Drive, config: WorldConfig) -> BulletEngine:
    """Return the Bullet engine with the settings of the simulator that was published with the Minitaur."""
    return BulletEngine(robot, drive, config, PUBLISHED)
