"""MuJoCo engine: a batch of robots, stepped by compiled loops on all cores.

Each robot has its own MuJoCo data, so that its motion is identical to the bit in batches of any size. Each thread has
its own MuJoCo model, which stays in the processor's cache: before it steps a robot, it writes the robot's masses and
inertias into the model.
"""

from __future__ import annotations

import copy
import ctypes
import os
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription
from surefoot.rotations import matrix_quat, quat_matrix, rpy_matrix
from surefoot.world.actuation import MASS_RATIOS, ActuationState, bases_on_rack
from surefoot.world.interface import WorldConfig
from surefoot.world.mujoco_loop import DATA_FIELDS, Native, advance, gather_base, observe
from surefoot.world.mujoco_model import body_heights, build_model, foot_geoms, resting_qpos
from surefoot.world.native import function_address, struct_offset

Index = NDArray[np.int64]

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
MIN_ROBOTS_PER_THREAD = 8
"""Minimum number of robots per thread, below which starting a thread takes more time than it saves."""
MASS_FIELDS = (
    *("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0"),
    *("dof_armature", "body_ipos"),
)
"""Arrays of a MuJoCo model that depend on masses and inertias, including results of `mj_setConst`."""


def _masses(model: mujoco.MjModel) -> Array:
    """Return the concatenated `MASS_FIELDS` of a model, as `_load_masses` writes them."""
    return np.concatenate([getattr(model, field).ravel() for field in MASS_FIELDS])


class MujocoEngine:
    """MuJoCo as an `Engine`, with `config.threads` threads.

    Args:
        robot: the robot.
        actuation: shared state of servos, motors and sensors.
        config: configuration of the world.
    """

    gravity = GRAVITY

    def __init__(self, robot: RobotDescription, actuation: ActuationState, config: WorldConfig) -> None:
        self.robot, self.actuation = robot, actuation
        # Turn off the timers of MuJoCo's stages, which take some 3 % of a step and are not used.
        mujoco.set_mjcb_time(None)
        # The engine reports divergence itself. A C function without effect keeps MuJoCo from writing a log file.
        mujoco.set_mju_user_warning(ctypes.CDLL(None).strlen)
        num_envs, self._ground = len(actuation.ticks), config.ground
        self._nominal = self._build(robot, config)
        self._scratch_model = copy.copy(self._nominal)
        self._scratch = mujoco.MjData(self._scratch_model)
        self.threads = min(config.threads or os.cpu_count() or 1, -(-num_envs // MIN_ROBOTS_PER_THREAD))
        self.models = [copy.copy(self._nominal) for _ in range(self.threads)]
        self.datas = [mujoco.MjData(self._nominal) for _ in range(num_envs)]
        self._base = self._nominal.body(robot.base).id
        still = robot.urdf.fixed_to(robot.base)
        bodies = range(1, self._nominal.nbody)
        self._legs = np.array([body for body in bodies if self._nominal.body(body).name not in still])
        self._feet = foot_geoms(robot, self._nominal)
        self._native = self._layout()
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        self.diverged = np.zeros(num_envs, np.bool_)
        nominal = [np.ones(len(MASS_RATIOS)), self._nominal.dof_armature[self._native.motor_dof], np.zeros(3)]
        self._mass_params = np.tile(np.concatenate(nominal), (num_envs, 1))
        self.initial_state = self._resting_state()

    def _build(self, robot: RobotDescription, config: WorldConfig) -> mujoco.MjModel:
        return build_model(robot, config)

    def _layout(self) -> Native:
        model, robot, num_envs = self._nominal, self.robot, len(self.datas)
        heights, cell = body_heights(self._ground)
        joints = [model.joint(name) for name in robot.motor_names]
        free = model.body(robot.base).jntadr[0] if model.body(robot.base).jntnum[0] else -1
        motor_dof = np.array([joint.dofadr[0] for joint in joints], np.int64)
        addresses: dict[str, Any] = {
            field: np.array([getattr(data, field).ctypes.data for data in self.datas], np.int64)
            for field in DATA_FIELDS
        }
        return Native(
            step1=function_address("mj_step1"),
            step2=function_address("mj_step2"),
            model=np.array([item._address for item in self.models], np.int64),
            mass_fields=np.array(
                [[getattr(item, field).ctypes.data for field in MASS_FIELDS] for item in self.models], np.int64
            ),
            mass_sizes=np.array([getattr(model, field).size for field in MASS_FIELDS], np.int64),
            mass=np.tile(_masses(model), (num_envs, 1)),
            data=np.array([item._address for item in self.datas], np.int64),
            **addresses,
            motor_qpos=np.array([joint.qposadr[0] for joint in joints], np.int64),
            motor_dof=motor_dof,
            motor_sign=robot.motor_sign.astype(np.float64),
            **self._motor_rows(motor_dof),
            base_qpos=int(model.jnt_qposadr[free]) if free >= 0 else -1,
            base_dof=int(model.jnt_dofadr[free]) if free >= 0 else -1,
            base_body=int(self._base),
            foot_geom=self._feet,
            foot_body=model.geom_bodyid[self._feet].astype(np.int64),
            foot_radius=model.geom_size[self._feet, 0].copy(),
            ground=self._ground.corners,
            ground_grid=self._ground.grid,
            patches=self._ground.friction,
            patch_grid=self._ground.patch_grid,
            body_points=heights.astype(np.float32),
            body_grid=np.array([*self._ground.grid[:2], cell]),
            **self._shapes(),
            friction=np.full(num_envs, robot.contact.friction),
            stiffness=np.full(num_envs, robot.contact.stiffness),
            shear=np.full(num_envs, robot.contact.stiffness),
            spinning=np.full(num_envs, robot.contact.spinning_friction),
            damping=robot.contact.damping,
            stretch=np.zeros((num_envs, len(self._feet), 2, 3)),
            num_qpos=model.nq,
            num_qvel=model.nv,
            step=model.opt.timestep,
        )

    def _shapes(self) -> dict[str, Any]:
        """Return the fields of `Native` for shapes that touch the ground by MuJoCo's contacts."""
        model, kinds = self._nominal, mujoco.mjtGeom
        shapes = np.flatnonzero(model.geom_conaffinity & 1).astype(np.int64)
        bodies = model.geom_bodyid[shapes].astype(np.int64)
        order = np.argsort(bodies, kind="stable")
        shapes, bodies = shapes[order], bodies[order]
        axes, counts, boxes, parts, halves = [], [], [], [], []
        for shape in shapes:
            kind, size, axis = kinds(int(model.geom_type[shape])), model.geom_size[shape], 2
            length, radius = 0.0, model.geom_rbound[shape]
            half = np.full(3, radius)
            if kind == kinds.mjGEOM_BOX:
                axis, half = int(np.argmax(size)), size.copy()
                length, radius = size[axis], np.linalg.norm(np.delete(size, axis))
            elif kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
                radius, length, _ = size
                length += radius if kind == kinds.mjGEOM_CAPSULE else 0.0
                half = np.array([radius, radius, length])
            # Divide slender shapes into parts, so that bounding spheres of the parts are tight.
            count = int(np.clip(np.ceil(length / (1.5 * radius)), 1, 8))
            half[axis] /= count
            axes.append(axis)
            counts.append(count)
            boxes.append(kind == kinds.mjGEOM_BOX)
            parts.append([2 * length / count, radius, model.geom_rbound[shape]])
            halves.append(half)
        others = [model.geom_conaffinity[model.geom_bodyid == body] & ~1 for body in bodies]
        return {
            "shape_geom": shapes,
            "shape_body": bodies,
            "shape_axis": np.array(axes, np.int64),
            "shape_count": np.array(counts, np.int64),
            "shape_is_box": np.array(boxes, np.bool_),
            "shape_part": np.array(parts).reshape(-1, 3),
            "shape_half": np.array(halves).reshape(-1, 3),
            "clearance": np.zeros((len(self.datas), len(shapes))),
            "geom_conaffinity": np.array([one.geom_conaffinity.ctypes.data for one in self.models], np.int64),
            "body_conaffinity": np.array([one.body_conaffinity.ctypes.data for one in self.models], np.int64),
            "body_bits": np.array([np.bitwise_or.reduce(bits) for bits in others], np.int64),
            "moved": np.ones(len(self.datas), np.bool_),
        }

    def _motor_rows(self, motor_dof: Index) -> dict[str, Any]:
        """Return the solver rows of constraint motors; rows of joint friction follow the rows of closed loops."""
        model, data = self._nominal, self._scratch
        friction_dofs = np.flatnonzero(model.dof_frictionloss > 0)
        if not len(friction_dofs):
            return {"motor_row": motor_dof, "aref": 0, "frictionloss": 0, "force_row": 0}
        mujoco.mj_step1(model, data)
        arrays = {"aref": data.efc_aref, "frictionloss": data.efc_frictionloss, "force_row": data.efc_force}
        places = {name: struct_offset(data._address, array.ctypes.data) for name, array in arrays.items()}
        return {"motor_row": data.ne + np.searchsorted(friction_dofs, motor_dof), **places}

    def _resting_state(self) -> Array:
        mujoco.mj_resetData(self._nominal, self._scratch)
        self._scratch.qpos[:] = resting_qpos(self.robot, self._nominal, self._ground)
        return self._read(self._scratch, np.zeros_like(self._native.stretch[0]))

    def _read(self, data: mujoco.MjData, stretch: Array) -> Array:
        state = np.empty(mujoco.mj_stateSize(self._nominal, _STATE))
        mujoco.mj_getState(self._nominal, data, state, _STATE)
        return np.concatenate([state, stretch.ravel()])

    def advance(self, servo_steps: Index) -> None:
        """Run each robot for its number of servo steps (N,). Robots that diverge stop and are marked."""
        counter = np.zeros(1, np.int64)
        work = partial(advance, self._native, self.actuation, servo_steps, self.diverged)
        if self._pool is None:
            work(0, counter)
            return
        try:
            others = [self._pool.submit(work, worker, counter) for worker in range(1, self.threads)]
            work(0, counter)
            wait(others)
        except BaseException:
            # An interrupt must not leave threads running, because they use memory of this engine.
            self._pool.shutdown()
            self._pool = ThreadPoolExecutor(self.threads - 1)
            raise
        for other in others:
            other.result()

    def observe(self, rows: Index) -> None:
        """Write the current motor and IMU states of robots to `actuation.sample`."""
        for i in rows:
            observe(self._native, self.actuation, i)

    def get_state(self, rows: Index) -> Array:
        """Return the complete states (n, size) in the engine."""
        return np.array([self._read(self.datas[i], self._native.stretch[i]) for i in rows])

    def set_state(self, rows: Index, states: Array) -> None:
        """Set robots to states from `get_state` (n, size), or all to one state (size,)."""
        stretch = self._native.stretch
        size = stretch[0].size
        states = np.broadcast_to(states, (len(rows), states.shape[-1]))
        for i, state in zip(rows, states, strict=True):
            mujoco.mj_setState(self._nominal, self.datas[i], state[:-size], _STATE)
        self._native.moved[rows] = True
        stretch[rows] = states[:, -size:].reshape(-1, *stretch.shape[1:])
        self.diverged[rows] = False

    def set_motors(self, rows: Index, angles: Array, speeds: Array) -> None:
        """Set true motor angles [rad] and speeds [rad/s] (n, M) of robots without closed loops."""
        native = self._native
        for i, angle, speed in zip(rows, native.motor_sign * angles, native.motor_sign * speeds, strict=True):
            self.datas[i].qpos[native.motor_qpos] = angle
            self.datas[i].qvel[native.motor_dof] = speed
        native.moved[rows] = True

    def rotate(self, rows: Index, angles: Array) -> None:
        """Rotate robots by angles (n,) [rad] about the vertical axis through the world's origin."""
        native = self._native
        if native.base_qpos < 0:
            return
        for i, angle in zip(rows, angles, strict=True):
            data, turn = self.datas[i], rpy_matrix(0.0, 0.0, angle)
            pose, velocity = data.qpos[native.base_qpos :][:7], data.qvel[native.base_dof :][:3]
            pose[:3], velocity[:] = turn @ pose[:3], turn @ velocity
            pose[3:] = matrix_quat(turn @ quat_matrix(pose[3:]))
            native.stretch[i] = native.stretch[i] @ turn.T
        native.moved[rows] = True

    def move_base(self, rows: Index, offset_world: Array) -> None:
        """Translate bases by offsets (n, 3) [m] in the world frame."""
        if self._native.base_qpos >= 0:
            for i, offset in zip(rows, offset_world, strict=True):
                self.datas[i].qpos[self._native.base_qpos :][:3] += offset
            self._native.moved[rows] = True

    def set_base_velocity(self, rows: Index, linear_world: Array, angular_base: Array) -> None:
        """Set base velocities (n, 3) [m/s] in the world and angular velocities (n, 3) [rad/s] in the base frames."""
        if self._native.base_dof < 0:
            return
        for i, velocity in zip(rows, np.concatenate([linear_world, angular_base], axis=1), strict=True):
            self.datas[i].qvel[self._native.base_dof :][:6] = velocity

    def set_force(self, force_world: Array) -> None:
        """Set the forces (N, 3) [N] on the bases' centres of mass, in the world frame."""
        for data, force in zip(self.datas, force_world, strict=True):
            data.xfrc_applied[self._base, :3] = force

    def set_params(self, rows: Index, params: PhysicalParams) -> None:
        """Apply masses, inertias and foot contact, one row per robot."""
        native = self._native
        native.friction[rows] = params.contact_friction
        native.stiffness[rows] = params.contact_stiffness
        native.shear[rows] = params.contact_stiffness * params.contact_shear_ratio
        native.spinning[rows] = params.contact_spinning_friction
        ratios = np.stack([getattr(params, name) for name in MASS_RATIOS], axis=1)
        mass_params = np.concatenate([ratios, params.rotor_inertia, params.base_offset], axis=1)
        for k in np.flatnonzero((self._mass_params[rows] != mass_params).any(axis=1)):
            native.mass[rows[k]] = self._scaled_masses(ratios[k], params.rotor_inertia[k], params.base_offset[k])
        self._mass_params[rows] = mass_params

    def _scaled_masses(self, ratios: Array, rotors: Array, offset: Array) -> Array:
        """Return the result of `_masses` for other parameters.

        Args:
            ratios: ratios of masses and inertias, in the order of `MASS_RATIOS`.
            rotors: inertias of rotors (M,) [kg m2].
            offset: offset of the base's centre of mass (3,) [m].
        """
        base_mass, leg_mass, base_inertia, leg_inertia = ratios
        nominal, model, base, legs = self._nominal, self._scratch_model, self._base, self._legs
        model.body_mass[base] = nominal.body_mass[base] * base_mass
        model.body_mass[legs] = nominal.body_mass[legs] * leg_mass
        model.body_inertia[base] = nominal.body_inertia[base] * base_inertia
        model.body_inertia[legs] = nominal.body_inertia[legs] * leg_inertia
        model.dof_armature[self._native.motor_dof] = rotors
        model.body_ipos[base] = nominal.body_ipos[base] + offset
        # Recompute derived quantities with a scratch state, to keep the states of robots.
        mujoco.mj_setConst(model, self._scratch)
        return _masses(model)

    def base(self) -> Array:
        """Return base position [m], quaternion (w x y z) and velocity [m/s] in the world frame (N, 10)."""
        if self._native.base_qpos < 0:
            return bases_on_rack(len(self.datas))
        rows = np.empty((len(self.datas), 10))
        gather_base(self._native, rows)
        return rows

    def foot_positions(self) -> Array:
        """Return the foot centres in the world frame (N, L, 3) [m]."""
        # MuJoCo's positions are from the start of the last step, or from before a reset.
        for data in self.datas:
            mujoco.mj_kinematics(self._nominal, data)
        return np.array([data.geom_xpos[self._feet] for data in self.datas])
