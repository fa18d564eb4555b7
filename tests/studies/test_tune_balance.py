"""Tuning of the balance: gains as numbers, costs of candidates side by side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.studies.tune_balance import GAINS, BalanceTuneConfig, BalanceTuner, gains_config, gains_vector
from surefoot.task.balance_gains import BalanceConfig, PhaseGains
from surefoot.task.config import TaskConfig, load_task
from surefoot.world.sim_world import SimWorld

QUICK = BalanceTuneConfig(population=4, robots=2, duration=0.5, threads=1, difficulty=0.5)


def seeing_task(**gains: float) -> TaskConfig:
    """Return the task `terrain-seeing` of a Go2 with a gait over holes that has these gains."""
    task = load_task("terrain-seeing", "go2")[0]
    assert task.reference.over_holes is not None
    over = replace(task.reference.over_holes, balance=from_mapping(BalanceConfig, gains))
    return replace(task, reference=replace(task.reference, over_holes=over))


def test_gains_and_numbers_are_the_same():
    gains = BalanceConfig(stance=PhaseGains(pitch_swing=0.1), swing=PhaseGains(speed_abduction=-0.2), slope_swing=-0.7)
    assert gains_config(gains_vector(gains)) == gains
    assert len(GAINS) == 24
    several = gains_config(np.arange(48.0).reshape(24, 2, 1))
    np.testing.assert_array_equal(several.stance.pitch_extension, [[0.0], [1.0]])


def test_grounds_are_those_of_the_difficulty():
    assert BalanceTuner(QUICK, seeing_task(), SimWorld).grounds == {"gaps": "gaps:0.2", "stones": "stones:0.4"}


def test_the_same_seed_gives_the_same_search():
    def search() -> tuple[list[dict[str, float]], TaskConfig]:
        tuner = BalanceTuner(QUICK, seeing_task(slope_swing=-0.5), SimWorld)
        return [tuner.step() for _ in range(2)], tuner.task

    (first, task), again = search(), search()
    assert (first, task) == again
    assert set(first[0]) == {"cost", "gaps", "stones"}
    assert task.reference.over_holes != seeing_task(slope_swing=-0.5).reference.over_holes


def test_a_candidate_that_falls_costs_more():
    # Legs that fold with every rate of pitch throw a robot over; the same robots without gains walk on.
    tuner = BalanceTuner(replace(QUICK, duration=4.0), seeing_task(), SimWorld)
    env = next(iter(tuner._envs.values()))
    gains = np.zeros((len(GAINS), 10, 1))
    gains[GAINS.index("stance.pitch_rate_extension"), :2] = -3.0
    cost, kept = tuner._run(env, gains_config(gains))
    assert cost[0] > cost[1:].max() + 0.3
    assert kept[0] == 0.0


def test_other_tasks_are_refused():
    with pytest.raises(SurefootError, match=r"has no reference.over_holes and 0 kinds of terrain with"):
        BalanceTuner(QUICK, load_task("terrain", "go2")[0], SimWorld)
    task = seeing_task()
    with pytest.raises(SurefootError, match=r"has a reference.over_holes and 0 kinds of terrain with holes"):
        BalanceTuner(QUICK, replace(task, terrain=replace(task.terrain, sizes={}, shares={})), SimWorld)
