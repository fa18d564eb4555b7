"""Metrics of episodes and control steps, for the `info` of an environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.task.component import Component
from surefoot.task.state import EnvState


class EpisodeMetrics(Component):
    """Length and return of each episode, and metrics of the episodes that ended."""

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Reset length and return to zero."""
        state.steps[rows], state.returns[rows] = 0, 0.0

    def after_step(self, state: EnvState) -> None:
        """Count the control step."""
        state.steps += ~state.over
        state.returns += state.reward

    def info(self, state: EnvState) -> Mapping[str, Any]:
        """Return which robots diverged, and the metrics `figures` of episodes that ended, (N,) with zero elsewhere."""
        done, diverged = state.done, state.truth.diverged
        info: dict[str, Any] = {"diverged": diverged.copy()} if diverged.any() else {}
        if not done.any():
            return info
        distance = state.truth.base_position_world[:, 0] - state.start_position[:, 0]
        time = state.readings.time
        metrics = {"return": state.returns, "steps": state.steps, "distance": distance, "duration": time}
        return info | {"figures": {name: np.where(done, x, 0.0) for name, x in metrics.items()}, "_figures": done}


class StepInfo(Component):
    """Entries of `info` that describe the control step that just ended."""

    def info(self, state: EnvState) -> Mapping[str, Any]:
        """Return quantities of the control step that just ended, for N robots with M motors.

        `time` in the episode (N,) [s]; `reward_terms`, the contributions of reward terms by name (N,); `velocity`
        (N, 3), mean speeds forward and to the left [m/s] and yaw rate [rad/s]; `torque` at the end of the step (N, M)
        [N m]; `fell` (N,). With commands also the filtered `command` and the `tracking_error`, velocity minus command,
        (N, 3) each, as the reward uses them.
        """
        info: dict[str, Any] = {
            "time": state.readings.time.copy(),
            "reward_terms": {name: part.copy() for name, part in state.reward_terms.items()},
            "velocity": state.planar_velocity,
            "torque": state.truth.motor_torque.copy(),
            "fell": state.terminated & ~state.truth.diverged,
        }
        if state.gait_state is not None:
            # The filter already has the next step's command.
            info["tracking_error"] = state.command_error.copy()
            info["command"] = info["velocity"] - info["tracking_error"]
        # By Gymnasium's convention, entries with an underscore mark the robots for which an entry is valid.
        return info | {f"_{name}": np.ones(len(state.over), np.bool_) for name in info}
