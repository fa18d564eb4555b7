"""Foot forces of a standing robot from motor torques and motion, without a model of the ground (inverse dynamics).

In a robot with closed legs, the base velocity v (6) and the motor speeds w (M) determine the speeds u of all joints:
u = T (v, w). Multiplying the equation of motion M du/dt + c = tau + sum of J_foot' F by T' removes the loop forces:

    A d(v, w)/dt + b = (0, tau) + sum over feet of J' F,    A = T' M T,    b = T' (c + M dT/dt (v, w))

A leg with two motors moves in a plane (x forward and z up in the base frame). Its two motor equations give both force
components in that plane for a known acceleration of the base. The base equations give this acceleration and a residual
moment about y. Forces normal to the planes of the legs do no work on the motors: they are not observed, and do not
rotate the base about y.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from surefoot.arrays import Array
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.rotations import rpy_quat
from surefoot.world.mujoco_model import build_model, foot_geoms

_STEP = 1e-6


@dataclass(frozen=True)
class Motion:
    """Motion of a standing robot at T times, without delay. Velocities of the base are in the base frame."""

    motor_angle: Array
    """(T, M) [rad]"""
    motor_velocity: Array
    """(T, M) [rad/s]"""
    motor_acceleration: Array
    """(T, M) [rad/s2]"""
    motor_torque: Array
    """Torque at the motor shafts, with friction subtracted (T, M) [N m]."""
    roll_pitch: Array
    """(T, 2) [rad]"""
    angular_velocity: Array
    """(T, 3) [rad/s]"""
    angular_acceleration: Array
    """(T, 3) [rad/s2]"""


@dataclass(frozen=True)
class Forces:
    """Ground reaction forces on a robot with L legs, and forces required by its motion, in the base frame."""

    foot: Array
    """Position of each foot's tip relative to the origin of the base (T, L, 2), x and z [m]."""
    force: Array
    """Ground reaction force on each foot (T, L, 2), x and z [N]."""
    required: Array
    """Force along x and z [N] and residual moment about y [N m] required by the motion, without gravity (T, 3)."""
    base_moment: Array
    """Part of `required[:, 2]` that is due to the rotational inertia of the base (T,) [N m]."""


class InverseDynamics:
    """Inverse dynamics of a robot with the masses and inertias of one row of parameters."""

    def __init__(self, robot: RobotDescription, params: PhysicalParams) -> None:
        self.robot = robot
        model = build_model(robot)
        base = model.body(robot.base).id
        base_links = robot.urdf.fixed_to(robot.base)
        legs = [body for body in range(1, model.nbody) if model.body(body).name not in base_links]
        model.body_mass[base] *= params.base_mass_ratio[0]
        model.body_mass[legs] *= params.leg_mass_ratio[0]
        model.body_inertia[base] *= params.base_inertia_ratio[0]
        model.body_inertia[legs] *= params.leg_inertia_ratio[0]
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_setConst(model, self.data)
        self.base, self.mass = base, float(model.body_subtreemass[base])
        quat = np.zeros(9)
        mujoco.mju_quat2Mat(quat, model.body_iquat[base])
        rotation = quat.reshape(3, 3)
        self.base_inertia = rotation @ np.diag(model.body_inertia[base]) @ rotation.T
        """Inertia of the base about its centre of mass, in the base frame (3, 3) [kg m2]."""
        self.base_mass = float(model.body_mass[base])
        """Mass of the base and all links fixed to it [kg]."""
        self._feet = foot_geoms(robot, model)
        self._motor = np.array([model.joint(name).dofadr[0] for name in robot.motor_names])
        self._motor_q = np.array([model.joint(name).qposadr[0] for name in robot.motor_names])
        self._knee = np.array([[model.joint(name).dofadr[0] for name in leg.knees] for leg in robot.legs])
        self._knee_q = np.array([[model.joint(name).qposadr[0] for name in leg.knees] for leg in robot.legs])
        self._pairs = robot.leg_motor_index

    def _knees(self, angles: Array) -> Array:
        """Return knee angles (T, L, 2) [rad] at motor angles (T, M)."""
        return self.robot.leg_geometry.knee_angles(angles[:, self._pairs])

    def _knee_rates(self, angles: Array) -> Array:
        """Return the derivatives of knee angles with respect to the leg's motor angles (T, L, 2 knees, 2 motors)."""
        rates = np.empty((*angles.shape[:1], len(self._pairs), 2, 2))
        for which in range(2):
            moved = np.zeros(angles.shape[1])
            moved[self._pairs[:, which]] = _STEP
            rates[..., which] = (self._knees(angles + moved) - self._knees(angles - moved)) / (2 * _STEP)
        return rates

    def forces(self, motion: Motion) -> Forces:
        """Return the foot forces at all times of a motion."""
        angles, speeds = motion.motor_angle, motion.motor_velocity
        knees, rates = self._knees(angles), self._knee_rates(angles)
        # dT/dt (v, w): accelerations of the knees at constant motor speeds.
        ahead, behind = (self._knee_rates(angles + side * _STEP * 10 * speeds) for side in (1.0, -1.0))
        bias_acceleration = np.einsum("tlkm,tlm->tlk", (ahead - behind) / (20 * _STEP), speeds[:, self._pairs])
        # T has six columns of the base, then motors. MuJoCo's base velocity is linear in the world frame and angular in
        # the base frame.
        count, motors, legs, nv = *angles.shape, len(self._pairs), self.model.nv
        transform = np.zeros((count, nv, 6 + motors))
        transform[:, range(6), range(6)] = 1.0
        transform[:, self._motor, 6 + np.arange(motors)] = self.robot.motor_sign
        for leg, pair in enumerate(self._pairs):
            transform[:, self._knee[leg][:, None], 6 + pair] = rates[:, leg]
        change = np.zeros((count, nv))
        change[:, self._knee] = bias_acceleration
        reduce = transform.transpose(0, 2, 1)
        speed = np.concatenate([np.zeros((count, 3)), motion.angular_velocity, speeds], axis=1)
        velocity = _apply(transform, speed)
        terms = [self._terms(*at) for at in zip(motion.roll_pitch, angles, knees, velocity, strict=True)]
        inertia, bias, weight, jacobians, rotation, feet = map(np.array, zip(*terms, strict=True))
        reduced, jacobians = reduce @ inertia @ transform, jacobians @ transform[:, None]
        bias_forces = _apply(reduce, bias + _apply(inertia, change))
        # Axes of the plane of the legs in the world frame: forward and up of the base.
        plane = rotation[:, :, [0, 2]]
        to_plane = plane.transpose(0, 2, 1)
        measured = np.concatenate([motion.angular_acceleration, motion.motor_acceleration], axis=1)
        known_forces = _apply(reduced[:, :, 3:], measured) + bias_forces
        # Unknowns: acceleration of the base's origin in the plane (2), and two force components per leg.
        # Maps from foot forces in the plane to generalized forces (T, L, 6 + M, 2).
        force_maps = jacobians.transpose(0, 1, 3, 2) @ plane[:, None]
        matrix = np.zeros((count, 2 + motors, 2 + 2 * legs))
        matrix[:, :2, :2] = to_plane @ reduced[:, :3, :3] @ plane
        matrix[:, 2:, :2] = reduced[:, 6:, :3] @ plane
        for leg in range(legs):
            matrix[:, :2, 2 + 2 * leg : 4 + 2 * leg] = -(to_plane @ force_maps[:, leg, :3])
            matrix[:, 2:, 2 + 2 * leg : 4 + 2 * leg] = -force_maps[:, leg, 6:]
        motors_balance = known_forces[:, 6:] - motion.motor_torque
        constants = np.concatenate([_apply(to_plane, known_forces[:, :3]), motors_balance], axis=1)
        solution = np.linalg.solve(matrix, -constants[..., None])[..., 0]
        forces = solution[:, 2:].reshape(count, legs, 2)
        total = known_forces + _apply(reduced[:, :, :3], _apply(plane, solution[:, :2]))
        foot_moment = np.einsum("tlk,tlk->t", force_maps[:, :, 4], forces)
        # The residual moment about y shows errors of the base's inertia.
        linear = _apply(to_plane, total[:, :3] - _apply(reduce, weight)[:, :3])
        required = np.concatenate([linear, (total[:, 4] - foot_moment)[:, None]], axis=1)
        rate, base_inertia = motion.angular_velocity, self.base_inertia
        base_moment = motion.angular_acceleration @ base_inertia.T + np.cross(rate, rate @ base_inertia.T)
        return Forces(feet, forces, required, base_moment[:, 1])

    def _terms(self, roll_pitch: Array, angles: Array, knees: Array, velocity: Array) -> tuple[Array, ...]:
        """Return the terms of MuJoCo's equation of motion at one time.

        Mass matrix (nv, nv), bias force (nv,), weight (nv,), Jacobians of the lowest points of the feet (L, 3, nv),
        rotation matrix of the base (3, 3), and positions of the foot tips relative to the base's origin (L, 2).
        """
        model, data = self.model, self.data
        data.qpos[:3] = 0.0
        data.qpos[3:7] = rpy_quat(roll_pitch[0], roll_pitch[1], 0.0)
        data.qpos[self._motor_q] = self.robot.motor_sign * angles
        data.qpos[self._knee_q] = knees
        data.qvel[:] = velocity
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_crb(model, data)
        mujoco.mj_comVel(model, data)
        inertia, bias, weight = np.zeros((model.nv, model.nv)), np.zeros(model.nv), np.zeros(model.nv)
        mujoco.mj_fullM(model, data, inertia)
        mujoco.mj_rne(model, data, 0, bias)
        jacobians = np.zeros((len(self._feet), 3, model.nv))
        for geom, jacobian in zip(self._feet, jacobians, strict=True):
            # The ground acts on the lowest point of the rounded foot.
            point = data.geom_xpos[geom] - [0.0, 0.0, model.geom_size[geom, 0]]
            mujoco.mj_jac(model, data, jacobian, None, point, int(model.geom_bodyid[geom]))
        rotation = data.xmat[self.base].reshape(3, 3).copy()
        feet = ((data.geom_xpos[self._feet] - data.xpos[self.base]) @ rotation)[:, [0, 2]]
        data.qvel[:] = 0.0
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 0, weight)
        return inertia, bias, weight, jacobians, rotation, feet - [0.0, self.robot.five_bar.foot_radius]


def _apply(matrices: Array, vectors: Array) -> Array:
    """Return the products (T, N) of matrices (T, N, M) and vectors (T, M)."""
    return (matrices @ vectors[..., None])[..., 0]
