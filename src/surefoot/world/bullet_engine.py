"""Bullet engine: a batch of robots, each in its own physics client.

Servos, motors, delays and sensors use the same compiled functions as in every other world. Bullet simulates only
bodies, closed loops and contacts. Feet touch the ground by Bullet's own contact with the stiffness and damping of the
data sheet, which its solver integrates implicitly: force = K d + B d' at the end of the step, not at its start.
Bullet's friction is rigid along the ground. If `contact_shear_ratio` is not 1, the spring-slider of `contact` replaces
it, with the normal force of the previous step.

A robot's state is one row of numbers in Bullet's own frames, in which the base frame is at the base's centre of mass,
along its principal axes. After every control step, the row is written back to Bullet, because Bullet's quaternion of
the base would differ from it in the last bit. Hence a saved and restored state continues exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.self_collision import collision_pairs
from surefoot.rotations import matrix_quat, quat_matrix, rpy_matrix, xyzw_matrix
from surefoot.world.actuation import RACK_HEIGHT, SPEED_LIMIT, ActuationState, bases_on_rack
from surefoot.world.bullet_kernels import JOINTS, OMEGA, VELOCITY, Layout, base_links, observe, substep
from surefoot.world.bullet_model import CLIENT_PARAMETERS, PUBLISHED, BulletModel, BulletSettings, import_pybullet
from surefoot.world.interface import WorldConfig

Index = NDArray[np.int64]


class BulletEngine:
    """Bullet as an `Engine`, which steps one robot after another.

    Args:
        robot: the robot.
        actuation: shared state of servos, motors and sensors.
        config: configuration of the world.
        published: whether to use the settings of the simulator that was published with the paper's robot.

    Raises:
        SurefootError: a robot whose masses Bullet reads differently, or more robots than Bullet can hold.
    """

    def __init__(
        self,
        robot: RobotDescription,
        actuation: ActuationState,
        config: WorldConfig,
        published: bool = False,
    ) -> None:
        settings = PUBLISHED if published else BulletSettings()
        if settings.feet != "sphere" and not config.ground.is_flat:
            raise SurefootError("world bullet-published has boxes for feet and no terrain; use world bullet")
        self.robot, self.actuation, self._config, self._settings = robot, actuation, config, settings
        self.gravity = settings.gravity
        num_envs = len(actuation.ticks)
        self._p = import_pybullet()
        self._collision_pairs = collision_pairs(robot)
        self.models = [BulletModel(robot, config, settings, self._collision_pairs) for _ in range(num_envs)]
        model = self.models[0]
        self._joints = list(model.joints.values())
        joints = len(self._joints)
        self._invalid = np.zeros(num_envs, np.bool_)
        sign = robot.motor_sign.astype(np.float64)
        self._layout = Layout(sign, model.base_quat, model.rack)
        self._from_link = quat_matrix(model.base_quat)
        columns = JOINTS + np.array([self._joints.index(motor) for motor in model.motors])
        self._motor_columns = np.concatenate([columns, columns + joints])
        self._feet = {link: leg for leg, link in enumerate(model.feet)}
        self._applied = np.zeros((num_envs, len(sign)))
        self._measured = np.zeros((num_envs, JOINTS + 3 * len(sign)))
        self.diverged = np.zeros(num_envs, np.bool_)
        self._force = np.zeros((num_envs, 3))
        self._rows = np.zeros((num_envs, JOINTS + 2 * joints))
        for i in range(num_envs):
            self._rows[i] = self._read(i, self._joints)[: self._rows.shape[1]]
        self.initial_state = self._resting_state()

    def _resting_state(self) -> Array:
        """Return the state in the resting pose: loops closed, and the lowest foot on the ground unless on a rack."""
        model = self.models[0]
        row = np.zeros(self._rows.shape[1])
        for name, angle in self.robot.joint_angles(self.robot.resting_angles).items():
            row[JOINTS + self._joints.index(model.joints[name])] = angle
        row[:3] = [*model.base_centre[:2], RACK_HEIGHT + model.base_centre[2]]
        row[3:7] = model.base_quat[[1, 2, 3, 0]]
        state = np.concatenate([row, np.zeros(6)])
        if not model.rack:
            first = np.zeros(1, np.int64)
            before = self.get_state(first)
            self.set_state(first, state)
            feet = model.foot_positions()
            state[2] -= float(np.min(feet[:, 2] - model.foot_radius - self._config.ground.height(feet[:, :2])))
            self.set_state(first, before)
        return state

    def _read(self, i: int, joints: list[int]) -> list[float]:
        """Read from Bullet the base of robot `i`, and the angles, speeds and motor torques of some of its joints."""
        p, body, client = self._p, self.models[i].body, self.models[i].client
        position, quat = p.getBasePositionAndOrientation(body, client)
        velocity, omega = p.getBaseVelocity(body, client)
        states = p.getJointStates(body, joints, client)
        angles, speeds, _, torques = zip(*states, strict=True)
        return [*position, *quat, *velocity, *omega, *angles, *speeds, *torques]

    def _write_base(self, i: int) -> None:
        p, body, client = self._p, self.models[i].body, self.models[i].client
        row = self._rows[i].tolist()
        p.resetBasePositionAndOrientation(body, row[:3], row[3:7], client)
        p.resetBaseVelocity(body, row[VELOCITY:OMEGA], row[OMEGA:JOINTS], client)

    def advance(self, servo_steps: Index) -> None:
        """Run each robot for its number of servo steps (N,). Robots that diverge stop and are marked.

        Robots advance step by step together, so that compiled functions are called once per step for all robots.
        """
        actuation, measured, applied, layout = self.actuation, self._measured, self._applied, self._layout
        actuation.energy[servo_steps > 0] = 0.0
        actuation.heat[servo_steps > 0] = 0.0
        actuation.contact_ticks[servo_steps > 0] = 0.0
        actuation.limit_ticks[servo_steps > 0] = 0.0
        remaining = np.where(self.diverged, 0, servo_steps)
        rows = np.flatnonzero(remaining).tolist()
        constraint = bool(actuation.constraint[0])
        substep(layout, actuation, measured, applied, remaining, self.diverged, False)
        for i in rows:
            self._gather_measured(i)
            if constraint:
                self._set_constraint_motors(i)
        has_torque = np.asarray(actuation.friction.any(axis=1) | actuation.viscous.any(axis=1) | (not constraint))
        has_force = np.asarray(self._force.any(axis=1))
        while active := np.flatnonzero(remaining).tolist():
            torques = applied.tolist()
            for i in active:
                self._step(i, torques[i] if has_torque[i] else None, has_force[i])
            substep(layout, actuation, measured, applied, remaining, self.diverged, True)
        for i in rows:
            self._finish(i)

    def _step(self, i: int, torques: list[float] | None, has_force: np.bool_) -> None:
        """Step robot `i` once, with joint torques and a force on its base if it has them."""
        p, model, measured = self._p, self.models[i], self._measured[i]
        client, body, motors = model.client, model.body, model.motors
        if torques is not None:
            p.setJointMotorControlArray(body, motors, p.TORQUE_CONTROL, forces=torques, physicsClientId=client)
        if has_force:  # Bullet drops a force after each step, and when torques are set
            p.applyExternalForce(body, -1, self._force[i].tolist(), measured[:3].tolist(), p.WORLD_FRAME, client)
        if self._config.ground.friction.size:
            model.update_friction()
        if model.soles:
            model.apply_sole_forces()
        if model.planes:
            model.place_planes()
        p.stepSimulation(client)
        if model.values["knee_play"]:
            model.update_pins()
        measured[:] = self._read(i, motors)
        points = model.contact_points()
        if model.soles:
            model.update_soles(points)
        for leg in {self._feet[point[3]] for point in points if point[9] > 0.0 and point[3] in self._feet}:
            self.actuation.contact_ticks[i, leg] += 1.0

    def _finish(self, i: int) -> None:
        """Read the complete state of robot `i` from Bullet, and write it back."""
        row = self._rows[i]
        row[:] = self._read(i, self._joints)[: len(row)]
        # Passive knees are checked only here: their divergence also reaches their motors one step later.
        self.diverged[i] |= not np.abs(row).max() < SPEED_LIMIT
        self._invalid[i] = self.diverged[i]
        if not self.diverged[i]:
            self._set_rotors(i)
            if not self._config.rack:
                self._write_base(i)

    def _gather_measured(self, i: int) -> Array:
        """Return base, motor angles and motor speeds from the row of robot `i`, as input of `observe`."""
        row, motors = self._rows[i], self.models[i].motors
        measured: Array = self._measured[i]
        measured[:JOINTS] = row[:JOINTS]
        measured[JOINTS : JOINTS + 2 * len(motors)] = row[self._motor_columns]
        return measured

    def _set_constraint_motors(self, i: int) -> None:
        """Set targets, gains and limits of Bullet's joint motors, which persist.

        At the end of a step, the motors turn at k (q_target - q) / dt. With k = k_p dt / (k_p dt + k_d) this equals
        `constraint_speed_kernel`.
        """
        p, actuation, model = self._p, self.actuation, self.models[i]
        motors = model.motors
        dt = actuation.constants[2]
        stiff = actuation.kp[i] * dt
        gains = np.divide(stiff, stiff + actuation.kd[i], out=np.zeros_like(stiff), where=stiff > 0)
        p.setJointMotorControlArray(
            model.body,
            motors,
            p.POSITION_CONTROL,
            targetPositions=(self._layout.sign * (actuation.target[i] - actuation.motor_offset[i])).tolist(),
            targetVelocities=[0.0] * len(motors),
            positionGains=gains.tolist(),
            velocityGains=[1.0] * len(motors),
            forces=actuation.constraint_torque[i].tolist(),
            physicsClientId=model.client,
        )

    def observe(self, rows: Index) -> None:
        """Write the current motor and IMU states of robots to `actuation.sample`."""
        for i in rows:
            observe(self._layout, self.actuation, i, self._gather_measured(i))

    def get_state(self, rows: Index) -> Array:
        """Return the complete states (n, size). As in `set_state`, contacts are cleared and pins centred."""
        for i in rows:
            self.models[i].clear_contacts()
        offsets = np.array([self.models[i].base_offset for i in rows])
        return np.concatenate([self._rows[rows], self._force[rows], offsets], axis=1)

    def set_state(self, rows: Index, states: Array) -> None:
        """Set robots to states from `get_state` (n, size), or all to one state (size,)."""
        for i, state in zip(rows, np.broadcast_to(states, (len(rows), states.shape[-1])), strict=True):
            self._set_robot_state(i, state)

    def _set_robot_state(self, i: int, state: Array) -> None:
        if self._invalid[i]:
            # Bullet's collision detection does not recover from positions that are not finite.
            values, rotors = self.models[i].values, self.models[i].rotor_inertia
            self._renew(i, self.models[i].base_offset)
            self.models[i].apply(values, rotors)
            self._invalid[i] = False
        p, model, row = self._p, self.models[i], self._rows[i]
        row[:], self._force[i] = state[: len(row)], state[len(row) : len(row) + 3]
        # Bullet's base is at its centre of mass.
        if (displacement := model.base_offset - state[len(row) + 3 :]).any() and not model.rack:
            arm = xyzw_matrix(row[3:7]) @ self._from_link.T @ displacement
            row[:3] += arm
            row[VELOCITY:OMEGA] += np.cross(row[OMEGA:JOINTS], arm)
        if not self._config.rack:
            self._write_base(i)
        angles, speeds = np.split(row[JOINTS:], 2)
        for joint, angle, speed in zip(self._joints, angles.tolist(), speeds.tolist(), strict=True):
            p.resetJointState(model.body, joint, angle, speed, model.client)
        self._set_rotors(i)
        model.clear_contacts()
        self.diverged[i] = False

    def _set_rotors(self, i: int) -> None:
        angles, speeds = np.split(self._rows[i, self._motor_columns], 2)
        self.models[i].set_rotors(angles.tolist(), speeds.tolist())

    def _renew(self, i: int, base_offset: Array) -> None:
        """Replace the client of robot `i`, with nominal parameters except for the base's centre of mass."""
        self.models[i].close()
        self.models[i] = BulletModel(self.robot, self._config, self._settings, self._collision_pairs, base_offset)

    def set_motors(self, rows: Index, angles: Array, speeds: Array) -> None:
        """Set true motor angles [rad] and speeds [rad/s] (n, M) of robots without closed loops."""
        sign = self.robot.motor_sign
        states = self.get_state(rows)
        states[:, self._motor_columns] = np.concatenate([sign * angles, sign * speeds], axis=1)
        self.set_state(rows, states)

    def set_base_velocity(self, rows: Index, linear_world: Array, angular_base: Array) -> None:
        """Set base velocities (n, 3) [m/s] in the world and angular velocities (n, 3) [rad/s] in the base frames."""
        if self._config.rack:
            return
        for i, linear, angular in zip(rows, linear_world, angular_base, strict=True):
            row = self._rows[i]
            turn = xyzw_matrix(row[3:7]) @ self._from_link.T
            omega = turn @ angular
            row[OMEGA:JOINTS] = omega
            row[VELOCITY:OMEGA] = linear + np.cross(omega, turn @ self.models[i].base_centre)
            self._write_base(i)

    def set_force(self, force_world: Array) -> None:
        """Set the forces (N, 3) [N] on the bases' centres of mass, in the world frame."""
        self._force[:] = force_world

    def rotate(self, rows: Index, angles: Array) -> None:
        """Rotate robots by angles (n,) [rad] about the vertical axis through the world's origin."""
        if self._config.rack:
            return
        for i, angle in zip(rows, angles, strict=True):
            row, turn = self._rows[i], rpy_matrix(0.0, 0.0, angle)
            for part in (slice(3), slice(VELOCITY, OMEGA), slice(OMEGA, JOINTS)):
                row[part] = turn @ row[part]
            row[3:7] = matrix_quat(turn @ xyzw_matrix(row[3:7]))[[1, 2, 3, 0]]
            self._write_base(i)

    def move_base(self, rows: Index, offset_world: Array) -> None:
        """Translate bases by offsets (n, 3) [m] in the world frame."""
        if not self._config.rack:
            self._rows[rows, :3] += offset_world
            for i in rows:
                self._write_base(i)

    def set_params(self, rows: Index, params: PhysicalParams) -> None:
        """Apply masses, inertias, knees, floor and foot contact, one row per robot."""
        for k, i in enumerate(rows):
            if not np.array_equal(params.base_offset[k], self.models[i].base_offset):
                state = self.get_state(rows[k : k + 1])
                self._renew(i, params.base_offset[k])
                self.set_state(rows[k : k + 1], state)
            values = {name: float(getattr(params, name)[k]) for name in CLIENT_PARAMETERS}
            self.models[i].apply(values, params.rotor_inertia[k])
            self.models[i].clear_contacts()

    def base(self) -> Array:
        """Return base position [m], quaternion (w x y z) and velocity [m/s] in the world frame (N, 10)."""
        if self._config.rack:
            return bases_on_rack(len(self.models))
        centres = np.array([model.base_centre for model in self.models])
        return base_links(self._rows, self.models[0].base_quat, centres)

    def foot_positions(self) -> Array:
        """Return the foot centres in the world frame (N, L, 3) [m]."""
        return np.array([model.foot_positions() for model in self.models])
