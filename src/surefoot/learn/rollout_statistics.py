"""Statistics of rollouts and metrics of updates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot.commands import COMMANDS
from surefoot.task.env import LocomotionEnv

_EPISODE_COLUMNS = ("return", "steps", "distance", "duration")


@dataclass(frozen=True)
class UpdateMetrics:
    """Metrics of one update."""

    steps: int
    """Control steps so far, of all robots together."""
    episodes: int
    """Number of episodes that ended since the last update."""
    falls: int
    """Number of these episodes that ended before their time."""
    return_mean: float
    """Mean unscaled return of these episodes; NaN if none ended."""
    speed_mean: float
    """Mean speed of these episodes [m/s]; NaN if none ended."""
    reward_rate: float
    """Mean unscaled reward of a control step."""
    std_mean: float
    """Mean standard deviation of the policy's actions."""
    learning_rate: float
    value_loss: float
    surrogate_loss: float
    entropy: float
    divergences: int
    """Number of divergences of simulated robots since the start."""
    rollout_seconds: float
    learn_seconds: float
    reward: dict[str, float]
    """Contribution of each reward term per second, weighted and unscaled."""
    rmse: dict[str, float] | None = None
    """Root mean square tracking error of each command, mean speed [m/s] or rate [rad/s] over a control step minus the
    filtered command; None without commands."""
    levels: dict[str, float] | None = None
    """Mean level of the robots on each kind of terrain; None without tiles."""


class RolloutStatistics:
    """Accumulator of statistics over the control steps of one rollout.

    Args:
        env: the environment.
    """

    def __init__(self, env: LocomotionEnv) -> None:
        self._env = env
        self._count = 0
        self._reward, self._seconds = 0.0, 0.0
        self._terms = dict.fromkeys(env.task.reward, 0.0)
        self._squared_errors = np.zeros(3)
        self._episodes: list[NDArray[np.float64]] = [np.zeros((len(_EPISODE_COLUMNS), 0))]

    def add(self, reward: Array, info: Mapping[str, Any]) -> None:
        """Add a control step.

        Args:
            reward: rewards that the environment returned (N,).
            info: `info` that the environment returned.
        """
        env = self._env
        self._count += 1
        self._reward += float(reward.mean())
        self._seconds += float(env.world.params.control_step.mean())
        for name, part in env.state.reward_terms.items():
            self._terms[name] += float(part.mean())
        if env.task.commands.enabled:
            self._squared_errors += (env.state.command_error**2).mean(axis=0)
        if "figures" in info:
            metrics, rows = info["figures"], info["_figures"]
            self._episodes.append(np.array([metrics[key][rows] for key in _EPISODE_COLUMNS]))

    def summarize(self) -> dict[str, Any]:
        """Return the fields of `UpdateMetrics` that describe the rollout."""
        env = self._env
        returns, lengths, distances, durations = np.concatenate(self._episodes, axis=1)
        whole = durations > 0  # episodes that did not end by a divergence
        rmse = map(float, np.sqrt(self._squared_errors / self._count))
        return {
            "episodes": len(returns),
            "falls": int(np.sum(lengths < env.task.max_steps)),
            "return_mean": float(np.mean(returns)) if len(returns) else float("nan"),
            "speed_mean": float(np.mean(distances[whole] / durations[whole])) if whole.any() else float("nan"),
            "reward_rate": self._reward / self._count,
            "divergences": env.world.divergences,
            "reward": {name: total / self._seconds for name, total in self._terms.items()},
            "rmse": dict(zip(COMMANDS, rmse, strict=True)) if env.task.commands.enabled else None,
            "levels": env.metrics().get("levels"),
        }
