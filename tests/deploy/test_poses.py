"""Poses, and the motion between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.deploy.poses import lying_pose, minimum_jerk, sitting_pose


def test_all_legs_of_a_sitting_robot_have_the_same_pose(robot):
    np.testing.assert_allclose(robot.to_pose(sitting_pose(robot)), [[0.0] * 4, [0.9] * 4], atol=1e-12)


def test_minimum_jerk_starts_and_ends_at_rest():
    start, end = np.array([0.0, 1.0]), np.array([2.0, -1.0])
    assert minimum_jerk(start, end, 0.0).tolist() == [0.0, 1.0]
    assert minimum_jerk(start, end, 1.0).tolist() == [2.0, -1.0]
    assert minimum_jerk(1.0, 2.0, -3.0) == 1.0
    assert minimum_jerk(1.0, 2.0, 3.0) == 2.0
    assert minimum_jerk(start, end, 0.5) == pytest.approx([1.0, 0.0])
    # 10 s^3 - 15 s^4 + 6 s^5 at s = 1/4, by hand: 106/1024.
    assert minimum_jerk(start, end, 0.25) == pytest.approx([2 * 106 / 1024, 1 - 2 * 106 / 1024])
    share = np.linspace(0.0, 1.0, 1001)
    path = np.array([minimum_jerk(0.0, 1.0, s) for s in share])
    speed = np.gradient(path, share)
    assert np.all(np.diff(path) >= 0.0)
    assert speed[[0, -1]] == pytest.approx(0.0, abs=1e-5)
    assert speed.max() == pytest.approx(15 / 8, rel=1e-5)


def test_legs_next_to_the_body_are_laid_flat_on_their_side(robot):
    present = robot.pose_angles(np.array([-0.8, 0.9, 0.1, -0.2]), np.array([0.1, 0.2, 0.9, 0.5]))
    swing, extension = robot.to_pose(lying_pose(robot, present))
    assert swing == pytest.approx([-1.2, 1.2, 0.0, 0.0])
    assert extension == pytest.approx(0.9)
    # If the legs of a robot do not slide out, all of them get the sitting pose.
    stiff = replace(robot, poses=replace(robot.poses, spread=None))
    np.testing.assert_array_equal(lying_pose(stiff, present), sitting_pose(robot))
