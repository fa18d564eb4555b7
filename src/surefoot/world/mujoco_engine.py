"""A batch of robots in MuJoCo, stepped by compiled loops on all cores.

Each robot owns its MuJoCo data, so that a robot's motion depends on nothing but itself: alone or in a batch it is the
same to the last bit. Models are owned by threads: before a thread steps a robot, it writes that robot's masses and
inertias into its model, which so stays in the processor's cache whatever the robots weigh.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.contact import foot_force_kernel
from surefoot.world.drive import Drive, constraint_tick, record, roll_pitch_yaw, servo_tick
from surefoot.world.interface import WorldConfig
from surefoot.world.mujoco_model import RACK_HEIGHT, build_model, foot_geoms, resting_qpos
from surefoot.world.native import call_step, doubles, function_address, pointers, struct_offset

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_CHUNK = 8
"""Robots a thread takes at a time: few enough that robots with long control steps do not leave a core idle."""
_MASS_FIELDS = ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0")
"""Arrays of a MuJoCo model that depend on masses and inertias, `mj_setConst`'s results included."""
_SPEED_LIMIT = 1e5
"""A generalized speed beyond this [m/s, rad/s] counts as diverged, before MuJoCo itself would complain."""


class _Native(NamedTuple):
    """Addresses and layout that the compiled loop works on."""

    step1: int
    step2: int
    model: Index
    mass_fields: Index
    mass_sizes: Index
    mass: Array
    data: Index
    qpos: Index
    qvel: Index
    applied: Index
    force: Index
    geom_xpos: Index
    body_xipos: Index
    body_cvel: Index
    subtree_com: Index
    motor_qpos: Index
    motor_dof: Index
    motor_sign: Array
    motor_row: Index  # of the solver's rows, where motors are constraints
    aref: int  # places in MuJoCo's data of pointers to arrays of the solver's rows
    frictionloss: int
    force_row: int
    base_qpos: int
    base_dof: int
    base_body: int
    foot_geom: Index
    foot_body: Index
    foot_radius: Array
    friction: Array
    stretch: Array
    contact: Array
    num_qpos: int
    num_qvel: int


@njit(cache=True, forceinline=True)
def _load_masses(native: _Native, worker: int, i: int) -> None:
    """Give the model of a thread the masses and inertias of robot `i`."""
    at = 0
    for field in range(len(native.mass_sizes)):
        values = doubles(native.mass_fields[worker, field])
        for k in range(native.mass_sizes[field]):
            values[k] = native.mass[i, at + k]
        at += native.mass_sizes[field]


@njit(cache=True, forceinline=True)
def _observe(native: _Native, drive: Drive, i: int) -> bool:
    """Write robot `i`'s state to `drive.now`; false, and nothing written, if it is not finite."""
    qpos, qvel = doubles(native.qpos[i]), doubles(native.qvel[i])
    for k in range(native.num_qvel):
        if not abs(qvel[k]) < _SPEED_LIMIT:
            return False
    for k in range(native.num_qpos):
        if not np.isfinite(qpos[k]):
            return False
    now, motors = drive.now[i], len(native.motor_qpos)
    for m in range(motors):
        now[m] = native.motor_sign[m] * qpos[native.motor_qpos[m]]
        now[motors + m] = native.motor_sign[m] * qvel[native.motor_dof[m]]
    if native.base_qpos < 0:  # on a rack
        now[2 * motors :] = 0.0
        return True
    b, v = native.base_qpos + 3, native.base_dof + 3
    roll, pitch, yaw = roll_pitch_yaw(qpos[b], qpos[b + 1], qpos[b + 2], qpos[b + 3])
    now[2 * motors], now[2 * motors + 1], now[2 * motors + 2] = roll, pitch, yaw
    for k in range(3):
        now[2 * motors + 3 + k] = qvel[v + k]
    return True


@njit(cache=True, forceinline=True)
def _feet_on_ground(native: _Native, drive: Drive, i: int, velocity: Array, force: Array) -> None:
    """Apply the ground's forces on robot `i`'s feet, for positions and velocities that MuJoCo has just computed."""
    xpos, xipos = doubles(native.geom_xpos[i]), doubles(native.body_xipos[i])
    cvel, com = doubles(native.body_cvel[i]), doubles(native.subtree_com[i])
    applied = doubles(native.force[i])
    stiffness, damping = native.contact
    root = 3 * native.base_body
    for leg in range(len(native.foot_geom)):
        g, b = 3 * native.foot_geom[leg], native.foot_body[leg]
        radius = native.foot_radius[leg]
        depth = radius - xpos[g + 2]
        if depth > 0.0:
            # MuJoCo's cvel is the velocity of the body where the whole robot's centre of mass is.
            x, y, z = xpos[g] - com[root], xpos[g + 1] - com[root + 1], xpos[g + 2] - radius - com[root + 2]
            wx, wy, wz = cvel[6 * b], cvel[6 * b + 1], cvel[6 * b + 2]
            velocity[0] = cvel[6 * b + 3] + wy * z - wz * y
            velocity[1] = cvel[6 * b + 4] + wz * x - wx * z
            velocity[2] = cvel[6 * b + 5] + wx * y - wy * x
        foot_force_kernel(
            depth,
            velocity,
            native.stretch[i, leg],
            native.friction[i],
            stiffness,
            damping,
            drive.limits[3],
            force,
        )
        if force[2] > 0.0:
            drive.contact_ticks[i, leg] += 1.0
        # MuJoCo takes a force at the body's centre of mass and a torque.
        x, y, z = (
            xpos[g] - xipos[3 * b],
            xpos[g + 1] - xipos[3 * b + 1],
            xpos[g + 2] - radius - xipos[3 * b + 2],
        )
        for k in range(3):
            applied[6 * b + k] = force[k]
        applied[6 * b + 3] = y * force[2] - z * force[1]
        applied[6 * b + 4] = z * force[0] - x * force[2]
        applied[6 * b + 5] = x * force[1] - y * force[0]


@njit(cache=True, forceinline=True)
def _seek_speeds(native: _Native, drive: Drive, i: int) -> None:
    """Make the friction that MuJoCo has just set up for robot `i`'s motor joints seek `drive.end_speed`.

    Bounded joint friction is a constraint on the joint's acceleration, which for speed 0 at the step's end is
    -qdot / dt; another acceleration gives another speed.
    """
    aref = doubles(pointers(native.data[i] + native.aref)[0])
    limit = doubles(pointers(native.data[i] + native.frictionloss)[0])
    qvel = doubles(native.qvel[i])
    for m in range(len(native.motor_dof)):
        row = native.motor_row[m]
        end_speed = native.motor_sign[m] * drive.end_speed[i, m]
        aref[row] = (end_speed - qvel[native.motor_dof[m]]) / drive.limits[3]
        limit[row] = drive.torque_limit[i, m]


@njit(cache=True, nogil=True)
def _advance(
    native: _Native, drive: Drive, servo_steps: Index, diverged: NDArray[np.bool_], worker: int, first: int, last: int
) -> None:
    """Run robots first to last (not included) for their number of servo steps, on a thread's model."""
    velocity, force = np.zeros(3), np.zeros(3)
    model = native.model[worker]
    for i in range(first, last):
        if servo_steps[i] == 0:
            continue
        _load_masses(native, worker, i)
        drive.energy[i] = 0.0
        drive.contact_ticks[i] = 0.0
        applied = doubles(native.applied[i])
        for _ in range(servo_steps[i]):
            if diverged[i]:
                break
            servo_tick(drive, i)
            for m in range(len(native.motor_dof)):
                torque = drive.torque[i, m]
                if not np.isfinite(torque):
                    diverged[i] = True
                applied[native.motor_dof[m]] = native.motor_sign[m] * torque
            if diverged[i]:
                break
            call_step(native.step1, model, native.data[i])
            _feet_on_ground(native, drive, i, velocity, force)
            if drive.constraint[0]:
                _seek_speeds(native, drive, i)
            call_step(native.step2, model, native.data[i])
            drive.ticks[i] += 1
            if not _observe(native, drive, i):
                diverged[i] = True
                break
            if drive.constraint[0]:
                forces = doubles(pointers(native.data[i] + native.force_row)[0])
                for m in range(len(native.motor_dof)):
                    drive.motor_torque[i, m] = native.motor_sign[m] * forces[native.motor_row[m]]
                constraint_tick(drive, i)
            record(drive, i)


@njit(cache=True)
def _gather_base(native: _Native, rows: Array) -> None:
    for i in range(len(rows)):
        qpos, qvel = doubles(native.qpos[i]), doubles(native.qvel[i])
        for k in range(7):
            rows[i, k] = qpos[native.base_qpos + k]
        for k in range(3):
            rows[i, 7 + k] = qvel[native.base_dof + k]


def _masses(model: mujoco.MjModel) -> Array:
    """What `_load_masses` writes, from a model that has it."""
    return np.concatenate([getattr(model, field).ravel() for field in _MASS_FIELDS])


class MujocoEngine:
    """MuJoCo behind the engine interface: observe, advance, parameters, forces and snapshots of single robots.

    Args:
        robot: what to simulate.
        drive: shared servo, motor and sensor arrays; its first axis is the number of robots.
        config: actuator, rack, and threads to step on.
    """

    name = "mujoco"

    def __init__(self, robot: RobotDescription, drive: Drive, config: WorldConfig | None = None) -> None:
        self.robot, self.drive, config = robot, drive, config or WorldConfig()
        # The Python package times MuJoCo's stages with a clock call each, some 3 % of a step; nobody reads the times.
        mujoco.set_mjcb_time(None)
        num_envs = len(drive.ticks)
        self._nominal = build_model(robot, config)
        self._scratch_model = copy.copy(self._nominal)
        self._scratch = mujoco.MjData(self._scratch_model)
        self.threads = min(config.threads or os.cpu_count() or 1, -(-num_envs // _CHUNK))
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
        self._ratios: list[tuple[float, ...]] = [(1.0, 1.0, 1.0, 1.0)] * num_envs
        self.initial_state = self._resting_state()

    def _layout(self) -> _Native:
        model, robot = self._nominal, self.robot
        joints = [model.joint(name) for name in robot.motor_names]
        free = model.body(robot.base).jntadr[0] if model.body(robot.base).jntnum[0] else -1
        motor_dof = np.array([joint.dofadr[0] for joint in joints], np.int64)

        def addresses(field: str) -> Index:
            return np.array([getattr(data, field).ctypes.data for data in self.datas], np.int64)

        return _Native(
            step1=function_address("mj_step1"),
            step2=function_address("mj_step2"),
            model=np.array([item._address for item in self.models], np.int64),
            mass_fields=np.array(
                [[getattr(item, field).ctypes.data for field in _MASS_FIELDS] for item in self.models], np.int64
            ),
            mass_sizes=np.array([getattr(model, field).size for field in _MASS_FIELDS], np.int64),
            mass=np.tile(_masses(model), (len(self.datas), 1)),
            data=np.array([item._address for item in self.datas], np.int64),
            qpos=addresses("qpos"),
            qvel=addresses("qvel"),
            applied=addresses("qfrc_applied"),
            force=addresses("xfrc_applied"),
            geom_xpos=addresses("geom_xpos"),
            body_xipos=addresses("xipos"),
            body_cvel=addresses("cvel"),
            subtree_com=addresses("subtree_com"),
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
            friction=np.full(len(self.datas), robot.contact.friction),
            stretch=np.zeros((len(self.datas), len(self._feet), 2)),
            contact=np.array([robot.contact.stiffness, robot.contact.damping]),
            num_qpos=model.nq,
            num_qvel=model.nv,
        )

    def _motor_rows(self, motor_dof: Index) -> dict[str, Any]:
        """Where constraint motors are among the solver's rows; rows of joint friction follow those of closed loops."""
        model, data = self._nominal, self._scratch
        mujoco.mj_step1(model, data)
        friction_dofs = np.flatnonzero(model.dof_frictionloss > 0)
        if not len(friction_dofs):
            return {"motor_row": motor_dof, "aref": 0, "frictionloss": 0, "force_row": 0}
        arrays = {"aref": data.efc_aref, "frictionloss": data.efc_frictionloss, "force_row": data.efc_force}
        places = {name: struct_offset(data._address, array.ctypes.data) for name, array in arrays.items()}
        return {"motor_row": data.ne + np.searchsorted(friction_dofs, motor_dof), **places}

    def _resting_state(self) -> Array:
        mujoco.mj_resetData(self._nominal, self._scratch)
        self._scratch.qpos[:] = resting_qpos(self.robot, self._nominal)
        return self._read(self._scratch, np.zeros_like(self._native.stretch[0]))

    def _read(self, data: mujoco.MjData, stretch: Array) -> Array:
        state = np.empty(mujoco.mj_stateSize(self._nominal, _STATE))
        mujoco.mj_getState(self._nominal, data, state, _STATE)
        return np.concatenate([state, stretch.ravel()])

    def advance(self, servo_steps: Index) -> None:
        """Run every robot for its number of servo steps (N,); those that diverge stop and are marked."""
        if self._pool is None:
            _advance(self._native, self.drive, servo_steps, self.diverged, 0, 0, len(servo_steps))
            return
        # Threads take chunks as they come; drawing from an iterator is atomic under the interpreter's lock.
        chunks = iter(range(0, len(servo_steps), _CHUNK))
        others = [self._pool.submit(self._work, servo_steps, worker, chunks) for worker in range(1, self.threads)]
        self._work(servo_steps, 0, chunks)
        for other in others:
            other.result()

    def _work(self, servo_steps: Index, worker: int, chunks: Iterator[int]) -> None:
        for first in chunks:
            last = min(first + _CHUNK, len(servo_steps))
            _advance(self._native, self.drive, servo_steps, self.diverged, worker, first, last)

    def observe(self, i: int) -> None:
        """Write the state of robot `i` to `drive.now`."""
        _observe(self._native, self.drive, i)

    def get_state(self, i: int) -> Array:
        """Everything that decides robot `i`'s further motion in the engine."""
        return self._read(self.datas[i], self._native.stretch[i])

    def set_state(self, i: int, state: Array) -> None:
        """Put robot `i` into a state from `get_state`."""
        stretch = self._native.stretch[i]
        mujoco.mj_setState(self._nominal, self.datas[i], state[: -stretch.size], _STATE)
        stretch[...] = state[-stretch.size :].reshape(stretch.shape)
        self.diverged[i] = False

    def set_base_velocity(self, i: int, linear_world: Array, angular_base: Array) -> None:
        """Set the base's velocity [m/s] in the world and angular velocity [rad/s] in the base frame."""
        if self._native.base_dof < 0:
            return
        velocity = self.datas[i].qvel
        velocity[self._native.base_dof :][:3] = linear_world
        velocity[self._native.base_dof + 3 :][:3] = angular_base

    def set_force(self, i: int, force_world: Array) -> None:
        """Set the force [N] on the base's centre of mass, in the world frame."""
        self.datas[i].xfrc_applied[self._base, :3] = force_world

    def set_params(self, i: int, params: PhysicalParams, row: int) -> None:
        """Apply masses, inertias and contact friction of `params[row]` to robot `i`."""
        self._native.friction[i] = params.contact_friction[row]
        ratios = (
            params.base_mass_ratio[row],
            params.leg_mass_ratio[row],
            params.base_inertia_ratio[row],
            params.leg_inertia_ratio[row],
        )
        if self._ratios[i] != ratios:
            self._native.mass[i] = self._scaled_masses(*ratios)
            self._ratios[i] = ratios

    def _scaled_masses(self, base_mass: float, leg_mass: float, base_inertia: float, leg_inertia: float) -> Array:
        nominal, model, base, legs = self._nominal, self._scratch_model, self._base, self._legs
        model.body_mass[base] = nominal.body_mass[base] * base_mass
        model.body_mass[legs] = nominal.body_mass[legs] * leg_mass
        model.body_inertia[base] = nominal.body_inertia[base] * base_inertia
        model.body_inertia[legs] = nominal.body_inertia[legs] * leg_inertia
        # Quantities that MuJoCo derives from the masses, with a state of no robot's.
        mujoco.mj_setConst(model, self._scratch)
        return _masses(model)

    def base(self) -> Array:
        """Base position [m], quaternion (w x y z) and velocity [m/s], all in the world frame, (N, 10)."""
        if self._native.base_qpos < 0:
            return np.tile([0.0, 0.0, RACK_HEIGHT, 1.0, *[0.0] * 6], (len(self.datas), 1))
        rows = np.empty((len(self.datas), 10))
        _gather_base(self._native, rows)
        return rows

    def foot_positions(self) -> Array:
        """Centres of the feet in the world frame [m], (N, L, 3)."""
        # MuJoCo's positions are those of the last step's start, or of before a reset.
        for data in self.datas:
            mujoco.mj_kinematics(self._nominal, data)
        return np.array([data.geom_xpos[self._feet] for data in self.datas])
