"""The compiled loop that steps robots in MuJoCo: servo, motors, physics, feet on the ground and sensors.

It calls MuJoCo's C functions and reads its arrays by address, so that no Python runs between two servo steps.
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
from surefoot.world.native import call_step, doubles, ints, pointers, fetch_and_increment

Index = NDArray[np.int64]

NEAR = 0.002
"""Distance [m] from the ground at which shapes take part in MuJoCo's search for contacts, beside a step's motion."""
MAX_CLEARANCE = 0.05
"""Distance [m] to which a shape's way to the ground is looked for."""

DATA_FIELDS = (
    *("qpos", "qvel", "qfrc_applied", "xfrc_applied", "geom_xpos", "geom_xmat", "xipos", "cvel", "subtree_com"),
)
"""Arrays of MuJoCo's data whose addresses, one a robot, the loop takes."""


class Native(NamedTuple):
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
    ground: Array  # corners of its cells, see `Ground`
    ground_grid: Array
    patches: Array  # factors on friction, see `Ground`
    patch_grid: Array
    body_points: NDArray[np.float32]  # heights that other shapes meet, see `body_heights`
    body_grid: Array
    shape_geom: Index  # shapes that meet the ground by MuJoCo's contacts, in the order of their bodies
    shape_body: Index
    shape_axis: Index  # along which each is longest
    shape_count: Index  # of parts along it
    shape_is_box: NDArray[np.bool_]
    shape_part: Array  # distance of these, radius across, and the radius of a sphere around the shape [m]
    shape_half: Array  # half lengths of a box around each part (S, 3) [m]
    clearance: Array  # how far each of a robot's shapes can move before it touches the ground (N, S) [m]
    geom_conaffinity: Index
    body_conaffinity: Index
    body_bits: Index  # of a body's other shapes, a row for each shape
    moved: NDArray[np.bool_]  # robots whose positions in MuJoCo's data are not those of their state
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
    """Give the model of a thread the masses and inertias of robot `i`."""
    at = 0
    for field in range(len(native.mass_sizes)):
        values = doubles(native.mass_fields[worker, field])
        for k in range(native.mass_sizes[field]):
            values[k] = native.mass[i, at + k]
        at += native.mass_sizes[field]


@kernel
def _select_shapes(native: Native, worker: int, i: int) -> None:
    """Let those shapes of robot `i` meet the ground that can touch it in this step.

    MuJoCo's search among the others would find nothing, and takes a third of a step over a plane, more than the rest of
    the step over a field of heights. Positions and velocities are those of the step before. How far a shape is from the
    ground is looked up anew when it may have moved as far.
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
            # Not written with `<`: what is not finite is near.
            if not native.clearance[i, k] > NEAR + motion:
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
                    NEAR + motion,
                    MAX_CLEARANCE,
                )
                near = not native.clearance[i, k] > NEAR + motion
        geoms[g] = 1 if near else 0
        if near:
            bodies[b] |= 1
    native.moved[i] = False


@kernel
def observe(native: Native, state: ActuationState, i: int) -> bool:
    """Write robot `i`'s state to `state.sample`; return false, and write nothing, if it is not finite."""
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
    """Apply the ground's forces on robot `i`'s feet, from the positions and velocities that MuJoCo has computed."""
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
            # MuJoCo's cvel is the velocity of the body where the whole robot's centre of mass is.
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
                state.constants[3],
                force,
            )
            # MuJoCo takes a force at the body's centre of mass and a torque.
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
    """Make the friction that MuJoCo has set up for robot `i`'s motor joints accelerate to `state.constraint_speed`.

    Bounded joint friction is a constraint on the joint's acceleration, which for speed 0 at the step's end is
    -qdot / dt; another acceleration gives another speed.
    """
    aref = doubles(pointers(native.data[i] + native.aref)[0])
    limit = doubles(pointers(native.data[i] + native.frictionloss)[0])
    qvel = doubles(native.qvel[i])
    for m in range(len(native.motor_dof)):
        row = native.motor_row[m]
        end_speed = native.motor_sign[m] * state.constraint_speed[i, m]
        aref[row] = (end_speed - qvel[native.motor_dof[m]]) / state.constants[3]
        limit[row] = state.constraint_torque[i, m]


@kernel
def _run(
    native: Native, state: ActuationState, i: int, servo_steps: int, worker: int, velocity: Array, force: Array
) -> bool:
    """Run robot `i` for some servo steps on the model of thread `worker`; return false if it diverges."""
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
    """Run robots for their number of servo steps on a thread's model, until none is left.

    Threads share a counter (1,) of the robots that were taken: whoever is done with a robot takes the next.
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
    """Write base position, quaternion and velocity of every robot to `rows` (N, 10)."""
    for i in range(len(rows)):
        qpos, qvel = doubles(native.qpos[i]), doubles(native.qvel[i])
        for k in range(7):
            rows[i, k] = qpos[native.base_qpos + k]
        for k in range(3):
            rows[i, 7 + k] = qvel[native.base_dof + k]
