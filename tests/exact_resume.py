"""Check that environments resume exactly from a state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.task.env import LocomotionEnv


def assert_resumes_exactly(env: LocomotionEnv, actions: Sequence[np.ndarray]) -> None:
    """Apply actions, each (N, A), twice from the present state, and compare the observations."""
    state = env.get_state()
    first = [env.step(action)[0] for action in actions]
    env.set_state(state)
    np.testing.assert_array_equal([env.step(action)[0] for action in actions], first)
