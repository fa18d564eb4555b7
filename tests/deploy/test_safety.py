"""The guard: each limit, with states on both sides of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.deploy.messages import Mode, Reason
from surefoot.deploy.safety import (
    GO,
    Act,
    Guard,
    NotFiniteError,
    SafetyLimits,
    Verdict,
    check_finite,
)
from surefoot.errors import SurefootError

STEP = 0.006


@pytest.fixture
def guard() -> Guard:
    return Guard(SafetyLimits(14.4, 14.0), STEP, 77)


@pytest.fixture
def judge(a_state, guard):
    """Return the verdict of a normal step with changes of the state, and of other inputs by keyword."""

    def make(time=0.0, state_age=0.001, guard=guard, missed=0, stops=0, armed=True, upright=True, **state) -> Verdict:
        return guard.check(time, replace(a_state, **state), state_age, missed, stops, armed, upright)

    return make


def tilted(roll: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    return np.array([roll, pitch, 3.0])


def test_a_normal_step_continues(guard, judge):
    assert judge() is GO
    assert guard.warnings == []


@pytest.mark.parametrize(
    ("change", "act", "reason"),
    [
        ({"state_age": 3 * STEP}, Act.GO, ""),
        ({"state_age": 3 * STEP + 1e-6}, Act.DAMP, "stale state"),
        ({"state_age": float("nan")}, Act.DAMP, "stale state"),
        ({"missed": 2}, Act.GO, ""),
        ({"missed": 3}, Act.DAMP, "late"),
        ({"session": 78}, Act.DAMP, "session"),
        ({"session": 0}, Act.DAMP, "session"),
        ({"mode": int(Mode.DISARMED)}, Act.DAMP, "mode"),
        ({"mode": int(Mode.FAULT), "reason": int(Reason.TIMEOUT)}, Act.GONE, "robot timeout"),
        ({"mode": int(Mode.FAULT), "reason": 200}, Act.GONE, "robot 200"),
        ({"mode": int(Mode.FAULT), "reason": int(Reason.MOTOR_OFF)}, Act.GONE, "robot motor off"),
        ({"reason": int(Reason.TEMPERATURE)}, Act.SIT, "robot temperature"),
        ({"reason": int(Reason.REMOTE)}, Act.SIT, "operator"),
        ({"roll_pitch_yaw": tilted(0.5, -0.5)}, Act.GO, ""),
        ({"roll_pitch_yaw": tilted(0.51)}, Act.FALL, "tilt"),
        ({"roll_pitch_yaw": tilted(pitch=-0.51)}, Act.FALL, "tilt"),
        ({"roll_pitch_yaw": tilted(float("nan"))}, Act.DAMP, "not finite"),
        ({"motor_angle": np.full(8, np.inf)}, Act.DAMP, "not finite"),
        *(
            ({name: np.array([0.0, np.nan])}, Act.DAMP, "not finite")
            for name in ("motor_velocity", "angular_velocity_base", "accelerometer")
        ),
        ({"energy": float("inf")}, Act.DAMP, "not finite"),
        ({"accelerometer": np.array([0.0, 0.0, 9.81])}, Act.GO, ""),
        ({"temperature": np.full(8, 80.0)}, Act.GO, ""),
        ({"temperature": np.array([30.0] * 7 + [81.0])}, Act.SIT, "temperature"),
        ({"stops": 1}, Act.SIT, "operator"),
        ({"stops": 2}, Act.DAMP, "operator"),
    ],
)
def test_each_limit_is_tested_on_both_sides(judge, change, act, reason):
    verdict = judge(**change)
    assert (verdict.act, verdict.reason) == (act, reason)
    assert bool(verdict.text) == (act is not Act.GO)


@pytest.mark.parametrize(("stops", "reason"), [(1, "stale state"), (2, "operator")])
def test_the_most_urgent_verdict_comes_first(judge, stops, reason):
    verdict = judge(roll_pitch_yaw=tilted(1.0), state_age=1.0, temperature=np.full(8, 99.0), stops=stops)
    assert verdict.reason == reason


@pytest.mark.parametrize(
    ("change", "act"),
    [
        ({"state_age": 1.0}, Act.DAMP),
        ({"missed": 9}, Act.DAMP),
        ({"motor_angle": np.full(8, np.nan)}, Act.DAMP),
        ({"roll_pitch_yaw": tilted(0.9)}, Act.FALL),
        ({}, Act.SIT),
    ],
)
def test_a_robot_that_asks_to_sit_is_checked_all_the_same(judge, change, act):
    assert judge(reason=int(Reason.REMOTE), **change).act is act


@pytest.mark.parametrize(
    "step",
    [
        {"roll_pitch_yaw": tilted(0.8), "upright": False},  # a fallen robot that sits down
        {"mode": int(Mode.DISARMED), "session": 0, "armed": False},
    ],
)
def test_tilt_is_ignored_after_a_fall_and_the_mode_before_arming(step, judge):
    assert judge(**step) is GO


def test_the_tasks_fall_angle_is_the_limit(judge):
    strict = Guard(SafetyLimits(14.4, 14.0), STEP, 77, tilt=0.3)
    assert judge(roll_pitch_yaw=tilted(0.31), guard=strict).act is Act.FALL


def test_low_battery_voltage_is_tolerated_for_a_second(guard, judge):
    assert judge(0.0, voltage=16.0) is GO
    assert judge(1.0, voltage=11.0) is GO
    assert judge(1.9, voltage=14.1) is GO
    assert judge(2.0, voltage=13.9) is GO
    assert judge(2.99, voltage=13.9) is GO
    verdict = judge(3.01, voltage=13.9)
    assert (verdict.act, verdict.reason) == (Act.SIT, "battery")
    fresh = Guard(SafetyLimits(14.4, 14.0), STEP, 77)
    assert judge(5.0, guard=fresh, voltage=13.0) is GO
    assert judge(6.0, guard=fresh, voltage=13.0).act is Act.SIT


def test_warnings_are_given_once(guard, judge):
    for k in range(200):
        judge(0.01 * k, voltage=14.2, temperature=np.full(8, 75.0))
    assert guard.warnings == ["a motor is hotter than 70 degC", "battery below 14.4 V; charge it soon"]


def test_numbers_that_are_not_finite_are_named():
    check_finite("target", ["a", "b"], [1.0, 2.0])
    with pytest.raises(NotFiniteError, match="target 'b' is nan; it must be finite"):
        check_finite("target", ["a", "b"], [1.0, np.nan])
    with pytest.raises(NotFiniteError, match="'a' is inf"):
        check_finite("target", ["a", "b"], [np.inf, -np.inf])


@pytest.mark.parametrize(
    ("limits", "match"),
    [
        ({"state_age": 0}, "state_age is 0; it must be a finite number over 0"),
        ({"battery_low": 15.0}, "battery_low is 15; it must not be above battery_warn"),
        ({"temperature_high": 60.0}, "temperature_warn is 70; it must not be above temperature_high"),
        ({"tilt": float("inf")}, "tilt is inf"),
    ],
)
def test_invalid_limits_are_rejected(limits, match):
    with pytest.raises(SurefootError, match=match):
        SafetyLimits(**{"battery_warn": 14.4, "battery_low": 14.0, **limits})
