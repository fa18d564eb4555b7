"""Compiled functions of the Bullet engine: the computations between two of Bullet's steps, and conversions of frames.

The state of a robot is a row of numbers in Bullet's own frames, in which the base frame is at the base's centre of
mass, along its principal axes: base position (3), quaternion x y z w (4), velocity (3) and angular velocity (3) in the
world, then angles and then speeds of its joints.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.rotations import quat_matrix
from surefoot.world.actuation import (
    SPEED_LIMIT,
    ActuationState,
    add_constraint_work,
    compute_torque,
    quat_product,
    record_sample,
    roll_pitch_yaw,
    rotate_inverse,
)
from surefoot.world.contact import friction_force_kernel
from surefoot.world.ground_contact import sphere_contacts

Index = NDArray[np.int64]

VELOCITY, OMEGA, JOINTS = 7, 10, 13
"""First index in a row of velocity, angular velocity and joint angles."""
PIN_LOAD = 1.0
"""Load [N] at which a pin with play has moved by half its clearance. It smooths the change from side to side."""
PIN_FOLLOW_RATE = 0.2
"""Fraction of its remaining distance that a pin moves per step of 1 ms: 0.1 kg at 5 N crosses 0.5 mm in some 5 ms."""

CONTACT_RANGE = 0.02
"""Distance [m] from a foot within which it gets a contact plane: the range of Bullet's collision detection."""
PLANE_OUT_OF_REACH = -1e3
"""Offset [m] of contact planes that are not needed."""


class Layout(NamedTuple):
    """Fields of a `BulletModel` that the compiled functions need."""

    sign: Array
    base_quat: Array
    rack: bool


@njit(cache=True)
def observe(layout: Layout, state: ActuationState, i: int, measured: Array) -> bool:
    """Write the state of robot `i` to `state.sample`; return false and write nothing if it is not finite.

    Args:
        layout: see `Layout`.
        state: servos, motors and sensors.
        i: number of the robot.
        measured: first 13 numbers of its row, then angles and speeds of its motor joints.
    """
    motors = len(layout.sign)
    for k in range(JOINTS + 2 * motors):
        if not np.isfinite(measured[k]):
            return False
        if (VELOCITY <= k < JOINTS or k >= JOINTS + motors) and not abs(measured[k]) < SPEED_LIMIT:
            return False
    now = state.sample[i]
    for m in range(2 * motors):
        now[m] = layout.sign[m % motors] * measured[JOINTS + m]
    for m in range(motors):
        now[m] += state.motor_offset[i, m]
    if layout.rack:
        now[2 * motors :] = 0.0
        return True
    b = layout.base_quat
    quat = quat_product((measured[6], measured[3], measured[4], measured[5]), (b[0], -b[1], -b[2], -b[3]))
    now[2 * motors], now[2 * motors + 1], now[2 * motors + 2] = roll_pitch_yaw(*quat)
    omega = rotate_inverse(quat, (measured[OMEGA], measured[OMEGA + 1], measured[OMEGA + 2]))
    now[2 * motors + 3], now[2 * motors + 4], now[2 * motors + 5] = omega
    return True


@njit(cache=True)
def substep(
    layout: Layout,
    state: ActuationState,
    measured: Array,
    applied: Array,
    remaining: Index,
    diverged: NDArray[np.bool_],
    step_done: bool,
) -> None:
    """Finish one step of Bullet and prepare the next one, for all robots.

    Args:
        layout: see `Layout`.
        state: servos, motors and sensors of N robots.
        measured: states after the step (see `observe`), then torques of Bullet's joint motors [N m] (N, ...).
        applied: output, joint torques for the next step (N, M) [N m].
        remaining: remaining steps, including the one that ended (N,); modified in place, 0 if a robot diverges.
        diverged: set to true if a robot diverges (N,).
        step_done: whether a step has ended; false before the first step.
    """
    motors = len(layout.sign)
    for i in range(len(remaining)):
        if remaining[i] == 0:
            continue
        if step_done:
            state.ticks[i] += 1
            if not observe(layout, state, i, measured[i]):
                diverged[i], remaining[i] = True, 0
                continue
            if state.constraint[0]:
                for m in range(motors):
                    # The solver skips motors without strength, which keep their old torque.
                    limit = state.constraint_torque[i, m]
                    torque = layout.sign[m] * measured[i, JOINTS + 2 * motors + m]
                    state.motor_torque[i, m] = min(max(torque, -limit), limit)
                add_constraint_work(state, i)
            record_sample(state, i)
            remaining[i] -= 1
        if remaining[i] > 0:
            compute_torque(state, i)
            for m in range(motors):
                applied[i, m] = layout.sign[m] * state.torque[i, m]
                if not np.isfinite(applied[i, m]):
                    diverged[i], remaining[i] = True, 0


@njit(cache=True)
def pin_kernel(quats: Array, forces: Array, axes: Array, play: float, shift: Array) -> None:
    """Move pins with radial play in their bores for one step.

    The force F across a pin presses it against one side of its bore. With a radial clearance r, its displacement tends
    to u = r F / (|F| + F_0), with a delay.

    Args:
        quats: orientations of the pins' links in the world (L, 4), x y z w.
        forces: forces on the pins in the world frame (L, 3) [N].
        axes: unit vectors along the pins in their links' frames (L, 3).
        play: radial clearance r [m].
        shift: displacement u in the links' frames (L, 3) [m]; modified in place.
    """
    for k in range(len(quats)):
        quat = (quats[k, 3], quats[k, 0], quats[k, 1], quats[k, 2])
        fx, fy, fz = rotate_inverse(quat, (forces[k, 0], forces[k, 1], forces[k, 2]))
        along = fx * axes[k, 0] + fy * axes[k, 1] + fz * axes[k, 2]
        fx, fy, fz = fx - along * axes[k, 0], fy - along * axes[k, 1], fz - along * axes[k, 2]
        offset_per_force = play / (math.sqrt(fx * fx + fy * fy + fz * fz) + PIN_LOAD)
        shift[k, 0] += PIN_FOLLOW_RATE * (offset_per_force * fx - shift[k, 0])
        shift[k, 1] += PIN_FOLLOW_RATE * (offset_per_force * fy - shift[k, 1])
        shift[k, 2] += PIN_FOLLOW_RATE * (offset_per_force * fz - shift[k, 2])


@njit(cache=True)
def sole_kernel(
    links: Array,
    loads: Array,
    centres: Array,
    radii: Array,
    friction: Array,
    law: tuple[float, float, float],
    stretch: Array,
    force: Array,
    place: Array,
) -> None:
    """Compute the tangential ground forces on feet with a shear stiffness, see `contact`.

    Args:
        links: positions [m], orientations x y z w, velocities and angular velocities of the feet's links in the world
            (F, 13).
        loads: normal forces of the ground on the feet in the last step, world frame (F, 3) [N].
        centres: centres of the feet in their links' frames (F, 3) [m].
        radii: radii of the feet (F,) [m].
        friction: friction coefficients of the feet (F,).
        law: tangential stiffness [N/m], normal damping [N s/m], step [s].
        stretch: shear of the soles along the world's axes (F, 3) [m]; modified in place.
        force: output, forces in the world frame (F, 3) [N].
        place: output, points of application in the world frame (F, 3) [m].
    """
    shear, damping, dt = law
    arm, slip = np.empty(3), np.empty(3)
    for k in range(len(links)):
        force[k] = 0.0
        load = math.sqrt(loads[k, 0] ** 2 + loads[k, 1] ** 2 + loads[k, 2] ** 2)
        if loads[k, 2] <= 0.0:
            stretch[k] = 0.0
            continue
        normal = (loads[k, 0] / load, loads[k, 1] / load, loads[k, 2] / load)
        quat = (links[k, 6], -links[k, 3], -links[k, 4], -links[k, 5])
        arm[0], arm[1], arm[2] = rotate_inverse(quat, (centres[k, 0], centres[k, 1], centres[k, 2]))
        for c in range(3):
            arm[c] -= radii[k] * normal[c]
            place[k, c] = links[k, c] + arm[c]
        for c in range(3):
            a, b = (c + 1) % 3, (c + 2) % 3
            slip[c] = links[k, VELOCITY + c] + links[k, OMEGA + a] * arm[b] - links[k, OMEGA + b] * arm[a]
        friction_force_kernel(load, normal, slip, stretch[k], friction[k], shear, damping, dt, force[k])


@njit(cache=True)
def sphere_centres(links: Array, centres: Array, places: Array) -> None:
    """Transform points from link frames to the world frame.

    Args:
        links: position [m] and orientation x y z w of each link in the world (F, 7).
        centres: point in each link frame (F, 3) [m].
        places: output, points in the world (F, 3) [m].
    """
    for k in range(len(links)):
        # The matrix of `quat_matrix`, because `rotate_inverse` rounds differently and would change results in Bullet.
        x, y, z, w = links[k, 3], links[k, 4], links[k, 5], links[k, 6]
        a, b, c = centres[k, 0], centres[k, 1], centres[k, 2]
        places[k, 0] = links[k, 0] + ((1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c)
        places[k, 1] = links[k, 1] + (2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c)
        places[k, 2] = links[k, 2] + (2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c)


@njit(cache=True)
def contact_planes(corners: Array, grid: Array, feet: Array, lift: Array, radii: Array, planes: Array) -> None:
    """Compute the tangent planes of the ground at the deepest contacts of the feet, see `sphere_contacts`.

    Args:
        corners: corners of the `Ground`, (X, Y, 2, 2).
        grid: grid of the `Ground`.
        feet: centres of the feet in the world (F, 3) [m].
        lift: height by which the ground under each foot is raised (F,) [m].
        radii: radii of the feet (F,) [m].
        planes: output (2 F, 4), unit normal n and offset n . p of the points p [m] of each plane: the supporting planes
            of all feet, then the wall planes of all feet.
    """
    count = len(feet)
    for k in range(count):
        x, y, z, reach = feet[k, 0], feet[k, 1], feet[k, 2] - lift[k], radii[k] + CONTACT_RANGE
        both = sphere_contacts(corners, grid, x, y, z, reach)
        for at_wall in range(2):
            depth, nx, ny, nz = both[at_wall]
            offset = nx * x + ny * y + nz * z - reach + depth + nz * lift[k] if depth > 0.0 else PLANE_OUT_OF_REACH
            plane = planes[k + at_wall * count]
            plane[0], plane[1], plane[2], plane[3] = nx, ny, nz, offset


def base_links(rows: Array, base_quat: Array, base_centres: Array) -> Array:
    """Return the states of base links (N, 10): position [m], quaternion w x y z and velocity [m/s] in the world.

    Args:
        rows: rows of the robots in Bullet's frames (N, ...).
        base_quat: orientation of Bullet's base frame in the base link frame (4,), w x y z.
        base_centres: centre of mass in each base link frame (N, 3) [m].
    """
    x, y, z, w = rows[:, 3:7].T
    # The conjugate removes the rotation of the inertial frame.
    quats = np.stack(quat_product.py_func((w, x, y, z), base_quat * [1, -1, -1, -1]), axis=1)
    arm = np.einsum("nij,nj->ni", quat_matrix(quats), base_centres)
    velocity = rows[:, VELOCITY:OMEGA] - np.cross(rows[:, OMEGA:JOINTS], arm)
    return np.concatenate([rows[:, :3] - arm, quats, velocity], axis=1)
