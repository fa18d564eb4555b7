"""Metrics against numbers worked by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.evaluate.footfalls import FEET
from surefoot.evaluate.metrics import episode_metrics, summarize
from surefoot.task.trace import EpisodeTrace

MakeTrace = Callable[..., EpisodeTrace]
MASS = 7.473
KEYS = {
    *("episodes", "falls", "steps_mean", "distance_mean", "speed_mean", "speed_std", "power_mean"),
    *("return_mean", "return_std", "drift_mean", "gait", "duty_factor", "phases", "world", "policy"),
}


@pytest.fixture
def make_trace(make_run: Callable[..., EpisodeTrace]) -> Callable[..., EpisodeTrace]:
    """Give what makes a steady trot at a speed [m/s] with a power [W], that turns by `turn` rad."""

    def make(
        speed: float = 0.6, power: float = 72.0, steps: int = 1000, lateral: float = 0.0, turn: float = 0.0, **meta: Any
    ) -> EpisodeTrace:
        clock = 0.006 * np.arange(steps + 1)
        time, share, zero = clock[1:], clock / clock[-1], np.zeros(steps + 1)
        yaw, phases = turn * share, np.array([0.0, 0.5, 0.5, 0.0])
        arrays = {
            "base_position_world": np.stack([1 + speed * clock, 2 + lateral * share, zero + 0.2], axis=1),
            "base_quat_world": np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1),
            "roll_pitch_yaw": np.outer((yaw[1:] + math.pi) % math.tau - math.pi, [0.0, 0.0, 1.0]),
            "foot_contact": (((time[:, None] - 0.003) / 0.5 - phases) % 1.0 < 0.4).astype(float),
        }
        return make_run(energy=power * 0.006 * steps, steps=steps, step=0.006, arrays=arrays, **meta)

    return make


def test_one_episode_by_hand(make_trace: MakeTrace) -> None:
    metrics = episode_metrics(make_trace(speed=0.6, power=72.0, lateral=-0.25, turn=0.3), MASS)
    assert metrics.steps == 1000
    assert metrics.duration == pytest.approx(6.0)
    assert metrics.distance == pytest.approx(3.6)
    assert metrics.speed == pytest.approx(0.6)
    assert metrics.power == pytest.approx(72.0)
    assert metrics.return_ == pytest.approx(3.6 - 0.008 * 72.0 * 6.0)  # .144
    assert metrics.cost_of_transport == pytest.approx(72.0 / (7.473 * 9.81 * 0.6))  # 1.637
    assert metrics.drift == pytest.approx(0.25)
    assert metrics.heading_change == pytest.approx(0.3)
    assert not metrics.fell


def test_return_uses_the_weight_of_the_trace(make_trace: MakeTrace) -> None:
    assert episode_metrics(make_trace(energy_weight=0.0)).return_ == pytest.approx(3.6)


def test_more_than_a_full_turn_counts(make_trace: MakeTrace) -> None:
    assert episode_metrics(make_trace(turn=-7.0)).heading_change == pytest.approx(-7.0)


def test_going_backward_has_no_cost_of_transport(make_trace: MakeTrace) -> None:
    metrics = episode_metrics(make_trace(speed=-0.1), MASS)
    assert metrics.distance == pytest.approx(-0.6)
    assert math.isnan(metrics.cost_of_transport)


def test_a_robot_that_cannot_see_itself(make_trace: MakeTrace) -> None:
    trace = make_trace(turn=4.0)
    blind = {f: getattr(trace, f).copy() for f in trace.__dataclass_fields__ if f != "meta"}
    for name in ("base_position_world", "base_quat_world", "foot_contact"):
        blind[name][:] = np.nan
    robot = EpisodeTrace(**blind, meta=trace.meta)
    metrics = episode_metrics(robot, MASS)
    assert math.isnan(metrics.speed)
    assert metrics.power == pytest.approx(72.0)
    assert metrics.heading_change == pytest.approx(4.0, abs=0.01)  # from the IMU, from its first reading on
    summary = summarize([robot], MASS)
    assert summary["speed_mean"] is None
    assert summary["return_std"] is None
    assert summary["phases"]["back_left"] is None
    assert summary["gait"] == "other"
    json.dumps(summary, allow_nan=False)


def test_summary_by_hand(make_trace: MakeTrace) -> None:
    fall = make_trace(speed=0.6, ended="fall", steps=500)
    traces = [make_trace(speed=0.5), make_trace(speed=0.7, lateral=0.4), fall]
    summary = summarize(traces, MASS)
    assert set(summary) >= KEYS
    assert summary["episodes"] == 3
    assert summary["falls"] == 1
    assert summary["steps_mean"] == pytest.approx(2500 / 3)
    assert summary["distance_mean"] == pytest.approx((3.0 + 4.2 + 1.8) / 3)
    assert summary["speed_mean"] == pytest.approx(0.6)
    assert summary["speed_std"] == pytest.approx(math.sqrt(0.02 / 3))
    assert summary["power_mean"] == pytest.approx(72.0)
    assert summary["drift_mean"] == pytest.approx(0.4 / 3)
    assert summary["gait"] == "trot"
    assert summary["duty_factor"] == pytest.approx(dict.fromkeys(FEET, 0.4), abs=0.01)
    assert list(summary["phases"]) == list(FEET)
    assert summary["phases"]["back_left"] == pytest.approx(0.5, abs=0.01)
    assert summary["stance"]["front_right"] == pytest.approx(0.2, abs=0.003)
    assert (summary["world"], summary["policy"]) == ("mujoco", "trot")
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_phases_are_averaged_around_the_circle(make_trace: MakeTrace) -> None:
    phase = summarize([make_trace(), make_trace(steps=800)], MASS)["phases"]["back_right"]
    assert math.remainder(phase, 1.0) == pytest.approx(0.0, abs=0.01)


def test_two_worlds_are_not_averaged_by_accident(make_trace: MakeTrace) -> None:
    traces = [make_trace(), make_trace(world="bullet")]
    with pytest.raises(SurefootError, match="more than one world: bullet, mujoco"):
        summarize(traces, MASS)
    assert summarize(traces, MASS, world="both")["world"] == "both"


def test_a_summary_needs_episodes_and_a_mass(make_trace: MakeTrace) -> None:
    with pytest.raises(SurefootError, match="at least one"):
        summarize([], MASS)
    with pytest.raises(SurefootError, match="above 0"):
        summarize([make_trace()], 0.0)
