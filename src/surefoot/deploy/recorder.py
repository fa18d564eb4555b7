"""Rows of an `EpisodeTrace` of a run, as a simulation would record them, as far as a robot's sensors allow.

Row k is closed when the state at its end has arrived: observation, feedback and target belong to the control step's
start; readings, torque and energy to its end. A missed step has a row too. The servos held the last target, so the row
repeats observation, feedback and target of the step before it. Rows stay one control step apart.
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
    """Takes control steps as they are done, and keeps their rows, one every `control_step` [s].

    `on_rows` is called with rows (n, width) when they are closed.
    """

    def __init__(
        self, layout: RowLayout, control_step: float, max_steps: int, on_rows: Callable[[Array], None] | None = None
    ) -> None:
        self.layout, self.control_step, self.max_steps, self._on_rows = layout, control_step, max_steps, on_rows
        self._rows = np.zeros((max_steps, layout.width))
        self.steps = 0
        self.missed: list[int] = []
        """Number of rows that are closed, and the rows of missed steps, from 0."""
        self.start = math.nan
        """The robot's time at the start of the episode [s]; infinite, if it is not known."""
        self._open: tuple[Array, Array, Array, Array, Array | None] | None = None
        self._energy = 0.0

    @property
    def rows(self) -> Array:
        """The closed rows (T, width)."""
        return self._rows[: self.steps]

    def begin(self, state: State, robot_time: float) -> None:
        """Take the state at the start of the episode, and the robot's time then [s]."""
        self._energy, self.start = state.energy, robot_time

    def close(self, until: int, state: State) -> None:
        """Close all rows before control step `until`, which starts now; rows after the first were missed.

        `state` is the newest state.
        """
        first, end = self.steps, min(until, self.max_steps)
        if self._open is None or end <= first or not is_finite(state):
            return
        observation, feedback, target, command, heights = self._open
        self.missed += range(first + 1, end)
        columns = self.layout.columns(self._rows[first:end])
        columns["time"][:] = np.arange(first + 1, end + 1) * self.control_step
        for name in ("roll_pitch_yaw", "angular_velocity_base", "motor_angle", "motor_velocity", "motor_torque"):
            columns[name][:] = getattr(state, name)
        columns["observation"][:], columns["feedback"][:], columns["target"][:] = observation, feedback, target
        if "command" in columns:
            columns["command"][:] = command
        if "height_map" in columns:
            columns["height_map"][:] = np.nan if heights is None else heights
        # A counter of energy that has started anew adds nothing, rather than a negative number.
        columns["energy"][0] = max(state.energy - self._energy, 0.0)
        self._energy, self.steps = state.energy, end
        if self._on_rows is not None:
            self._on_rows(self._rows[first:end])

    def open(
        self, observation: Array, feedback: Array, target: Array, command: Array, heights: Array | None = None
    ) -> None:
        """Take a control step whose target has just been sent: what its row has of its start."""
        self._open = observation, feedback, target, command, heights
