"""Statistics of a rollout, worked by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surefoot.learn.rollout_statistics import RolloutStatistics


def robots(commands: bool, levels: dict[str, float] | None = None) -> Any:
    """Return a fake environment of two robots with a control step of 0.02 s and episodes of 100 steps."""
    return SimpleNamespace(
        task=SimpleNamespace(reward={"progress": 1.0}, max_steps=100, commands=SimpleNamespace(enabled=commands)),
        world=SimpleNamespace(params=SimpleNamespace(control_step=np.array([0.02, 0.02])), divergences=3),
        state=SimpleNamespace(reward_terms={}, command_error=np.zeros((2, 3))),
        metrics=lambda: {} if levels is None else {"levels": levels},
    )


def test_metrics_of_two_control_steps():
    env = robots(commands=True, levels={"stairs": 1.5})
    statistics = RolloutStatistics(env)
    env.state.reward_terms = {"progress": np.array([1.0, 3.0])}
    env.state.command_error = np.array([[0.1, 0.0, 1.0], [0.7, 0.0, 1.0]])
    statistics.add(np.array([1.0, 2.0]), {})
    env.state.reward_terms = {"progress": np.array([0.0, 2.0])}
    env.state.command_error = np.array([[0.5, 0.0, 1.0], [0.5, 0.0, 1.0]])
    # The first robot fell after 50 steps: 2 m in 4 s. The episode of the second one continues.
    ended = {"return": [5.0, 0.0], "steps": [50, 0], "distance": [2.0, 0.0], "duration": [4.0, 0.0]}
    metrics = {name: np.array(column) for name, column in ended.items()}
    statistics.add(np.array([0.0, 1.0]), {"figures": metrics, "_figures": np.array([True, False])})
    summary = statistics.summarize()
    rmse = summary.pop("rmse")
    assert rmse == {
        "forward": pytest.approx(0.5),  # squares 0.01, 0.49, 0.25 and 0.25 have a mean of 0.25
        "sideways": 0.0,
        "yaw_rate": pytest.approx(1.0),
    }
    assert summary == {
        "episodes": 1,
        "falls": 1,
        "return_mean": 5.0,
        "speed_mean": 0.5,
        "reward_rate": 1.0,
        "divergences": 3,
        "reward": {"progress": pytest.approx(3.0 / 0.04)},
        "levels": {"stairs": 1.5},
    }


def test_a_diverged_episode_has_no_speed():
    statistics = RolloutStatistics(robots(commands=False))
    ended = {"return": [5.0, 1.0], "steps": [50, 3], "distance": [2.0, 0.0], "duration": [4.0, 0.0]}
    metrics = {name: np.array(column) for name, column in ended.items()}
    statistics.add(np.zeros(2), {"figures": metrics, "_figures": np.array([True, True])})
    summary = statistics.summarize()
    assert (summary["episodes"], summary["speed_mean"]) == (2, 0.5)


def test_an_episode_of_full_length_is_no_fall_and_none_has_no_mean():
    env = robots(commands=False)
    statistics = RolloutStatistics(env)
    statistics.add(np.zeros(2), {})
    summary = statistics.summarize()
    assert (summary["rmse"], summary["levels"], summary["episodes"], summary["falls"]) == (None, None, 0, 0)
    assert math.isnan(summary["return_mean"])
    assert math.isnan(summary["speed_mean"])
    metrics = {name: np.array([100.0, 100.0]) for name in ("return", "steps", "distance", "duration")}
    statistics.add(np.zeros(2), {"figures": metrics, "_figures": np.array([True, True])})
    summary = statistics.summarize()
    assert (summary["episodes"], summary["falls"]) == (2, 0)
