"""An IMU whose axes are not those of the base."""

from __future__ import annotations

from numba import njit

from surefoot.arrays import Array
from surefoot.rotations import rpy_quat
from surefoot.world.drive import quat_product, roll_pitch_yaw, turned_back

_rpy_quat = njit(cache=True)(rpy_quat)


@njit(cache=True)
def read_by_mounted_imu(attitude: Array, rates: Array, mount: Array) -> None:
    """Transform attitudes and rates of bases into readings of IMUs with other orientations.

    With the rotation R_b of the base in the world and R_m of the IMU in the base, the IMU's attitude is R_b R_m, and
    it reads the angular velocity R_m^T w.

    Args:
        attitude: roll, pitch and yaw (N, 3) [rad]; yaw about z, then pitch about y, then roll about x; updated.
        rates: angular velocity w in the base frame (N, 3) [rad/s]; updated.
        mount: roll, pitch and yaw of the IMU in the base frame (N, 3) [rad].
    """
    for i in range(len(attitude)):
        base = _rpy_quat(attitude[i, 0], attitude[i, 1], attitude[i, 2])
        imu = _rpy_quat(mount[i, 0], mount[i, 1], mount[i, 2])
        attitude[i, 0], attitude[i, 1], attitude[i, 2] = roll_pitch_yaw(*quat_product(base, imu))
        rates[i, 0], rates[i, 1], rates[i, 2] = turned_back(imu, (rates[i, 0], rates[i, 1], rates[i, 2]))
