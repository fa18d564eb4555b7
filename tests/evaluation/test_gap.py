"""Reality gaps of policies, compared with hand-computed values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from run_tables import policy_gap

from surefoot.evaluation.gap import PolicyGap, gap_cells
from surefoot.evaluation.statistics import MeanEstimate


def test_the_gap_is_the_loss_of_return_in_the_other_world():
    policy = policy_gap("p", [4.0, 6.0], {"bullet": [1.0, 3.0], "robot": [6.0]})
    assert policy.gap("bullet") == MeanEstimate(3.0, pytest.approx(math.sqrt(2)))
    assert policy.gap("robot").mean == -1.0
    assert math.isnan(policy.gap("robot").error)


def test_pooling_keeps_all_runs_of_the_policies():
    first = policy_gap("a", [4.0, 6.0], {"bullet": [1.0]}, falls=1)
    second = policy_gap("b", [10.0], {"bullet": [3.0, 5.0]})
    pooled = PolicyGap.pooled("both", [first, second])
    assert pooled.home["return"].tolist() == [4.0, 6.0, 10.0]
    assert pooled.in_world("bullet")["return"].tolist() == [1.0, 3.0, 5.0]
    assert pooled.rows()[1]["success_rate"] == pytest.approx(2 / 3)
    # The gaps of the two policies are 5 - 1 and 10 - 4.
    assert pooled.gap("bullet") == MeanEstimate(5.0, pytest.approx(1.0))


def test_the_means_of_a_pool_count_every_policy_once():
    # As the gap does: the difference of the returns is the gap also if the policies have different numbers of runs.
    first = policy_gap("a", [4.0, 4.0, 4.0], {"robot": [3.0] * 9})
    second = policy_gap("b", [1.0, 1.0, 1.0], {"robot": [0.5]})
    home, robot = PolicyGap.pooled("both", [first, second]).rows()
    assert (home["return_mean"], robot["return_mean"], robot["gap"]) == (2.5, 1.75, 0.75)
    assert (robot["return_error"], robot["runs"]) == (1.25, 10)


def test_a_gap_has_one_row_per_world():
    policy = policy_gap("p", [3.0, 5.0], {"bullet": [1.0, 3.0], "robot": [math.nan]})
    home, bullet, robot = policy.rows()
    assert [row["side"] for row in (home, bullet, robot)] == ["home", "away", "away"]
    assert [home[name] for name in ("return_mean", "return_error", "power_mean", "runs", "falls")] == [4, 1, 10, 2, 0]
    assert (bullet["gap"], bullet["gap_error"]) == (2, pytest.approx(math.sqrt(2)))
    assert np.isnan([home["gap"], robot["gap"], robot["gap_error"], robot["return_mean"]]).all()
    assert [gap_cells(row, row["side"] == "home", sign=True)["gap (m)"] for row in policy.rows()] == [
        "",
        "+2.00 ± 1.41",
        "-",
    ]
