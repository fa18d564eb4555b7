"""An IMU that is not mounted along the base's axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def read_by_mounted_imu(roll_pitch_yaw: Array, angular_velocity_base: Array, mount: Array) -> tuple[Array, Array]:
    """Return what an IMU reads whose frame is turned against the base.

    With the rotation R_b of the base in the world and R_m of the IMU in the base, the IMU's attitude is R_b R_m, and
    it reads the angular velocity R_m^T w.

    Args:
        roll_pitch_yaw: attitude of the base (N, 3) [rad]; yaw about z, then pitch about y, then roll about x.
        angular_velocity_base: w in the base frame (N, 3) [rad/s].
        mount: roll, pitch and yaw of the IMU in the base frame (N, 3) [rad].

    Returns:
        roll, pitch and yaw (N, 3) [rad], and angular velocity (N, 3) [rad/s] in the IMU's frame.
    """
    turn = Rotation.from_euler("ZYX", mount[:, ::-1])
    seen = Rotation.from_euler("ZYX", roll_pitch_yaw[:, ::-1]) * turn
    return seen.as_euler("ZYX")[:, ::-1], turn.inv().apply(angular_velocity_base)
