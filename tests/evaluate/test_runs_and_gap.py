"""The table of runs, what it sums up to, and the reality gap, against numbers worked by hand."""

from __future__ import annotations

import csv
import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.evaluate.footfalls import FEET
from surefoot.evaluate.gap import PolicyGap, away_task, home_task
from surefoot.evaluate.runs import Estimate, Runs, summarize
from surefoot.tables import plain_value, write_csv
from surefoot.task.config import TaskConfig
from surefoot.task.trace import EpisodeTrace

MakeRun = Callable[..., EpisodeTrace]
MASS = 7.473


def runs_of(*returns: float, world: str = "mujoco", fell: bool = False) -> Runs:
    """Runs with these returns, each 1 m/s at 10 W."""
    numbers = np.array(returns)
    ones, flags = np.ones(len(numbers)), np.full(len(numbers), fell)
    return Runs(world, numbers, numbers + 1, ones, 10 * ones, 100 * ones, flags, ~flags)


@pytest.mark.parametrize(
    ("values", "mean", "error"),
    [
        # Deviations -1, 0, 1: variance 1, of the mean 1/3.
        ([1.0, 2.0, 3.0], 2.0, 1 / math.sqrt(3)),
        # What is not known is left out.
        ([math.nan, 1.0, 3.0], 2.0, 1.0),
        ([math.nan, 4.0], 4.0, math.nan),
        ([math.nan, math.nan], math.nan, math.nan),
        ([], math.nan, math.nan),
    ],
)
def test_an_estimate_is_the_mean_and_its_standard_error(values: list[float], mean: float, error: float):
    assert vars(Estimate.of(values)) == pytest.approx({"mean": mean, "error": error}, nan_ok=True)


def test_errors_of_a_difference_add_in_squares():
    assert Estimate(5.0, 0.3) - Estimate(3.0, 0.4) == Estimate(2.0, pytest.approx(0.5))


def test_runs_are_measured_from_traces(make_run: MakeRun):
    traces = [
        make_run(distance=3.0, energy=100.0, steps=200),
        make_run(distance=1.0, energy=50.0, steps=100, ended="fall"),
        make_run(distance=2.0, energy=0.0, steps=50, ended="stopped"),
    ]
    runs = Runs.of_traces(traces)
    assert (runs.world, len(runs)) == ("mujoco", 3)
    np.testing.assert_allclose(runs.returns, [3.0 - 0.8, 1.0 - 0.4, 2.0])
    np.testing.assert_allclose(runs.distance, [3.0, 1.0, 2.0])
    np.testing.assert_allclose(runs.speed, [1.5, 1.0, 4.0])
    np.testing.assert_allclose(runs.power, [50.0, 50.0, 0.0])
    assert runs.steps.tolist() == [200, 100, 50]
    assert runs.fell.tolist() == [False, True, False]
    # Stopped by hand is no fall, and no success either.
    assert runs.balanced.tolist() == [True, False, False]
    assert runs.success_rate == pytest.approx(1 / 3)


def test_a_robot_that_is_not_seen_tells_its_power(make_run: MakeRun):
    runs = Runs.of_traces([make_run(distance=math.nan, energy=100.0, steps=100, world="robot") for _ in range(2)])
    assert np.isnan(runs.returns).all()
    assert np.isnan(runs.speed).all()
    assert runs.estimate("power") == Estimate(pytest.approx(100.0), pytest.approx(0.0))
    assert runs.success_rate == 1.0
    gap = PolicyGap("p", runs_of(1.0, 2.0), (runs,)).gap("robot")
    assert math.isnan(gap.mean)
    assert math.isnan(gap.error)


def test_worlds_are_not_mixed(make_run: MakeRun):
    traces = [make_run(world="mujoco"), make_run(world="bullet")]
    with pytest.raises(SurefootError, match="more than one world: bullet, mujoco"):
        Runs.of_traces(traces)
    assert Runs.of_traces(traces, "both").world == "both"
    with pytest.raises(SurefootError, match="no runs"):
        Runs.of_traces([])


def test_the_gap_is_home_less_away():
    policy = PolicyGap("p", runs_of(4.0, 6.0), (runs_of(1.0, 3.0, world="bullet"), runs_of(6.0, world="robot")))
    assert policy.gap("bullet") == Estimate(3.0, pytest.approx(math.sqrt(2)))
    assert policy.gap("robot").mean == -1.0
    assert math.isnan(policy.gap("robot").error)
    with pytest.raises(SurefootError, match="no runs in 'moon'; worlds: bullet, robot"):
        policy.gap("moon")


def test_pooled_policies_are_all_their_runs():
    first = PolicyGap("a", runs_of(4.0, 6.0), (runs_of(1.0, world="bullet", fell=True),))
    second = PolicyGap("b", runs_of(10.0), (runs_of(3.0, 5.0, world="bullet"),))
    pooled = PolicyGap.pooled("both", [first, second])
    assert pooled.home.returns.tolist() == [4.0, 6.0, 10.0]
    assert pooled.away[0].returns.tolist() == [1.0, 3.0, 5.0]
    assert pooled.away[0].success_rate == pytest.approx(2 / 3)
    # The policies' own gaps are 5 - 1 and 10 - 4.
    assert pooled.gap("bullet") == Estimate(5.0, pytest.approx(1.0))
    # Worlds are pooled by name and not by place.
    worlds = [tuple(runs_of(1.0, world=name) for name in names) for names in ("x", "xy", "yx")]
    for one, other in itertools.combinations(worlds, 2):
        with pytest.raises(SurefootError, match="different worlds"):
            PolicyGap.pooled("both", [PolicyGap("a", runs_of(1.0), one), PolicyGap("b", runs_of(1.0), other)])


def test_runs_come_back_from_json(make_run: MakeRun):
    runs = Runs.of_traces([make_run(3.0, ended="fall"), make_run(math.nan)])
    text = json.dumps(runs.to_mapping(), allow_nan=False)
    again = Runs.from_mapping(json.loads(text))
    assert again.world == runs.world
    for name in ("returns", "distance", "speed", "power", "steps", "fell", "balanced"):
        np.testing.assert_array_equal(getattr(again, name), getattr(runs, name))
        assert getattr(again, name).dtype == getattr(runs, name).dtype


def test_a_row_for_each_world_and_for_each_run(tmp_path: Path):
    policy = PolicyGap("p", runs_of(3.0, 5.0), (runs_of(1.0, 3.0, world="bullet"), runs_of(math.nan, world="robot")))
    home, bullet, robot = policy.rows()
    assert [row["side"] for row in (home, bullet, robot)] == ["home", "away", "away"]
    assert [home[name] for name in ("return_mean", "return_error", "power_mean", "runs", "falls")] == [4, 1, 10, 2, 0]
    assert (bullet["gap"], bullet["gap_error"]) == (2, pytest.approx(math.sqrt(2)))
    unknown = [home["gap"], robot["gap"], robot["gap_error"], robot["return_mean"]]
    assert [plain_value(value) for value in unknown] == [None] * 4
    with write_csv(tmp_path / "deep" / "gap.csv", policy.rows()).open() as file:
        written = list(csv.DictReader(file))
    assert [(row["world"], row["gap"], row["power_mean"]) for row in written] == [
        ("mujoco", "", "10"), ("bullet", "2", "10"), ("robot", "", "10"),
    ]  # fmt: skip
    first, second = policy.home.rows()
    assert (second["run"], second["return"], second["distance"], second["balanced"]) == (1, 5.0, 6.0, True)
    assert list(first) == ["run", "return", "distance", "speed", "power", "steps", "fell", "balanced"]
    assert [row["gap (m)"] for row in policy.text_rows()] == ["", "+2.00 ± 1.41", "-"]


@pytest.mark.parametrize(
    ("estimate", "options", "text"),
    [
        (Estimate(1.2, 0.05), {}, "1.20 ± 0.05"),
        (Estimate(1.2, math.nan), {}, "1.20"),
        (Estimate(math.nan, math.nan), {}, "-"),
        (Estimate(1.2, 0.05), {"sign": True, "digits": 1}, "+1.2 ± 0.1"),
        (Estimate(-1.2, 0.0), {"sign": True}, "-1.20 ± 0.00"),
        (Estimate(-0.001, 0.05), {"sign": True}, "0.00 ± 0.05"),
    ],
)
def test_estimates_as_text(estimate: Estimate, options: dict, text: str):
    assert estimate.text(**options) == text


TRAINED = TaskConfig(
    actuator="constraint",
    params={"control_latency": 0.0, "servo_latency": 0.0},
    params_source={"file": "robot.toml"},
    randomize={"base_mass_ratio": (0.8, 1.2)},
)


def test_at_home_nothing_is_drawn_and_nothing_pushed():
    pushed = replace(TRAINED, pushes=replace(TRAINED.pushes, enabled=True))
    home = home_task(pushed)
    assert (home.randomize, home.pushes.enabled) == ({}, False)
    assert home.pushes == replace(TRAINED.pushes, enabled=False)
    assert replace(home, randomize=pushed.randomize, pushes=pushed.pushes) == pushed


def test_away_the_robot_is_as_its_data_sheet_says():
    assert away_task(TRAINED) == replace(home_task(TRAINED), actuator="dc", params={}, params_source={})
    slow = replace(TRAINED, params={**TRAINED.params, "control_step": 0.01})
    assert away_task(slow).params == {"control_step": 0.01}


@pytest.fixture
def make_trace(make_run: MakeRun) -> MakeRun:
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


def test_summary_by_hand(make_trace: MakeRun) -> None:
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


def test_return_uses_the_weight_of_the_trace(make_trace: MakeRun) -> None:
    assert summarize([make_trace(energy_weight=0.0)], MASS)["return_mean"] == pytest.approx(3.6)


def test_going_backward_has_no_cost_of_transport(make_trace: MakeRun) -> None:
    summary = summarize([make_trace(speed=-0.1)], MASS)
    assert summary["distance_mean"] == pytest.approx(-0.6)
    assert summary["cost_of_transport_mean"] is None


def test_a_robot_that_cannot_see_itself(make_trace: MakeRun) -> None:
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
    others: list[dict[str, str]] | None, mass: float, message: str, make_trace: MakeRun
) -> None:
    traces = [] if others is None else [make_trace(), *(make_trace(**meta) for meta in others)]
    with pytest.raises(SurefootError, match=message):
        summarize(traces, mass)
