"""Commanded and covered distance, and the success criterion that evaluations and curricula share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array

SUCCESS_RANGE = (0.7, 1.25)
"""Range of the covered distance, relative to the commanded distance, that counts as success."""


def step_distances(command: Array, velocity: Array, duration: Array) -> tuple[Array, Array]:
    """Return the commanded distance and the distance covered along it [m], per control step (T,) or robot (N,).

    Both are 0 in steps whose command has no linear speed.

    Args:
        command: commanded speeds forward and to the left (T, 2) [m/s].
        velocity: velocity of the base in its heading frame (T, 2) [m/s].
        duration: duration of the control steps (T,) [s].
    """
    speed = np.linalg.norm(command, axis=-1)
    along = np.sum(velocity * command, axis=-1) / np.where(speed > 0, speed, 1.0)
    return speed * duration, along * duration


def is_success(commanded: Array, covered: Array, is_complete: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether episodes ended without a fall and covered 0.7 to 1.25 of the commanded distance.

    Args:
        commanded: commanded distances [m].
        covered: distances covered along the commands [m].
        is_complete: whether episodes lasted their full time, without a fall.
    """
    low, high = (fraction * commanded for fraction in SUCCESS_RANGE)
    return np.asarray(is_complete & (low <= covered) & (covered <= high))
