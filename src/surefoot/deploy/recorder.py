"""Makes an `EpisodeTrace` of a run: row by row what a simulation would record, as far as a robot can know it.

Row k is closed when the state of its end is there: observation, feedback and target are of the control step's start,
readings, torque and energy of its end. A missed step has a row too: the servos held the last target, so the row repeats
observation, feedback and target of the step before it. So rows stay one control step apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.safety import is_finite
from surefoot.deploy.wire import State
from surefoot.errors import SurefootError
from surefoot.task.trace import EpisodeTrace

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Layout:
    """Where what stands in a row of numbers."""

    motors: int
    """M"""
    legs: int
    """L"""
    observations: int
    """O"""

    @property
    def widths(self) -> dict[str, int]:
        """Numbers of each quantity, in the order of the row; `robot_time` is the state's on the robot's clock [s]."""
        return {
            "time": 1,
            "robot_time": 1,
            "roll_pitch_yaw": 3,
            "angular_velocity_base": 3,
            "motor_angle": self.motors,
            "motor_velocity": self.motors,
            "motor_torque": self.motors,
            "observation": self.observations,
            "feedback": 2 * self.legs,
            "target": self.motors,
            "energy": 1,
        }

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return sum(self.widths.values())

    def columns(self, rows: Array) -> dict[str, Array]:
        """Rows (T, width) as arrays by name, (T,) or (T, n)."""
        found: dict[str, Array] = {}
        at = 0
        for name, width in self.widths.items():
            found[name] = rows[:, at] if width == 1 else rows[:, at : at + width]
            at += width
        return found


def trace_of(layout: Layout, rows: Array, meta: dict[str, Any], truth: dict[str, Array] | None = None) -> EpisodeTrace:
    """The trace of rows (T, width); what the robot does not know is NaN.

    Args:
        layout: of the rows.
        rows: one a control step.
        meta: as the trace's.
        truth: base and feet, if somebody else has seen them; see `motion_capture`.

    Raises:
        SurefootError: no rows, or what is no trace.
    """
    steps = len(rows)
    if not steps:
        raise SurefootError("no control step was done; there is nothing to keep")
    columns = layout.columns(rows)
    columns.pop("robot_time")
    unknown = {
        "base_position_world": np.full((steps + 1, 3), np.nan),
        "base_quat_world": np.full((steps + 1, 4), np.nan),
        "foot_contact": np.full((steps, layout.legs), np.nan),
    }
    return EpisodeTrace(**columns, **(unknown | (truth or {})), meta=meta)


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
        self._open: tuple[Array, Array, Array] | None = None
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
        observation, feedback, target = self._open
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
            # The robot's counter is kept in 32 bits; one that starts anew gives nothing, not less than nothing.
            columns["energy"][0] = max(state.energy - self._energy, 0.0)
            self._energy = state.energy
            self.steps = k + 1
        return self._rows[first : self.steps]

    def open(self, observation: Array, feedback: Array, target: Array) -> None:
        """Take a control step whose command has just been sent: what its row says of its start."""
        self._open = observation, feedback, target
