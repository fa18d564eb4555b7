"""Recorder of trace rows on a robot, in the format of simulated episodes as far as the robot's sensors allow.

Row k is complete when the state at its end has arrived: observation, feedback and target are from the start of the
control step; sensor readings, torque and energy from its end. Missed steps also have rows, so that rows are always one
control step apart. The servos held the last target, so these rows repeat observation, feedback and target.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from surefoot.arrays import Array
from surefoot.columns import RowLayout
from surefoot.deploy.messages import State
from surefoot.deploy.safety import is_finite


class Recorder:
    """Records one row per control step.

    Args:
        layout: columns of a row.
        control_step: period of the rows [s].
        max_steps: maximum number of rows.
        on_rows: called with rows (n, width) when they are complete.
    """

    def __init__(
        self, layout: RowLayout, control_step: float, max_steps: int, on_rows: Callable[[Array], None] | None = None
    ) -> None:
        self.layout, self.control_step, self.max_steps, self._on_rows = layout, control_step, max_steps, on_rows
        self._rows = np.zeros((max_steps, layout.width))
        self.steps = 0
        self.missed: list[int] = []
        """Number of complete rows, and the indices of rows of missed steps."""
        self.start = math.nan
        """Start of the episode on the robot's clock [s]; not finite if unknown."""
        self._row_start: tuple[Array, Array, Array, Array, Array | None] | None = None
        self._energy = 0.0

    @property
    def rows(self) -> Array:
        """Complete rows (T, width)."""
        return self._rows[: self.steps]

    def begin(self, state: State, robot_time: float) -> None:
        """Start with the state at the beginning of the episode, and its time on the robot's clock [s]."""
        self._energy, self.start = state.energy, robot_time

    def complete_rows(self, until: int, state: State) -> None:
        """Complete all rows before control step `until`, which starts now; all but the first are missed steps.

        `state` is the latest state.
        """
        first, end = self.steps, min(until, self.max_steps)
        if self._row_start is None or end <= first or not is_finite(state):
            return
        observation, feedback, target, command, heights = self._row_start
        self.missed += range(first + 1, end)
        columns = self.layout.columns(self._rows[first:end])
        columns["time"][:] = np.arange(first + 1, end + 1) * self.control_step
        for name in ("roll_pitch_yaw", "angular_velocity_base", "motor_angle", "motor_velocity", "motor_torque"):
            columns[name][:] = getattr(state, name)
        columns["observation"][:], columns["feedback"][:], columns["target"][:] = observation, feedback, target
        if "command" in columns:
            columns["command"][:] = command
        if "accelerometer" in columns:
            columns["accelerometer"][:] = state.accelerometer
        if "height_map" in columns:
            columns["height_map"][:] = np.nan if heights is None else heights
        # If the energy counter has restarted, add nothing instead of a negative number.
        columns["energy"][0] = max(state.energy - self._energy, 0.0)
        self._energy, self.steps = state.energy, end
        if self._on_rows is not None:
            self._on_rows(self._rows[first:end])

    def start_row(
        self, observation: Array, feedback: Array, target: Array, command: Array, heights: Array | None = None
    ) -> None:
        """Start the row of a control step whose target was just sent, with its values from the start of the step."""
        self._row_start = observation, feedback, target, command, heights
