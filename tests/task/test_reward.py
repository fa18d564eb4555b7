"""Reward and fall, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.task.config import load_task
from surefoot.task.env import LocomotionEnv, has_fallen, locomotion_reward


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


def test_progress_counts_up_to_a_greatest_displacement():
    displacement, energy = np.array([0.002, 0.004, 0.009, -0.002]), np.array([0.0, 0.5, 0.5, 0.0])
    reward = locomotion_reward(displacement, energy, 0.008, 0.004)
    np.testing.assert_allclose(reward, [0.002, 0.0, 0.0, -0.002], atol=1e-15)


def test_target_speed_limits_the_progress_of_an_environments_reward(scripted_world):
    task = replace(load_task("trot")[0], target_speed=0.5)
    env = LocomotionEnv(task, 2, scripted_world, autoreset=False)
    env.reset()
    env.world.speed[:], env.world.power[:] = (0.4, 3.0), 10.0
    reward = env.step(np.zeros((2, 8)))[1]
    # 6 ms: 2.4 mm go forward, 18 mm count as 3 mm; .06 J cost .48 mm.
    np.testing.assert_allclose(reward, [0.0024 - 0.00048, 0.003 - 0.00048])


def test_fall():
    upright = [(0.0, 0.0, 0.0), (0.499, -0.499, 0.0), (0.5, 0.5, 0.0), (0.0, 0.0, 3.0)]
    fallen = [(0.501, 0.0, 0.0), (0.0, 0.501, 0.0), (-0.501, 0.0, 0.0), (0.0, -0.501, 0.0)]
    assert has_fallen(np.array(upright + fallen), 0.5).tolist() == [False] * 4 + [True] * 4
    assert has_fallen(np.array(upright), 0.4).tolist() == [False, True, True, False]
