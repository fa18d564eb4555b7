"""Tuning of handcrafted gaits: parameters, search, and rejected input."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cma")

from surefoot.studies.tune import GAIN_RANGES, PATH_RANGES, PHASE_RANGES, TuneConfig, Tuner, foot_config, has_converged
from surefoot.task.handcrafted import OpenLoop
from surefoot.task.raibert import RaibertController
from surefoot.world.sim_world import SimWorld

USUAL = {name: usual for name, (_, _, usual) in PATH_RANGES.items()}
SMALL = TuneConfig(generations=2, population=4, starts=2, duration=0.5, threads=1)


def test_foot_config_scales_parameters_by_reach_and_speed():
    values = USUAL | {"frequency": 2.0, "stride": 1.2, "clearance": 0.1, "front_height": 0.7, "back_offset": -0.05}
    foot = foot_config(values, "trot", speed=0.3, reach=0.3)
    natural = math.sqrt(9.81 / 0.3) / (2 * math.pi)
    assert foot.frequency == pytest.approx(2.0 * natural)
    assert foot.stroke * foot.frequency / foot.duty_factor == pytest.approx(1.2 * 0.3)
    assert foot.clearance == pytest.approx(0.03)
    assert foot.height == pytest.approx(
        dict.fromkeys(("front_left", "front_right"), 0.21) | dict.fromkeys(("back_left", "back_right"), 0.216)
    )
    assert foot_config(values, "trot", speed=5.0, reach=0.3).stroke == pytest.approx(0.15)
    assert foot.offset["back_left"] == pytest.approx(-0.015)


@pytest.mark.parametrize(
    ("gait", "phase"),
    [
        ("trot", {"front_left": 0.0, "front_right": 0.5, "back_left": 0.5, "back_right": 0.0}),
        ("bound", {"front_left": 0.0, "front_right": 0.0, "back_left": 0.4, "back_right": 0.4}),
        ("gallop", {"front_left": -0.05, "front_right": 0.05, "back_left": 0.45, "back_right": 0.35}),
        ("free", {"front_left": 0.0, "front_right": 0.1, "back_left": 0.4, "back_right": 0.3}),
    ],
)
def test_each_gait_has_its_phases(gait, phase):
    free = {"back_phase": 0.4, "front_lead": 0.1, "back_lead": -0.1}
    values = USUAL | {name: free[name] for name in PHASE_RANGES[gait]}
    assert foot_config(values, gait, 1.0, 0.3).phase == pytest.approx(phase)


def test_the_result_depends_only_on_the_seed():
    best_values = []
    for seed in (5, 5, 6):
        tuner = Tuner(replace(SMALL, seed=seed, starts=1), SimWorld)
        tuner.step()
        best_values.append(tuner.best)
    assert best_values[0] == best_values[1]
    assert best_values[0] != best_values[2]


def test_a_search_improves_and_keeps_the_best_start():
    tuner = Tuner(SMALL, SimWorld)
    costs = []
    for _ in range(2):
        tuner.step()
        costs.append(tuner.cost)
    assert costs[1] <= costs[0] < np.inf
    best = dict(tuner.best)
    again = Tuner(replace(SMALL, raibert=True), SimWorld, best)
    assert {name: again.best[name] for name in best} == best
    assert set(again.best) - set(best) == set(GAIN_RANGES)
    assert isinstance(again.gait().policy(), RaibertController)
    assert isinstance(tuner.gait().policy(), OpenLoop)
    tuner.finish()
    assert tuner.best in [*tuner._generation_best, best]
    assert tuner.gait().about["parameters"] == tuner.best


def test_cost_is_power_and_a_penalty_for_missing_speed():
    tuner = Tuner(replace(SMALL, speed=5.0), SimWorld)
    # Legs that hardly move: no power, no speed.
    still = USUAL | {"frequency": 1.0, "clearance": 0.02, "stride": 0.0, "depth": 0.0}
    costs = tuner.costs([still] * 4)
    assert costs.shape == (4, 2)
    assert np.all((costs > 290) & (costs < 320))


def test_a_start_out_of_reach_moves_towards_the_default_gait():
    tuner = Tuner(replace(SMALL, speed=2.0), SimWorld, {"front_height": 0.94, "back_height": 0.7})
    assert 0.72 < tuner.best["front_height"] < 0.94
    assert 0.7 < tuner.best["back_height"] < 0.72


def test_a_search_has_converged_if_it_gained_less_than_two_percent():
    assert has_converged([90.0, 50.0, 49.5, 60.0], 2)
    assert not has_converged([90.0, 50.0, 48.9, 60.0], 2)
    assert not has_converged([50.0, 50.0, 50.0], 2)
