"""Compiled functions of the Bullet engine: everything between two of Bullet's steps, and its frames.

A robot's row of numbers in Bullet's own frames, where the base is at its centre of mass and turned like its principal
axes: base position (3), quaternion x y z w (4), velocity (3) and angular velocity (3) in the world, then angles and
then speeds of its joints.
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
"""Where in a row these begin."""
PIN_LOAD = 1.0
"""Load [N] at which a pin with play has moved half of its clearance; it smooths the change from side to side."""
PIN_FOLLOW_RATE = 0.2
"""Share of its path that such a pin moves in a step of 1 ms: .1 kg at 5 N crosses half a millimetre in some 5 ms."""

NEAR = 0.02
"""Distance [m] from a foot within which it has a plane to meet: Bullet looks for contacts that far."""
FAR = -1e3
"""Offset [m] of a plane that is out of reach."""


class Layout(NamedTuple):
    """The parts of a `BulletModel` that the compiled functions need."""

    sign: Array
    base_quat: Array
    rack: bool


@njit(cache=True)
def observe(layout: Layout, state: ActuationState, i: int, measured: Array) -> bool:
    """Write robot `i`'s state to `state.sample`; return false, and write nothing, if it is not finite.

    `measured` holds the first 13 numbers of its row, then angles and speeds of its motors' joints.
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
    """Run everything between two steps of Bullet for all robots: the end of one, the start of the next.

    Args:
        layout: see there.
        state: servos, motors and sensors of N robots.
        measured: states after the step, see `observe`, then the torques of Bullet's joint motors [N m], (N, ...).
        applied: output, joint torques (N, M) [N m] for the next step.
        remaining: steps to go, the one that has ended included (N,); updated, 0 where a robot diverges.
        diverged: set where a robot diverges (N,).
        step_done: a step has ended; if not, the first is about to start.
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
                    # A motor without strength is left out of the solver, and keeps the torque that it had before.
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
    """Move pins with play in their bores for one step.

    A pin of radial clearance r lies against its bore on the side to which the force F across it points, and goes from
    side to side when that changes: u = r F / (|F| + F_0), followed with a delay.

    Args:
        quats: orientations of the pins' links in the world (L, 4), x y z w.
        forces: forces on the pins in the world frame (L, 3) [N].
        axes: unit vectors along the pins in their links' frames (L, 3).
        play: r [m].
        shift: u in the links' frames (L, 3) [m]; updated.
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
    """Compute the forces along the ground on feet with soles of a stiffness of their own, see `contact`.

    Args:
        links: positions [m], orientations x y z w, velocities and angular velocities of the feet's links in the world
            (F, 13).
        loads: normal forces of the ground on the feet in the step that has ended, world frame (F, 3) [N].
        centres: centres of the feet in their links' frames (F, 3) [m].
        radii: of the feet (F,) [m].
        friction: coefficients of the feet (F,).
        law: stiffness along the ground [N/m], damping against it [N s/m], step [s].
        stretch: of the soles along the world's axes (F, 3) [m]; updated.
        force: output, world frame (F, 3) [N].
        place: output, where the forces act, world frame (F, 3) [m].
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
    """Compute where points of links are in the world.

    Args:
        links: position [m] and orientation x y z w of each in the world (F, 7).
        centres: the point in each link (F, 3) [m].
        places: output (F, 3) [m].
    """
    for k in range(len(links)):
        # The matrix of `quat_matrix`: `rotate_inverse` would round otherwise, and so change results in Bullet.
        x, y, z, w = links[k, 3], links[k, 4], links[k, 5], links[k, 6]
        a, b, c = centres[k, 0], centres[k, 1], centres[k, 2]
        places[k, 0] = links[k, 0] + ((1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c)
        places[k, 1] = links[k, 1] + (2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c)
        places[k, 2] = links[k, 2] + (2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c)


@njit(cache=True)
def contact_planes(corners: Array, grid: Array, feet: Array, lift: Array, radii: Array, planes: Array) -> None:
    """Compute the planes that touch the ground where it is deepest in the feet, see `sphere_contacts`.

    Args:
        corners: of the `Ground`, (X, Y, 2, 2).
        grid: of the `Ground`.
        feet: centres in the world (F, 3) [m].
        lift: how much the ground under each is lifted (F,) [m].
        radii: of the feet (F,) [m].
        planes: output (2 F, 4), unit normal n and offset n . p of its points p [m]: for each foot the one that carries
            it, then for each the one at a wall.
    """
    count = len(feet)
    for k in range(count):
        x, y, z, reach = feet[k, 0], feet[k, 1], feet[k, 2] - lift[k], radii[k] + NEAR
        both = sphere_contacts(corners, grid, x, y, z, reach)
        for at_wall in range(2):
            depth, nx, ny, nz = both[at_wall]
            offset = nx * x + ny * y + nz * z - reach + depth + nz * lift[k] if depth > 0.0 else FAR
            plane = planes[k + at_wall * count]
            plane[0], plane[1], plane[2], plane[3] = nx, ny, nz, offset


def base_links(rows: Array, base_quat: Array, base_centres: Array) -> Array:
    """Return the base links of robots (N, 10): position [m], quaternion w x y z and velocity [m/s] in the world.

    Args:
        rows: see above, (N, ...).
        base_quat: orientation of Bullet's base in the base link (4,), w x y z.
        base_centres: centre of mass in each base link (N, 3) [m].
    """
    x, y, z, w = rows[:, 3:7].T
    # Without the rotation of the inertial frame, by the conjugate.
    quats = np.stack(quat_product.py_func((w, x, y, z), base_quat * [1, -1, -1, -1]), axis=1)
    arm = np.einsum("nij,nj->ni", quat_matrix(quats), base_centres)
    velocity = rows[:, VELOCITY:OMEGA] - np.cross(rows[:, OMEGA:JOINTS], arm)
    return np.concatenate([rows[:, :3] - arm, quats, velocity], axis=1)
