"""Table of runs and its summaries, compared with hand-computed values."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from run_tables import policy_gap

from surefoot.api.episodes import saturation_note
from surefoot.errors import SurefootError
from surefoot.evaluation.footfalls import FEET, analyze_footfalls
from surefoot.evaluation.gap import PolicyGap
from surefoot.evaluation.runs import measure_runs, summarize, summarize_load
from surefoot.task.trace import IMPORTED_LOG, EpisodeTrace

MakeRun = Callable[..., EpisodeTrace]
MASS = 7.473


def test_metrics_of_runs_follow_from_traces(make_run: MakeRun):
    traces = [
        make_run(distance=3.0, energy=100.0, steps=200),
        make_run(distance=1.0, energy=50.0, steps=100, ended="fall"),
        make_run(distance=2.0, energy=0.0, steps=50, ended="stopped"),
    ]
    runs = measure_runs(traces)
    assert set(runs.world) == {"mujoco"}
    assert list(runs)[:4] == ["world", "run", "return", "distance"]
    np.testing.assert_allclose(runs["return"], [3.0 - 0.8, 1.0 - 0.4, 2.0])
    np.testing.assert_allclose(runs.distance, [3.0, 1.0, 2.0])
    np.testing.assert_allclose(runs.speed, [1.5, 1.0, 4.0])
    np.testing.assert_allclose(runs.power, [50.0, 50.0, 0.0])
    assert runs.steps.tolist() == [200, 100, 50]
    assert runs.fell.tolist() == [False, True, False]
    # A run that was stopped by hand is neither a fall nor a success.
    assert runs.balanced.tolist() == [True, False, False]


def test_without_a_measured_position_there_is_power_but_no_return(make_run: MakeRun):
    runs = measure_runs([make_run(distance=math.nan, world="robot") for _ in range(2)])
    assert runs[["return", "distance", "speed"]].isna().all(axis=None)
    assert runs.power.tolist() == pytest.approx([100.0, 100.0])
    gap = PolicyGap.from_runs("p", [policy_gap("p", [1.0, 2.0], {}).runs.drop(columns="policy"), runs]).gap("robot")
    assert math.isnan(gap.mean)
    assert math.isnan(gap.error)


def test_runs_of_several_worlds_are_rejected_unless_a_name_is_set(make_run: MakeRun):
    traces = [make_run(world="mujoco"), make_run(world="bullet")]
    with pytest.raises(SurefootError, match="more than one world: bullet, mujoco"):
        measure_runs(traces)
    assert set(measure_runs(traces, "both").world) == {"both"}


@pytest.fixture
def make_trace(make_run: MakeRun) -> MakeRun:
    """Return a function that makes a steady trot with a speed [m/s] and power [W], ending `lateral` [m] to the left."""

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


def test_summary_by_hand(make_trace: MakeRun) -> None:
    fall = make_trace(speed=0.6, ended="fall", steps=500)
    summary = summarize([make_trace(speed=0.5), make_trace(speed=0.7, lateral=-0.4), fall], MASS)
    by_hand = {
        "episodes": 3,
        "falls": 1,
        "steps_mean": 2500 / 3,
        "distance_mean": (3.0 + 4.2 + 1.8) / 3,
        "speed_mean": 0.6,
        "speed_std": 0.1,
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
    # Circular mean: just below 1 and just above 0 are close.
    assert math.remainder(summary["phases"]["back_right"], 1.0) == pytest.approx(0.0, abs=0.01)
    assert summary["stance"]["front_right"] == pytest.approx(0.2, abs=0.003)
    assert (summary["world"], summary["policy"]) == ("mujoco", "trot")
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_walking_backward_has_no_cost_of_transport(make_trace: MakeRun) -> None:
    summary = summarize([make_trace(speed=-0.1, energy_weight=0.0)], MASS)
    assert summary["distance_mean"] == summary["return_mean"] == pytest.approx(-0.6)
    assert summary["cost_of_transport_mean"] is None


def test_summary_of_a_robot_without_a_measured_position(make_trace: MakeRun) -> None:
    trace, names = make_trace(), ("base_position_world", "base_quat_world", "foot_contact")
    robot = replace(trace, **{name: np.full_like(getattr(trace, name), np.nan) for name in names})
    summary = summarize([robot], MASS)
    assert summary["power_mean"] == pytest.approx(72.0)
    for name in ("speed_mean", "return_std", "drift_mean", "cost_of_transport_mean"):
        assert summary[name] is None
    assert summary["phases"]["back_left"] is None
    assert summary["gait"] == "other"
    json.dumps(summary, allow_nan=False)


def test_the_hottest_motor_is_unknown_without_heat(make_run: MakeRun) -> None:
    trace = make_run(arrays={"motor_heat": np.full((100, 8), np.nan)})
    load = summarize_load([trace], 9.81 * MASS)
    assert (load["hottest_motor"], load["hottest_heat"]) == (None, None)


def test_an_imported_log_may_begin_at_any_time(make_trace: MakeRun) -> None:
    trace = make_trace()
    early = replace(trace, meta=trace.meta | {"world": IMPORTED_LOG})
    late = replace(early, time=early.time + 100.0)
    expected, summary = (summarize([one], MASS) for one in (trace, late))
    assert (summary["gait"], summary["world"]) == (expected["gait"], IMPORTED_LOG)
    assert summary["duty_factor"] == pytest.approx(expected["duty_factor"])
    assert summary["speed_mean"] == pytest.approx(expected["speed_mean"])
    assert analyze_footfalls(late).window == pytest.approx(analyze_footfalls(trace).window)


def test_summary_rejects_traces_of_several_policies(make_trace: MakeRun) -> None:
    with pytest.raises(SurefootError, match="more than one policy: gallop, trot"):
        summarize([make_trace(), make_trace(policy="gallop")], MASS)


def test_saturation_is_each_motors_fraction_of_time_at_its_limit(make_run: MakeRun) -> None:
    at_limit = np.zeros((100, 8))
    at_limit[::4, 2], at_limit[:10, 5] = 1.0, 0.5
    shares = (at_limit, np.full((100, 8), np.nan))
    traces = [make_run(steps=100, arrays={"motor_saturation": share}) for share in shares]
    assert measure_runs(traces).saturation.tolist() == pytest.approx([0.25, math.nan], nan_ok=True)
    summary = summarize(traces[:1] * 2, MASS)
    assert summary["saturation"] == pytest.approx({f"m{k}": {2: 0.25, 5: 0.05}.get(k, 0.0) for k in range(8)})
    assert saturation_note(summary) == (
        "motors limit this gait: m2 is at its limit for 25% of the time; "
        "surefoot robot check computes the torque that a trot requires"
    )
    at_limit[0, 2] = 0.9
    assert saturation_note(summarize([make_run(steps=100, arrays={"motor_saturation": at_limit})], MASS)) is None
    # Traces of a real robot lack it.
    unknown = summarize(traces[1:], MASS)
    assert set(unknown["saturation"].values()) == {None}
    assert saturation_note(unknown) is None
