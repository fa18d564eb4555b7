"""Tracking errors of velocity commands, instantaneous and averaged over a stride."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.task.component import Component
from surefoot.task.state import EnvState

DEFAULT_STRIDE = 0.5
"""Averaging time [s] for gaits without a periodic reference."""


class VelocityTracking(Component):
    """Component that computes the tracking errors of N robots.

    Args:
        period: duration of a stride [s], a number or (N,). Defaults to `DEFAULT_STRIDE`.
    """

    def __init__(self, period: Array | float | None) -> None:
        self._stride = DEFAULT_STRIDE if period is None else period

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Reset the averaged error."""
        state.stride_error[rows] = 0.0

    def measure(self, state: EnvState) -> None:
        """Write the errors of the control step to the state."""
        state.command_error = state.planar_velocity - state.filtered_command
        weight = np.minimum(state.duration / self._stride, 1.0)[:, None]
        state.stride_error = state.stride_error + weight * (state.command_error - state.stride_error)

    def after_step(self, state: EnvState) -> None:
        """Reset the errors of robots that diverged or wait for a reset."""
        state.command_error[state.idle] = state.stride_error[state.idle] = 0.0
