"""Inputs that the processes of `rivals.py` share; numpy is all that a rival's interpreter needs for it."""

from __future__ import annotations

from typing import Any

import numpy as np

EVALUATION_SEED = 7_000_003
"""Seed of the robots on which policies are evaluated, other than the seeds of trainings."""
BLOCK = 64
"""Number of different random targets or actions, which are repeated."""
TARGET_NOISE = 0.1
"""Standard deviation of random motor angles around the standing pose [rad]."""
ACTION_NOISE = 0.15
"""Standard deviation of random actions."""


def random_targets(standing: Any, num_envs: int) -> Any:
    """Return random motor angles (BLOCK, N, M) [rad] around those of a standing robot (M,), always the same."""
    return standing + np.random.default_rng(0).normal(0.0, TARGET_NOISE, (BLOCK, num_envs, len(standing)))


def random_actions(num_envs: int, count: int) -> Any:
    """Return random actions (BLOCK, N, A) from -1 to 1, always the same."""
    noise = np.random.default_rng(0).normal(0.0, ACTION_NOISE, (BLOCK, num_envs, count))
    return np.clip(noise, -1.0, 1.0)
