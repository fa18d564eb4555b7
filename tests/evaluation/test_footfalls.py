"""Footfalls: known gaits are recognized with their names, periods, duty factors and phases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from surefoot.evaluation.footfalls import (
    FEET,
    STANDING_REASON,
    Footfalls,
    analyze_footfalls,
    classify,
    stance_intervals,
)

STEP = 0.006
PHASES = {  # by FEET: front_left, back_left, front_right, back_right
    "trot": (0.0, 0.5, 0.5, 0.0),
    "pace": (0.0, 0.0, 0.5, 0.5),
    "bound": (0.0, 0.5, 0.0, 0.5),
    "pronk": (0.0, 0.0, 0.0, 0.0),
    "walk": (0.0, 0.75, 0.5, 0.25),  # lateral sequence: each hind foot, then the fore foot of its side
    "gallop": (0.0, 0.5, 0.1, 0.6),
}


def contacts(
    phases: tuple[float, ...],
    duty: float = 0.4,
    period: float = 0.5,
    seconds: float = 6.0,
    jitter: float = 0.0,
    seed: int = 0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return contact fractions (T, 4) and times of a gait; jitter is the standard deviation of touchdowns [strides]."""
    rng = np.random.default_rng(seed)
    fine = np.arange(round(seconds / 0.001)) * 0.001 + 0.0005  # servo steps
    touch = np.zeros((len(fine), len(phases)))
    for foot, phase in enumerate(phases):
        for stride in range(-1, math.ceil(seconds / period) + 1):
            start = (stride + phase + jitter * rng.normal()) * period
            touch[(fine >= start) & (fine < start + duty * period), foot] = 1.0
    whole = len(fine) // 6
    fractions = touch[: whole * 6].reshape(whole, 6, -1).mean(axis=1)
    return fractions, STEP * np.arange(1, whole + 1)


def analyzed(touch: NDArray[np.float64], time: NDArray[np.float64], names: Sequence[str] = FEET) -> Footfalls:
    trace: Any = SimpleNamespace(foot_contact=touch, elapsed=time, leg_names=tuple(names))
    return analyze_footfalls(trace)


@pytest.mark.parametrize("gait", PHASES)
@pytest.mark.parametrize("period", [0.15, 0.3, 0.5, 0.9])
def test_known_gaits_are_recognized(gait: str, period: float) -> None:
    duty = 0.7 if gait == "walk" else 0.4
    feet = analyzed(*contacts(PHASES[gait], duty, period))
    assert feet.gait == gait, feet.reason
    assert feet.reason == ""
    assert feet.stride_period == pytest.approx(period, rel=0.01)
    for foot, phase in zip(FEET, PHASES[gait], strict=True):
        assert math.remainder(feet.phase[foot] - phase, 1.0) == pytest.approx(0.0, abs=0.01)
        assert 0.0 <= feet.phase[foot] < 1.0
        assert feet.concentration[foot] > 0.99
        assert feet.duty_factor[foot] == pytest.approx(duty, abs=0.01)
        assert feet.stance[foot] == pytest.approx(duty * period, abs=0.002)


@pytest.mark.parametrize("gait", PHASES)
@pytest.mark.parametrize("seed", range(3))
def test_jitter_and_chatter_do_not_change_the_name(gait: str, seed: int) -> None:
    duty = 0.7 if gait == "walk" else 0.35
    feet = analyzed(*contacts(PHASES[gait], duty, 0.3, jitter=0.03, seed=seed))
    assert feet.gait == gait, feet.reason
    touch, time = contacts(PHASES[gait], duty, 0.4)
    chatter = np.random.default_rng(seed).random(touch.shape) < 0.05
    feet = analyzed(np.where(chatter, 1.0 - touch, touch), time)
    assert feet.gait == gait, feet.reason
    assert feet.stride_period == pytest.approx(0.4, rel=0.02)


def test_gaits_depend_on_leg_names_not_on_their_order() -> None:
    touch, time = contacts(PHASES["pace"])
    order = [2, 1, 3, 0]
    feet = analyzed(touch[:, order], time, [FEET[i] for i in order])
    assert feet.gait == "pace"
    assert feet.phase["front_right"] == pytest.approx(0.5, abs=0.01)
    assert feet.phase["back_left"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(
    ("phases", "gait", "pattern"),
    [
        ((0.0, 0.6, 0.1, 0.7), "gallop", "transverse gallop"),
        ((0.0, 0.6, 0.1, 0.5), "gallop", "rotary gallop"),
        ((0.0, 0.5, 0.2, 0.5), "gallop", "half-bound"),
        ((0.0, 0.4, 0.3, 0.7), "gallop", "transverse gallop"),  # the three beats of a canter
        ((0.0, 0.95, 0.5, 0.45), "pace", "running pace"),
        ((0.0, 0.25, 0.5, 0.75), "other", "diagonal-sequence run"),
        ((0.0, 0.75, 0.5, 0.25), "other", "lateral-sequence run"),
        ((0.0, 0.5, 0.5, 0.5), "other", "other"),
        ((0.0, 0.0, 0.2, 0.2), "other", "other"),
    ],
)
def test_patterns_of_known_phases(phases: tuple[float, ...], gait: str, pattern: str) -> None:
    feet = analyzed(*contacts(phases, duty=0.35))
    assert (feet.gait, feet.pattern) == (gait, pattern)
    assert bool(feet.reason) == (gait == "other")


def test_walking_and_running_differ_by_duty_factor() -> None:
    assert analyzed(*contacts(PHASES["trot"], duty=0.6)).pattern == "walking trot"
    assert analyzed(*contacts(PHASES["trot"], duty=0.4)).pattern == "running trot"
    feet = analyzed(*contacts(PHASES["gallop"], duty=0.75))
    assert feet.gait == "other"
    assert "duty factor 0.75" in feet.reason


@pytest.mark.parametrize("foot", range(4))
@pytest.mark.parametrize(("value", "reason"), [(0.0, "never touches down"), (1.0, "never leaves the ground")])
def test_the_reason_names_a_foot_without_steps(foot: int, value: float, reason: str) -> None:
    touch, time = contacts(PHASES["trot"])
    touch[:, foot] = value
    feet = analyzed(touch, time)
    assert (feet.gait, feet.reason) == ("other", f"{FEET[foot]} {reason}")
    assert feet.duty_factor[FEET[foot]] == pytest.approx(value)
    assert math.isnan(feet.phase[FEET[foot]])
    assert feet.stride_period == pytest.approx(0.5, rel=0.01)


def test_the_reason_names_a_foot_that_skips_or_doubles_steps() -> None:
    touch, time = contacts(PHASES["trot"])
    skipping = touch.copy()
    skipping[time % 1.0 > 0.5, 1] = 0.0
    assert "back_left touches down 0.5" in analyzed(skipping, time).reason
    twice, _ = contacts(PHASES["trot"], period=0.25)
    touch[:, 1] = twice[:, 1]
    assert "back_left touches down 2" in analyzed(touch, time).reason


def test_random_feet_have_no_gait() -> None:
    for seed in range(10):
        feet = analyzed(*contacts(PHASES["trot"], jitter=0.3, seed=seed))
        assert feet.gait == "other"
        assert feet.reason


def test_a_drifting_foot_has_low_concentration() -> None:
    touch, time = contacts(PHASES["trot"])
    slower, _ = contacts(PHASES["trot"], period=0.56)
    touch[:, 3] = slower[:, 3]
    feet = analyzed(touch, time)
    assert feet.gait == "other"
    assert "back_right has no steady phase" in feet.reason
    assert feet.concentration["back_right"] < 0.5 < feet.concentration["back_left"]


def test_the_transient_is_left_out() -> None:
    touch, time = contacts(PHASES["bound"], period=0.4)
    start, _ = contacts(PHASES["pace"], period=0.23)
    touch[time < 1.0] = start[time < 1.0]
    feet = analyzed(touch, time)
    assert feet.gait == "bound"
    assert feet.window == (1.0, pytest.approx(6.0))


def test_episodes_with_too_few_strides_have_no_gait() -> None:
    feet = analyzed(*contacts(PHASES["trot"], period=0.3, seconds=1.8))
    assert feet.gait == "trot"
    feet = analyzed(*contacts(PHASES["trot"], period=0.5, seconds=1.4))
    assert feet.gait == "other"
    for steps in (1, 2, 3, 10):
        feet = analyzed(np.ones((steps, 4)), STEP * np.arange(1, steps + 1))
        assert feet.gait == "other"
        assert feet.reason


@pytest.mark.parametrize(("value", "duty"), [(0.0, 0.0), (1.0, 1.0), (np.nan, np.nan)])
def test_constant_contacts_have_no_gait(value: float, duty: float) -> None:
    feet = analyzed(np.full((1000, 4), value), STEP * np.arange(1, 1001))
    assert feet.gait == "other"
    assert math.isnan(feet.stride_period)
    assert feet.duty_factor["front_left"] == pytest.approx(duty, nan_ok=True)
    assert (feet.reason == "foot contacts were not measured") == math.isnan(value)


def test_other_leg_names_have_metrics_but_no_gait() -> None:
    touch, time = contacts((0.0, 0.5))
    feet = analyzed(touch, time, ["front_left", "right"])
    assert feet.gait == "other"
    assert feet.phase["right"] == pytest.approx(0.5, abs=0.01)


def test_stance_intervals_by_hand() -> None:
    time = np.arange(1, 11) * 0.01
    contact = [0, 0.25, 1, 1, 0.75, 0, 0, 1, 0, 0]
    # Contact from 0.0175 (last quarter of the second step) to 0.0475 (three quarters of the fifth); then one step.
    assert stance_intervals(contact, time) == (pytest.approx((0.0175, 0.0475)), pytest.approx((0.07, 0.08)))
    assert stance_intervals(contact, time, debounce=0.02) == (pytest.approx((0.0175, 0.0475)),)
    assert stance_intervals(contact, time, debounce=0.03) == (pytest.approx((0.0175, 0.08)),)
    assert stance_intervals([1] * 10, time, debounce=0.03) == (pytest.approx((0.0, 0.1)),)
    assert stance_intervals([0] * 10, time) == ()


def test_the_reason_describes_standing_robots_and_idle_feet() -> None:
    time = np.arange(1, 601) * 0.01
    touch = np.ones((600, 4))
    assert analyzed(touch, time).reason == STANDING_REASON
    touch[:, 2] = 0.0
    touch[:, 3] = np.arange(600) % 40 < 20
    reason = analyzed(touch, time).reason
    assert reason == "front_left and back_left never leave the ground; front_right never touches down"


def test_the_reason_names_the_pair_that_does_not_alternate() -> None:
    phase = dict(zip(FEET, (0.0, 0.5, 0.5, 0.5), strict=True))
    assert classify(phase, 0.5)[2] == "the fore feet alternate and the hind feet do not"
    phase = dict(zip(FEET, (0.0, 0.0, 0.0, 0.5), strict=True))
    assert classify(phase, 0.5)[2] == "the hind feet alternate and the fore feet do not"
