"""Reward and fall, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.task.reward import has_fallen, locomotion_reward


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


def test_reward_of_a_small_episode():
    # Three steps of 6 ms at 0, 1 and 2 m/s, 100 W throughout: 0 + .006 + .012 - 3 x .008 x .6
    reward = locomotion_reward(np.array([0.0, 0.006, 0.012]), np.full(3, 0.6))
    assert reward.sum() == pytest.approx(0.018 - 0.0144)


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw", "fallen"),
    [
        (0.0, 0.0, 0.0, False),
        (0.499, -0.499, 0.0, False),
        (0.5, 0.5, 0.0, False),
        (0.501, 0.0, 0.0, True),
        (0.0, 0.501, 0.0, True),
        (-0.501, 0.0, 0.0, True),
        (0.0, -0.501, 0.0, True),
        (0.0, 0.0, 3.0, False),
    ],
)
def test_fall(roll, pitch, yaw, fallen):
    assert has_fallen(np.array([[roll, pitch, yaw]])).tolist() == [fallen]


def test_falls_of_a_batch():
    angles = np.zeros((3, 3))
    angles[1, 0] = 0.4
    assert has_fallen(angles, 0.3).tolist() == [False, True, False]
