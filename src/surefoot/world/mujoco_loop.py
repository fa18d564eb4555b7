"""Compiled loop of the MuJoCo engine: servos, motors, physics, foot contacts and sensors of many servo steps.

It calls MuJoCo's C functions and accesses its arrays by address, so that no Python runs between two servo steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from surefoot.actuator.compiled import kernel
from surefoot.arrays import Array
from surefoot.world.actuation import (
    SPEED_LIMIT,
    ActuationState,
    add_constraint_work,
    compute_torque,
    record_sample,
    roll_pitch_yaw,
)
from surefoot.world.contact import foot_force_kernel, spinning_torque_kernel
from surefoot.world.ground_contact import friction_factor, shape_clearance, sphere_contacts
from surefoot.world.native import call_step, doubles, fetch_and_increment, ints, pointers

Index = NDArray[np.int64]

CONTACT_MARGIN = 0.002
"""Distance [m] from the ground, plus the motion in a step, at which MuJoCo's collision detection includes a shape."""
MAX_CLEARANCE = 0.05
"""Upper bound for computed distances of shapes from the ground [m]."""

DATA_FIELDS = (
    *("qpos", "qvel", "qfrc_applied", "xfrc_applied", "geom_xpos", "geom_xmat", "xipos", "cvel", "subtree_com"),
)
"""Arrays of MuJoCo's data whose addresses the loop needs, one per robot."""


class Native(NamedTuple):
    """Addresses, layout and parameters for the compiled loop, for N robots with S shapes that may touch the ground."""

    step1: int
    step2: int
    model: Index
    mass_fields: Index
    mass_sizes: Index
    mass: Array
    data: Index
    qpos: Index
    qvel: Index
    qfrc_applied: Index
    xfrc_applied: Index
    geom_xpos: Index
    geom_xmat: Index
    xipos: Index
    cvel: Index
    subtree_com: Index
    motor_qpos: Index
    motor_dof: Index
    motor_sign: Array
    motor_row: Index  # solver rows of constraint motors
    aref: int  # offsets in MuJoCo's data of pointers to arrays of the solver's rows
    frictionloss: int
    force_row: int
    base_qpos: int
    base_dof: int
    base_body: int
    foot_geom: Index
    foot_body: Index
    foot_radius: Array
    ground: Array  # corners of the cells, see `Ground`
    ground_grid: Array
    patches: Array  # friction factors, see `Ground`
    patch_grid: Array
    body_points: NDArray[np.float32]  # heights for shapes other than feet, see `body_heights`
    body_grid: Array
    shape_geom: Index  # shapes that touch the ground by MuJoCo's contacts, ordered by body
    shape_body: Index
    shape_axis: Index  # longest axis of each shape
    shape_count: Index  # number of parts along this axis
    shape_is_box: NDArray[np.bool_]
    shape_part: Array  # distance between parts, radius of a part, radius of the shape's bounding sphere (S, 3) [m]
    shape_half: Array  # half sides of the bounding box of each part (S, 3) [m]
    clearance: Array  # distance that each shape can move before it touches the ground (N, S) [m]
    geom_conaffinity: Index
    body_conaffinity: Index
    body_bits: Index  # affinity bits of a body's other shapes, one row per shape
    moved: NDArray[np.bool_]  # robots whose derived positions in MuJoCo's data are outdated
    friction: Array
    stiffness: Array
    shear: Array
    spinning: Array
    damping: float
    stretch: Array
    num_qpos: int
    num_qvel: int
    step: float  # [s]


@kernel
def _load_masses(native: Native, worker: int, i: int) -> None:
    """Write the masses and inertias of robot `i` to the model of a thread."""
    at = 0
    for field in range(len(native.mass_sizes)):
        values = doubles(native.mass_fields[worker, field])
        for k in range(native.mass_sizes[field]):
            values[k] = native.mass[i, at + k]
        at += native.mass_sizes[field]


@kernel
def _select_shapes(native: Native, worker: int, i: int) -> None:
    """Enable ground collisions only for shapes of robot `i` that can touch the ground in this step.

    For other shapes, MuJoCo's collision detection would find nothing, but take a third of a step over a plane, and more
    than the rest of the step over a height field. Positions and velocities are from the previous step. The distance of
    a shape from the ground is computed again only after the shape may have moved by as much.
    """
    xpos, xmat = doubles(native.geom_xpos[i]), doubles(native.geom_xmat[i])
    cvel, com = doubles(native.cvel[i]), doubles(native.subtree_com[i])
    geoms, bodies = ints(native.geom_conaffinity[worker]), ints(native.body_conaffinity[worker])
    root, before = 3 * native.base_body, -1
    for k in range(len(native.shape_geom)):
        g, b = native.shape_geom[k], native.shape_body[k]
        if b != before:
            bodies[b] = native.body_bits[k]
            before = b
        near = native.moved[i]
        if near:
            native.clearance[i, k] = 0.0
        else:
            x, y, z = xpos[3 * g], xpos[3 * g + 1], xpos[3 * g + 2]
            arm_x, arm_y, arm_z = x - com[root], y - com[root + 1], z - com[root + 2]
            wx, wy, wz = cvel[6 * b], cvel[6 * b + 1], cvel[6 * b + 2]
            vx = cvel[6 * b + 3] + wy * arm_z - wz * arm_y
            vy = cvel[6 * b + 4] + wz * arm_x - wx * arm_z
            vz = cvel[6 * b + 5] + wx * arm_y - wy * arm_x
            turning = math.sqrt(wx * wx + wy * wy + wz * wz) * native.shape_part[k, 2]
            motion = native.step * (math.sqrt(vx * vx + vy * vy + vz * vz) + turning)
            native.clearance[i, k] -= motion
            # `not >` instead of `<=`, so that values that are not finite count as near.
            if not native.clearance[i, k] > CONTACT_MARGIN + motion:
                row, part, half = 9 * g, native.shape_part[k], native.shape_half[k]
                axis = row + native.shape_axis[k]
                reach_x = abs(xmat[row]) * half[0] + abs(xmat[row + 1]) * half[1] + abs(xmat[row + 2]) * half[2]
                reach_y = abs(xmat[row + 3]) * half[0] + abs(xmat[row + 4]) * half[1] + abs(xmat[row + 5]) * half[2]
                reach_z = abs(xmat[row + 6]) * half[0] + abs(xmat[row + 7]) * half[1] + abs(xmat[row + 8]) * half[2]
                native.clearance[i, k] = shape_clearance(
                    native.body_points,
                    native.body_grid,
                    (x, y, z),
                    (reach_x, reach_y, reach_z),
                    (part[0] * xmat[axis], part[0] * xmat[axis + 3], part[0] * xmat[axis + 6]),
                    native.shape_count[k],
                    part[1],
                    native.shape_is_box[k],
                    CONTACT_MARGIN + motion,
                    MAX_CLEARANCE,
                )
                near = not native.clearance[i, k] > CONTACT_MARGIN + motion
        geoms[g] = 1 if near else 0
        if near:
            bodies[b] |= 1
    native.moved[i] = False


@kernel
def observe(native: Native, state: ActuationState, i: int) -> bool:
    """Write the state of robot `i` to `state.sample`; return false and write nothing if it is not finite."""
    qpos, qvel = doubles(native.qpos[i]), doubles(native.qvel[i])
    for k in range(native.num_qvel):
        if not abs(qvel[k]) < SPEED_LIMIT:
            return False
    for k in range(native.num_qpos):
        if not np.isfinite(qpos[k]):
            return False
    now, motors = state.sample[i], len(native.motor_qpos)
    for m in range(motors):
        now[m] = native.motor_sign[m] * qpos[native.motor_qpos[m]] + state.motor_offset[i, m]
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


@kernel
def _apply_foot_forces(native: Native, state: ActuationState, i: int, velocity: Array, force: Array) -> None:
    """Apply the ground forces on the feet of robot `i`, from positions and velocities that MuJoCo has computed."""
    xpos, xipos = doubles(native.geom_xpos[i]), doubles(native.xipos[i])
    cvel, com = doubles(native.cvel[i]), doubles(native.subtree_com[i])
    applied = doubles(native.xfrc_applied[i])
    root = 3 * native.base_body
    for leg in range(len(native.foot_geom)):
        g, b = 3 * native.foot_geom[leg], native.foot_body[leg]
        radius = native.foot_radius[leg]
        both = sphere_contacts(native.ground, native.ground_grid, xpos[g], xpos[g + 1], xpos[g + 2], radius)
        friction = native.friction[i] * friction_factor(native.patches, native.patch_grid, xpos[g], xpos[g + 1])
        wx, wy, wz = cvel[6 * b], cvel[6 * b + 1], cvel[6 * b + 2]
        for k in range(6):
            applied[6 * b + k] = 0.0
        for at_wall in range(2):
            depth, nx, ny, nz = both[at_wall]
            stretch = native.stretch[i, leg, at_wall]
            if depth <= 0.0:
                stretch[:] = 0.0
                continue
            # The point of the foot that is deepest in the ground.
            px, py, pz = xpos[g] - radius * nx, xpos[g + 1] - radius * ny, xpos[g + 2] - radius * nz
            # MuJoCo's cvel is the velocity of the body at the centre of mass of the whole robot.
            x, y, z = px - com[root], py - com[root + 1], pz - com[root + 2]
            velocity[0] = cvel[6 * b + 3] + wy * z - wz * y
            velocity[1] = cvel[6 * b + 4] + wz * x - wx * z
            velocity[2] = cvel[6 * b + 5] + wx * y - wy * x
            load = foot_force_kernel(
                depth,
                (nx, ny, nz),
                velocity,
                stretch,
                friction,
                native.stiffness[i],
                native.shear[i],
                native.damping,
                state.constants[2],
                force,
            )
            # MuJoCo expects a force at the body's centre of mass and a torque.
            x, y, z = px - xipos[3 * b], py - xipos[3 * b + 1], pz - xipos[3 * b + 2]
            for k in range(3):
                applied[6 * b + k] += force[k]
            applied[6 * b + 3] += y * force[2] - z * force[1]
            applied[6 * b + 4] += z * force[0] - x * force[2]
            applied[6 * b + 5] += x * force[1] - y * force[0]
            if load > 0.0 and not at_wall:
                state.contact_ticks[i, leg] += 1.0
                torque = spinning_torque_kernel(load, wx * nx + wy * ny + wz * nz, native.spinning[i])
                applied[6 * b + 3] += torque * nx
                applied[6 * b + 4] += torque * ny
                applied[6 * b + 5] += torque * nz


@kernel
def _set_target_speeds(native: Native, state: ActuationState, i: int) -> None:
    """Set the target speeds of the constraint motors of robot `i` to `state.constraint_speed`.

    MuJoCo's bounded joint friction is a constraint with the target acceleration -qdot / dt, for speed 0 at the end of
    the step. Another target acceleration gives another speed.
    """
    aref = doubles(pointers(native.data[i] + native.aref)[0])
    limit = doubles(pointers(native.data[i] + native.frictionloss)[0])
    qvel = doubles(native.qvel[i])
    for m in range(len(native.motor_dof)):
        row = native.motor_row[m]
        end_speed = native.motor_sign[m] * state.constraint_speed[i, m]
        aref[row] = (end_speed - qvel[native.motor_dof[m]]) / state.constants[2]
        limit[row] = state.constraint_torque[i, m]


@kernel
def _run(
    native: Native, state: ActuationState, i: int, servo_steps: int, worker: int, velocity: Array, force: Array
) -> bool:
    """Run robot `i` for a number of servo steps on the model of thread `worker`; return false if it diverges."""
    state.energy[i] = 0.0
    state.heat[i] = 0.0
    state.contact_ticks[i] = 0.0
    state.limit_ticks[i] = 0.0
    applied, data, model = doubles(native.qfrc_applied[i]), native.data[i], native.model[worker]
    for _ in range(servo_steps):
        compute_torque(state, i)
        for m in range(len(native.motor_dof)):
            torque = state.torque[i, m]
            if not np.isfinite(torque):
                return False
            applied[native.motor_dof[m]] = native.motor_sign[m] * torque
        _select_shapes(native, worker, i)
        call_step(native.step1, model, data)
        _apply_foot_forces(native, state, i, velocity, force)
        if state.constraint[0]:
            _set_target_speeds(native, state, i)
        call_step(native.step2, model, data)
        state.ticks[i] += 1
        if not observe(native, state, i):
            return False
        if state.constraint[0]:
            forces = doubles(pointers(data + native.force_row)[0])
            for m in range(len(native.motor_dof)):
                state.motor_torque[i, m] = native.motor_sign[m] * forces[native.motor_row[m]]
            add_constraint_work(state, i)
        record_sample(state, i)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def advance(
    native: Native,
    state: ActuationState,
    servo_steps: Index,
    diverged: NDArray[np.bool_],
    worker: int,
    counter: Index,
) -> None:
    """Run robots for their numbers of servo steps on one thread, until no robots are left.

    Threads share a counter (1,) with the number of the next robot, so that free threads take the next robot.
    """
    velocity, force = np.zeros(3), np.zeros(3)
    while True:
        i = fetch_and_increment(counter.ctypes.data)
        if i >= len(servo_steps):
            return
        if servo_steps[i] == 0:
            continue
        _load_masses(native, worker, i)
        if not diverged[i]:
            diverged[i] = not _run(native, state, i, servo_steps[i], worker, velocity, force)


@njit(cache=True)
def gather_base(native: Native, rows: Array) -> None:
    """Write position, quaternion and velocity of each robot's base to `rows` (N, 10)."""
    for i in range(len(rows)):
        qpos, qvel = doubles(native.qpos[i]), doubles(native.qvel[i])
        for k in range(7):
            rows[i, k] = qpos[native.base_qpos + k]
        for k in range(3):
            rows[i, 7 + k] = qvel[native.base_dof + k]
