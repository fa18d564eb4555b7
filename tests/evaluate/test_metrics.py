"""Metrics against numbers worked by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.evaluate.footfalls import FEET
from surefoot.evaluate.metrics import summarize
from surefoot.task.trace import EpisodeTrace

MakeTrace = Callable[..., EpisodeTrace]
MASS = 7.473


@pytest.fixture
def make_trace(make_run: Callable[..., EpisodeTrace]) -> MakeTrace:
    """Give what makes a steady trot at a speed [m/s] with a power [W], which ends `lateral` [m] to the left."""

    def make(
        speed: float = 0.6, power: float = 72.0, steps: int = 1000, lateral: float = 0.0, **meta: Any
    ) -> EpisodeTrace:
        clock = 0.006 * np.arange(steps + 1)
        time, phases = clock[1:], np.array([0.0, 0.5, 0.5, 0.0])
        arrays = {
            "base_position_world": np.stack([1 + speed * clock, 2 + lateral * clock / clock[-1], 0 * clock], axis=1),
            "foot_contact": (((time[:, None] - 0.003) / 0.5 - phases) % 1.0 < 0.4).astype(float),
        }
        return make_run(energy=power * 0.006 * steps, steps=steps, step=0.006, arrays=arrays, **meta)

    return make


def test_summary_by_hand(make_trace: MakeTrace) -> None:
    fall = make_trace(speed=0.6, ended="fall", steps=500)
    summary = summarize([make_trace(speed=0.5), make_trace(speed=0.7, lateral=-0.4), fall], MASS)
    by_hand = {
        "episodes": 3,
        "falls": 1,
        "steps_mean": 2500 / 3,
        "distance_mean": (3.0 + 4.2 + 1.8) / 3,
        "speed_mean": 0.6,
        "speed_std": math.sqrt(0.02 / 3),
        "power_mean": 72.0,
        "return_mean": (3.0 + 4.2 + 1.8) / 3 - 0.008 * 72.0 * (6 + 6 + 3) / 3,
        "drift_mean": 0.4 / 3,
        "cost_of_transport_mean": 72.0 / (7.473 * 9.81) * (1 / 0.5 + 1 / 0.7 + 1 / 0.6) / 3,
    }
    assert {name: summary[name] for name in by_hand} == pytest.approx(by_hand)
    assert summary["gait"] == "trot"
    assert summary["duty_factor"] == pytest.approx(dict.fromkeys(FEET, 0.4), abs=0.01)
    assert list(summary["phases"]) == list(FEET)
    assert summary["phases"]["back_left"] == pytest.approx(0.5, abs=0.01)
    # Averaged around the circle: just below 1 and just above 0 are alike.
    assert math.remainder(summary["phases"]["back_right"], 1.0) == pytest.approx(0.0, abs=0.01)
    assert summary["stance"]["front_right"] == pytest.approx(0.2, abs=0.003)
    assert (summary["world"], summary["policy"]) == ("mujoco", "trot")
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_return_uses_the_weight_of_the_trace(make_trace: MakeTrace) -> None:
    assert summarize([make_trace(energy_weight=0.0)], MASS)["return_mean"] == pytest.approx(3.6)


def test_going_backward_has_no_cost_of_transport(make_trace: MakeTrace) -> None:
    summary = summarize([make_trace(speed=-0.1)], MASS)
    assert summary["distance_mean"] == pytest.approx(-0.6)
    assert summary["cost_of_transport_mean"] is None


def test_a_robot_that_cannot_see_itself(make_trace: MakeTrace) -> None:
    trace, names = make_trace(), ("base_position_world", "base_quat_world", "foot_contact")
    robot = replace(trace, **{name: np.full_like(getattr(trace, name), np.nan) for name in names})
    summary = summarize([robot], MASS)
    assert summary["power_mean"] == pytest.approx(72.0)
    for name in ("speed_mean", "return_std", "drift_mean", "cost_of_transport_mean"):
        assert summary[name] is None
    assert summary["phases"]["back_left"] is None
    assert summary["gait"] == "other"
    json.dumps(summary, allow_nan=False)


@pytest.mark.parametrize(
    ("others", "mass", "message"),
    [
        ([{"world": "bullet"}], MASS, "more than one world: bullet, mujoco"),
        ([{"policy": "gallop"}], MASS, "more than one policy: gallop, trot"),
        ([], 0.0, "total mass 0.0 kg must be above 0"),
        (None, MASS, "at least one"),
    ],
)
def test_what_can_not_be_summed_up_is_refused(
    others: list[dict[str, str]] | None, mass: float, message: str, make_trace: MakeTrace
) -> None:
    traces = [] if others is None else [make_trace(), *(make_trace(**meta) for meta in others)]
    with pytest.raises(SurefootError, match=message):
        summarize(traces, mass)
