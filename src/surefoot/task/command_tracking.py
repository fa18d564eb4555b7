"""How far robots were commanded to go and went, and the one rule by which evaluations and curricula judge it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array

SUCCESS_RANGE = (0.7, 1.25)
"""Shares of the commanded way between which a robot has kept up."""


def step_distances(command: Array, velocity: Array, duration: Array) -> tuple[Array, Array]:
    """Return the commanded way and how much of it was covered [m], of control steps (T,) or robots (N,).

    Steps whose command has no linear speed cover nothing.

    Args:
        command: speeds forward and to the left (T, 2) [m/s].
        velocity: that of the base in its heading frame (T, 2) [m/s].
        duration: of the control steps (T,) [s].
    """
    speed = np.linalg.norm(command, axis=-1)
    along = np.sum(velocity * command, axis=-1) / np.where(speed > 0, speed, 1.0)
    return speed * duration, along * duration


def is_success(commanded: Array, covered: Array, whole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether episodes came `whole` to their ends, without a fall, and covered .7 to 1.25 of their ways [m]."""
    low, high = (share * commanded for share in SUCCESS_RANGE)
    return np.asarray(whole & (low <= covered) & (covered <= high))
