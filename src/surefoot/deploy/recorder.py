"""Makes an `EpisodeTrace` of a run: row by row what a simulation would record, as far as a robot can know it.

Row k is closed when the state of its end is there: observation, feedback and target are of the control step's start,
readings, torque and energy of its end. A missed step has a row too: the servos held the last target, so the row repeats
observation, feedback and target of the step before it. So rows stay one control step apart.
"""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.messages import State
from surefoot.deploy.safety import is_finite
from surefoot.task.partial_trace import Layout


class Recorder:
    """Takes control steps as they are done, and keeps their rows.

    Args:
        layout: of a row.
        control_step: time between two rows [s].
        max_steps: rows at most.
    """

    def __init__(self, layout: Layout, control_step: float, max_steps: int) -> None:
        self.layout, self.control_step = layout, control_step
        self._rows = np.zeros((max_steps, layout.width))
        self.steps = 0
        """Rows that are closed."""
        self.missed: list[int] = []
        """Rows of missed steps, from 0."""
        self._open: tuple[Array, Array, Array, Array] | None = None
        self._energy: float | None = None

    @property
    def rows(self) -> Array:
        """The closed rows (T, width)."""
        return self._rows[: self.steps]

    @property
    def max_steps(self) -> int:
        """Rows that have a place."""
        return len(self._rows)

    def begin(self, state: State) -> None:
        """Take the state of the episode's start."""
        self._energy = state.energy

    def close(self, until: int, state: State, robot_time: float) -> Array:
        """Close all rows before control step `until` with the state of now; returns the rows (n, width).

        Only the last of several can be a step that was done at its time; those after the first were missed.

        Args:
            until: number of the control step that starts now.
            state: the newest state.
            robot_time: when it was sent, on the robot's clock [s].
        """
        first = self.steps
        if self._open is None or self._energy is None or not is_finite(state):
            return self._rows[first:first]
        observation, feedback, target, command = self._open
        for k in range(first, min(until, len(self._rows))):
            if k > first:
                self.missed.append(k)
            columns = self.layout.columns(self._rows[k : k + 1])
            columns["time"][0] = (k + 1) * self.control_step
            columns["robot_time"][0] = robot_time
            for name in ("roll_pitch_yaw", "angular_velocity_base", "motor_angle", "motor_velocity", "motor_torque"):
                columns[name][0] = getattr(state, name)
            columns["observation"][0] = observation
            columns["feedback"][0] = feedback
            columns["target"][0] = target
            if self.layout.commands:
                columns["command"][0] = command
            # The robot's counter is kept in 32 bits; one that starts anew gives nothing, not less than nothing.
            columns["energy"][0] = max(state.energy - self._energy, 0.0)
            self._energy = state.energy
            self.steps = k + 1
        return self._rows[first : self.steps]

    def open(self, observation: Array, feedback: Array, target: Array, command: Array) -> None:
        """Take a control step whose target has just been sent: what its row says of its start."""
        self._open = observation, feedback, target, command
