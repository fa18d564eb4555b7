"""Foot trajectories: positions, speeds, phases of the legs, and batches of different trajectories."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from references import read_reference

from surefoot.robot import RobotDescription
from surefoot.task.foot_paths import FootPaths
from surefoot.task.periodic_references import FootReference

ROBOT = RobotDescription.load("minitaur")
FEET = {
    **{"frequency": 2.0, "stroke": 0.1, "clearance": 0.03, "duty_factor": 0.6, "height": 0.2},
    **{"offset": 0.01, "depth": 0.005, "phase": 0.0},
}


def foot_paths(**other: Any) -> FootPaths:
    """Return foot trajectories that are equal for all legs."""
    reference = read_reference({"kind": "foot", "foot": FEET | other}, ROBOT)
    assert isinstance(reference, FootReference)
    return reference.feet


# Touchdown at 0.01 + 0.05 m in front of the motors; stance ends after 60 % of the cycle, 0.05 m behind 0.01 m.
@pytest.mark.parametrize(
    ("cycle", "x", "z"),
    [
        (0.0, 0.06, -0.2),
        (0.15, 0.035, -0.2025),
        (0.3, 0.01, -0.205),
        (0.6, -0.04, -0.2),
        (0.8, 0.01, -0.17),
        (1.0, 0.06, -0.2),
    ],
)
def test_foot_positions_at_known_phases(cycle: float, x: float, z: float):
    np.testing.assert_allclose(foot_paths().path([cycle]), np.tile([x, z], (1, 4, 1)), atol=1e-12)


def test_foot_speed_is_continuous_between_swing_and_stance():
    reference = foot_paths()
    assert reference.speed[0] == pytest.approx(0.1 * 2.0 / 0.6)
    for cycle in (0.3, 0.6 - 1e-6, 0.6 + 1e-6, 1.0 - 1e-6):
        ahead, behind = reference.path([cycle + 1e-7])[0, 0, 0], reference.path([cycle - 1e-7])[0, 0, 0]
        assert 2.0 * (ahead - behind) / 2e-7 == pytest.approx(-reference.speed[0], rel=1e-3)


def test_each_leg_has_its_own_phase():
    phase = dict(zip(ROBOT.leg_names, (0.0, 0.25, 0.5, 1.75), strict=True))
    path, unshifted = foot_paths(phase=phase).path([0.3])[0], foot_paths()
    for leg, shift in enumerate(phase.values()):
        np.testing.assert_allclose(path[leg], unshifted.path([0.3 - shift])[0, 0], atol=1e-12)


def test_leg_poses_put_feet_on_their_paths():
    reference, time = foot_paths(), np.linspace(0.0, 0.7, 50)
    pose = reference.pose(time)
    assert pose.shape == (50, 2, 4)
    np.testing.assert_allclose(
        ROBOT.leg_geometry.foot_in_plane(ROBOT.leg_geometry.to_motors(pose)), reference.path(2.0 * time), atol=1e-12
    )
    swing, extension = pose[:, 0], pose[:, 1]
    (s_low, s_high), (e_low, e_high) = reference.extent
    assert s_low <= swing.min() <= swing.max() <= s_high
    assert e_low <= extension.min() <= extension.max() <= e_high
    assert reference.period == 0.5


def test_robots_may_have_different_paths():
    one, other = foot_paths(), foot_paths(frequency=3.0, stroke=0.05, duty_factor=0.5)
    both = FootPaths.stack([one, other])
    pose = both.pose([0.21, 0.21])
    for row, single in enumerate((one, other)):
        np.testing.assert_allclose(pose[row], single.pose([0.21])[0], atol=1e-12)
    np.testing.assert_allclose(both.period, [0.5, 1 / 3])
