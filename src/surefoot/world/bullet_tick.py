"""Compiled functions of the Bullet engine: everything between two of Bullet's steps, and its frames.

A robot's row of numbers in Bullet's own frames, where the base is at its centre of mass and turned like its principal
axes: base position (3), quaternion x y z w (4), velocity (3) and angular velocity (3) in the world, then angles and
then speeds of its joints.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from surefoot.rotations import quat_matrix
from surefoot.world.drive import SPEED_LIMIT, Drive, constraint_tick, record, roll_pitch_yaw, servo_tick

Array = NDArray[np.float64]
Index = NDArray[np.int64]

VELOCITY, OMEGA, JOINTS = 7, 10, 13
"""Where in a row these begin."""
PIN_LOAD = 1.0
"""Load [N] at which a pin with play has moved half of its clearance; it smooths the change from side to side."""
PIN_FOLLOWS = 0.2
"""Share of its path that such a pin moves in a step of 1 ms: .1 kg at 5 N crosses half a millimetre in some 5 ms."""


class Layout(NamedTuple):
    """The parts of a `BulletModel` that the compiled functions need."""

    sign: Array
    base_quat: Array
    rack: bool


@njit(cache=True, inline="always")
def link_quat(base_quat: Array, x: Any, y: Any, z: Any, w: Any) -> tuple[Any, Any, Any, Any]:
    """Return the orientation w x y z of a base link: that of Bullet's base without the inertial frame's rotation.

    Args:
        base_quat: orientation of Bullet's base in the base link (4,), w x y z.
        x: of the quaternion of Bullet's base in the world, and so on; numbers, or arrays in Python.
        y: see x.
        z: see x.
        w: see x.
    """
    bw, bx, by, bz = base_quat[0], -base_quat[1], -base_quat[2], -base_quat[3]
    return (
        w * bw - x * bx - y * by - z * bz,
        w * bx + x * bw + y * bz - z * by,
        w * by - x * bz + y * bw + z * bx,
        w * bz + x * by - y * bx + z * bw,
    )


@njit(cache=True)
def observe(layout: Layout, drive: Drive, i: int, seen: Array) -> bool:
    """Write robot `i`'s state to `drive.now`; return false, and write nothing, if it is not finite.

    Seen are the first 13 numbers of its row, then angles and speeds of its motors' joints.
    """
    motors = len(layout.sign)
    for k in range(JOINTS + 2 * motors):
        if not np.isfinite(seen[k]):
            return False
        if (VELOCITY <= k < JOINTS or k >= JOINTS + motors) and not abs(seen[k]) < SPEED_LIMIT:
            return False
    now = drive.now[i]
    for m in range(2 * motors):
        now[m] = layout.sign[m % motors] * seen[JOINTS + m]
    if layout.rack:
        now[2 * motors :] = 0.0
        return True
    w, x, y, z = link_quat(layout.base_quat, seen[3], seen[4], seen[5], seen[6])
    now[2 * motors], now[2 * motors + 1], now[2 * motors + 2] = roll_pitch_yaw(w, x, y, z)
    # World to base, by the conjugate q* = (w, -u): omega - 2 u x (w omega - u x omega).
    ox, oy, oz = seen[OMEGA], seen[OMEGA + 1], seen[OMEGA + 2]
    cx, cy, cz = w * ox - (y * oz - z * oy), w * oy - (z * ox - x * oz), w * oz - (x * oy - y * ox)
    now[2 * motors + 3] = ox - 2 * (y * cz - z * cy)
    now[2 * motors + 4] = oy - 2 * (z * cx - x * cz)
    now[2 * motors + 5] = oz - 2 * (x * cy - y * cx)
    return True


@njit(cache=True)
def between(
    layout: Layout,
    drive: Drive,
    seen: Array,
    applied: Array,
    left: Index,
    diverged: NDArray[np.bool_],
    ended: bool,
) -> None:
    """Run everything between two steps of Bullet for all robots: the end of one, the start of the next.

    Args:
        layout: see there.
        drive: servos, motors and sensors of N robots.
        seen: their states after the step, see `observe`, then the torques of Bullet's own joint motors [N m], (N, ...).
        applied: output, joint torques (N, M) [N m] for the next step.
        left: steps that each has to go, the one that has ended included (N,); updated, 0 where a robot diverges.
        diverged: set where a robot diverges (N,).
        ended: a step has ended; if not, the first is about to start.
    """
    motors = len(layout.sign)
    for i in range(len(left)):
        if left[i] == 0:
            continue
        if ended:
            drive.ticks[i] += 1
            if not observe(layout, drive, i, seen[i]):
                diverged[i], left[i] = True, 0
                continue
            if drive.constraint[0]:
                for m in range(motors):
                    # A motor without strength is left out of the solver, and keeps the torque that it had before.
                    limit = drive.torque_limit[i, m]
                    torque = layout.sign[m] * seen[i, JOINTS + 2 * motors + m]
                    drive.motor_torque[i, m] = min(max(torque, -limit), limit)
                constraint_tick(drive, i)
            record(drive, i)
            left[i] -= 1
        if left[i] > 0:
            servo_tick(drive, i)
            for m in range(motors):
                applied[i, m] = layout.sign[m] * drive.torque[i, m]
                if not np.isfinite(applied[i, m]):
                    diverged[i], left[i] = True, 0


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
        x, y, z, w = -quats[k, 0], -quats[k, 1], -quats[k, 2], quats[k, 3]
        fx, fy, fz = forces[k]
        # World to link, by the conjugate quaternion: F + 2 v x (v x F + w F).
        ax, ay, az = y * fz - z * fy + w * fx, z * fx - x * fz + w * fy, x * fy - y * fx + w * fz
        fx, fy, fz = fx + 2 * (y * az - z * ay), fy + 2 * (z * ax - x * az), fz + 2 * (x * ay - y * ax)
        along = fx * axes[k, 0] + fy * axes[k, 1] + fz * axes[k, 2]
        fx, fy, fz = fx - along * axes[k, 0], fy - along * axes[k, 1], fz - along * axes[k, 2]
        reach = play / (math.sqrt(fx * fx + fy * fy + fz * fz) + PIN_LOAD)
        shift[k, 0] += PIN_FOLLOWS * (reach * fx - shift[k, 0])
        shift[k, 1] += PIN_FOLLOWS * (reach * fy - shift[k, 1])
        shift[k, 2] += PIN_FOLLOWS * (reach * fz - shift[k, 2])


def base_links(rows: Array, base_quat: Array, base_centre: Array) -> Array:
    """Return the base links of robots (N, 10): position [m], quaternion w x y z and velocity [m/s] in the world.

    Args:
        rows: see above, (N, ...).
        base_quat: orientation of Bullet's base in the base link (4,), w x y z.
        base_centre: centre of mass in the base link (3,) [m].
    """
    quats = np.stack(link_quat.py_func(base_quat, *rows[:, 3:7].T), axis=1)
    arm = quat_matrix(quats) @ base_centre
    velocity = rows[:, VELOCITY:OMEGA] - np.cross(rows[:, OMEGA:JOINTS], arm)
    return np.concatenate([rows[:, :3] - arm, quats, velocity], axis=1)
