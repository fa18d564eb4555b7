"""Statistics of a rollout, and the figures of an update."""

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
    """Figures of one update."""

    steps: int
    """Control steps so far, all robots together."""
    episodes: int
    """Episodes that ended since the last update."""
    falls: int
    """Those that ended before their time."""
    return_mean: float
    """Mean return of episodes that ended, unscaled; NaN if none did."""
    speed_mean: float
    """Mean speed of episodes that ended [m/s]; NaN if none did."""
    reward_rate: float
    """Mean reward of a control step, unscaled."""
    std_mean: float
    """Mean standard deviation of the policy's actions."""
    learning_rate: float
    value_loss: float
    surrogate_loss: float
    entropy: float
    divergences: int
    """Robots whose simulation diverged, since the start."""
    rollout_seconds: float
    learn_seconds: float
    reward: dict[str, float]
    """What each term adds to the reward, unscaled and weighted, per second."""
    rmse: dict[str, float] | None = None
    """Root mean square error of each command: mean speed [m/s] or rate [rad/s] over a control step less that which the
    gait follows; None without commands."""
    levels: dict[str, float] | None = None
    """Mean level of the robots on each kind of terrain; None without tiles."""


class RolloutStatistics:
    """Sums over the control steps of one rollout.

    Args:
        env: the robots.
    """

    def __init__(self, env: LocomotionEnv) -> None:
        self._env = env
        self._count = 0
        self._reward, self._seconds = 0.0, 0.0
        self._terms = dict.fromkeys(env.task.reward, 0.0)
        self._squared_errors = np.zeros(3)
        self._episodes: list[NDArray[np.float64]] = [np.zeros((len(_EPISODE_COLUMNS), 0))]

    def add(self, reward: Array, info: Mapping[str, Any]) -> None:
        """Add the control step that just ended: what the environment returned of it."""
        env = self._env
        self._count += 1
        self._reward += float(reward.mean())
        self._seconds += float(env.world.params.control_step.mean())
        for name, part in env.state.reward_terms.items():
            self._terms[name] += float(part.mean())
        if env.task.commands.enabled:
            self._squared_errors += (env.state.command_error**2).mean(axis=0)
        if "figures" in info:
            figures, rows = info["figures"], info["_figures"]
            self._episodes.append(np.array([figures[key][rows] for key in _EPISODE_COLUMNS]))

    def summarize(self) -> dict[str, Any]:
        """Return the fields of `UpdateMetrics` that describe the rollout."""
        env = self._env
        returns, lengths, distances, durations = np.concatenate(self._episodes, axis=1)
        rmse = map(float, np.sqrt(self._squared_errors / self._count))
        return {
            "episodes": len(returns),
            "falls": int(np.sum(lengths < env.task.max_steps)),
            "return_mean": float(np.mean(returns)) if len(returns) else float("nan"),
            "speed_mean": float(np.mean(distances / durations)) if len(returns) else float("nan"),
            "reward_rate": self._reward / self._count,
            "divergences": env.world.divergences,
            "reward": {name: total / self._seconds for name, total in self._terms.items()},
            "rmse": dict(zip(COMMANDS, rmse, strict=True)) if env.task.commands.enabled else None,
            "levels": env.metrics().get("levels"),
        }
