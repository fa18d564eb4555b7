"""How well robots follow commands: instantaneous error, and error averaged over a stride."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.task.component import Component
from surefoot.task.state import EnvState

STRIDE = 0.5
"""Duration of a stride [s] of gaits without a periodic reference."""


class VelocityTracking(Component):
    """Command error of N robots.

    Args:
        period: duration of a stride [s], a number or (N,); defaults to `STRIDE`.
    """

    def __init__(self, period: Array | float | None) -> None:
        self._stride = STRIDE if period is None else period

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Forget the error of the last episode."""
        state.stride_error[rows] = 0.0

    def measure(self, state: EnvState) -> None:
        """Write the errors of the control step to the state."""
        state.command_error = state.planar_velocity - state.filtered_command
        share = np.minimum(state.duration / self._stride, 1.0)[:, None]
        state.stride_error = state.stride_error + share * (state.command_error - state.stride_error)

    def after_step(self, state: EnvState) -> None:
        """Leave out control steps that do not count."""
        state.command_error[state.idle] = state.stride_error[state.idle] = 0.0
