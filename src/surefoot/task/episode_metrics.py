"""Metrics of episodes and of control steps, for the `info` of an environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.task.component import Component
from surefoot.task.state import EnvState


class EpisodeMetrics(Component):
    """Length and return of episodes, and metrics of those that ended."""

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Begin to count at zero."""
        state.steps[rows], state.returns[rows] = 0, 0.0

    def after_step(self, state: EnvState) -> None:
        """Count the control step."""
        state.steps += ~state.over
        state.returns += state.reward

    def info(self, state: EnvState) -> Mapping[str, Any]:
        """Return robots that diverged, and `figures` of episodes that ended: arrays (N,), zero for other robots."""
        done, diverged = state.done, state.truth.diverged
        info: dict[str, Any] = {"diverged": diverged.copy()} if diverged.any() else {}
        if not done.any():
            return info
        distance = state.truth.base_position_world[:, 0] - state.start_position[:, 0]
        time = state.readings.time
        figures = {"return": state.returns, "steps": state.steps, "distance": distance, "duration": time}
        return info | {"figures": {name: np.where(done, x, 0.0) for name, x in figures.items()}, "_figures": done}


class StepInfo(Component):
    """Description of every control step."""

    def info(self, state: EnvState) -> Mapping[str, Any]:
        """Return what `info` has of the control step that just ended, for N robots with M motors.

        `time` of the episode [s] (N,); `reward_terms`, the parts of the reward by name (N,); `velocity` (N, 3), mean
        speeds forward and to the left [m/s] and yaw rate [rad/s]; `torque` [N m] (N, M) at its end; `fell` (N,). With
        commands, the `command` that is followed and the `tracking_error`, velocity minus command, (N, 3) each.
        """
        info: dict[str, Any] = {
            "time": state.readings.time.copy(),
            "reward_terms": {name: part.copy() for name, part in state.reward_terms.items()},
            "velocity": state.planar_velocity,
            "torque": state.truth.motor_torque.copy(),
            "fell": state.terminated & ~state.truth.diverged,
        }
        if state.gait_state is not None:
            info["command"] = state.filtered_command.copy()
            info["tracking_error"] = info["velocity"] - info["command"]
        # Gymnasium's convention: which robots each entry is of.
        return info | {f"_{name}": np.ones(len(state.over), np.bool_) for name in info}
