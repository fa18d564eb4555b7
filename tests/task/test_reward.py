"""Reward and fall, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.task.env import has_fallen, locomotion_reward


@pytest.mark.parametrize(
    ("displacement", "energy", "weight", "expected"),
    [
        (0.008, 0.0, 0.008, 0.008),
        (0.008, 1.0, 0.008, 0.0),  # 1 J costs 8 mm
        (0.0, 0.6, 0.008, -0.0048),
        (-0.002, 0.5, 0.008, -0.006),
        (0.01, 2.0, 0.0, 0.01),
        (0.01, 2.0, 0.001, 0.008),
    ],
)
def test_reward_of_a_step(displacement, energy, weight, expected):
    reward = locomotion_reward(np.array([displacement]), np.array([energy]), weight)
    np.testing.assert_allclose(reward, [expected], atol=1e-15)


def test_fall():
    upright = [(0.0, 0.0, 0.0), (0.499, -0.499, 0.0), (0.5, 0.5, 0.0), (0.0, 0.0, 3.0)]
    fallen = [(0.501, 0.0, 0.0), (0.0, 0.501, 0.0), (-0.501, 0.0, 0.0), (0.0, -0.501, 0.0)]
    assert has_fallen(np.array(upright + fallen), 0.5).tolist() == [False] * 4 + [True] * 4
    assert has_fallen(np.array(upright), 0.4).tolist() == [False, True, True, False]
