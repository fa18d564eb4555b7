"""Rotations as matrices, quaternions (w, x, y, z) and roll, pitch, yaw.

Roll, pitch and yaw rotate about the fixed axes x, then y, then z. The compiled kernels of the simulators' inner loops
are in `world.actuation`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array


def rpy_matrix(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation matrix (3, 3) of roll, pitch and yaw about fixed axes [rad]."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle), math.sin(angle)) for angle in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix_rpy(rotation: Array) -> Array:
    """Return roll, pitch and yaw (3,) [rad] of a rotation matrix (3, 3); yaw is 0 if pitch is ±pi/2."""
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], level)
    if level < 1e-9:
        return np.array([math.atan2(math.copysign(1.0, pitch) * rotation[0, 1], rotation[1, 1]), pitch, 0.0])
    return np.array([math.atan2(rotation[2, 1], rotation[2, 2]), pitch, math.atan2(rotation[1, 0], rotation[0, 0])])


def rpy_quat(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return the unit quaternion of roll, pitch and yaw [rad]."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )


def quat_rpy(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return roll, pitch and yaw [rad] of a unit quaternion."""
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def quat_yaw(quat: ArrayLike) -> Array:
    """Return the yaw (...) [rad] of unit quaternions (..., 4), w x y z."""
    w, x, y, z = np.moveaxis(np.asarray(quat, float), -1, 0)
    yaw: Array = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def in_heading_frame(vector: Array, yaw: Array) -> Array:
    """Rotate vectors (N, 3) from the world frame to the heading frame (upright, yaw (N,) [rad])."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y, z = vector.T
    return np.stack([cos * x + sin * y, cos * y - sin * x, z], -1)


def from_heading_frame(points: Array, yaw: Array) -> Array:
    """Rotate points (N, K, 2) or (K, 2) from heading frames with yaw (N,) [rad] to the world frame (N, K, 2)."""
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = np.moveaxis(points, -1, 0)
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def up_direction(roll_pitch_yaw: Array) -> Array:
    """Return the unit vector away from the ground in the base frame (..., 3): (0, 0, 1) for a level base.

    Args:
        roll_pitch_yaw: attitudes (..., 2) or (..., 3) [rad]; the yaw does not matter.
    """
    sine, cosine = np.sin(roll_pitch_yaw), np.cos(roll_pitch_yaw)
    up, level = np.empty((*sine.shape[:-1], 3)), cosine[..., 1]
    up[..., 0], up[..., 1], up[..., 2] = -sine[..., 1], sine[..., 0] * level, cosine[..., 0] * level
    return up


def from_base_frame(vector: Array, roll_pitch_yaw: Array) -> Array:
    """Rotate vectors (..., 3) from the base frame to the heading frame, for attitudes (..., 3) [rad]."""
    sine, cosine = np.sin(roll_pitch_yaw), np.cos(roll_pitch_yaw)
    (sr, sp), (cr, cp) = ((angle[..., 0], angle[..., 1]) for angle in (sine, cosine))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    y, z = cr * y - sr * z, sr * y + cr * z
    return np.stack([cp * x + sp * z, y, cp * z - sp * x], axis=-1)


def quat_matrix(quat: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4), w x y z."""
    w, x, y, z = np.moveaxis(np.asarray(quat, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def xyzw_matrix(quat: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4) in Bullet's order x, y, z, w."""
    return quat_matrix(quat[..., [3, 0, 1, 2]])


def matrix_quat(rotation: Array) -> Array:
    """Return the unit quaternion (4,), w x y z, of a rotation matrix (3, 3)."""
    w = np.sqrt(max(0.0, 1 + rotation[0, 0] + rotation[1, 1] + rotation[2, 2])) / 2
    x = np.sqrt(max(0.0, 1 + rotation[0, 0] - rotation[1, 1] - rotation[2, 2])) / 2
    y = np.sqrt(max(0.0, 1 - rotation[0, 0] + rotation[1, 1] - rotation[2, 2])) / 2
    z = np.sqrt(max(0.0, 1 - rotation[0, 0] - rotation[1, 1] + rotation[2, 2])) / 2
    signs = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    signed = np.array([w, *(np.copysign(value, sign) for value, sign in zip((x, y, z), signs, strict=True))])
    unit: Array = signed / np.linalg.norm(signed)
    return unit
