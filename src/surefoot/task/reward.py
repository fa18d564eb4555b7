"""Reward and fall, as pure functions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ENERGY_WEIGHT = 0.008
"""w of the paper's reward [m/J]."""


def locomotion_reward(displacement: Array, energy: Array, energy_weight: float = ENERGY_WEIGHT) -> Array:
    """Return the reward of a control step: (p_n - p_{n-1}) . d - w dt |tau . qdot|, summed over its servo steps.

    Source: Tan et al. 2018, eq. 2; the direction d is the world's x axis.

    Args:
        displacement: how far the base moved along d [m], (N,).
        energy: integral of |tau . qdot| over the step [J], (N,).
        energy_weight: w [m/J].
    """
    return displacement - energy_weight * energy


def has_fallen(roll_pitch_yaw: Array, limit: float = 0.5) -> NDArray[np.bool_]:
    """Return whether roll or pitch is beyond `limit` [rad] (N,), by true angles (N, 3).

    Tan et al. 2018, section IV-C: an episode ends when the base tilts by more than .5 rad; the axis is not stated.
    """
    return np.any(np.abs(roll_pitch_yaw[:, :2]) > limit, axis=1)
