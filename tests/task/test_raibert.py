"""Raibert's controller: speed estimate and control laws, worked by hand, and in simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from references import read_reference

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.foot_paths import FootPaths
from surefoot.task.periodic_references import FootReference
from surefoot.task.raibert import OBSERVATIONS, RaibertConfig, RaibertController

ROBOT = RobotDescription.load("minitaur")
LEG = ROBOT.leg_geometry
TROT = dict(zip(ROBOT.leg_names, (0.0, 0.5, 0.5, 0.0), strict=True))
PATH = {
    "stroke": 0.1,
    "clearance": 0.03,
    "duty_factor": 0.5,
    "phase": TROT,
    "height": 0.22,
    "offset": 0.0,
    "depth": 0.0,
}
SPEED = 0.4
"""Speed of the trajectory [m/s]: 0.1 m in half a cycle of 0.5 s."""


def paths(**other: Any) -> FootPaths:
    reference_path = read_reference({"kind": "foot", "foot": {"frequency": 2.0, **PATH, **other}}, ROBOT)
    assert isinstance(reference_path, FootReference)
    return reference_path.feet


def controller(history: int = 1, **gains: float) -> RaibertController:
    return RaibertController(ROBOT, paths(), RaibertConfig(**{"lag": 0.0, **gains}), OBSERVATIONS, history)


def angles(time: float, **other: Any) -> np.ndarray:
    return ROBOT.to_motors(paths(**other).pose([time]))[0]


def observation(time: float, imu: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0), **other: Any) -> np.ndarray:
    """Return the observation of a robot whose legs follow a trajectory exactly."""
    speed = (angles(time + 1e-5, **other) - angles(time - 1e-5, **other)) / 2e-5
    clock = 2 * np.pi * 2.0 * time
    return np.concatenate([imu, angles(time, **other), speed, [np.sin(clock), np.cos(clock)]])


def feet(feedback: np.ndarray, time: float) -> np.ndarray:
    """Return the shift of the feet by feedback (4, 2) [m]."""
    pose = paths().pose([time]) + feedback.reshape(-1, 2, 4)
    moved = LEG.foot_in_plane(LEG.to_motors(pose))
    return (moved - paths().path([2.0 * time]))[0]


@pytest.mark.parametrize("time", [0.06, 0.125, 0.19, 0.31, 0.4])
def test_speed_is_estimated_from_feet_in_stance(time: float):
    assert controller().speed(observation(time)[None])[0] == pytest.approx(SPEED, rel=1e-3)
    faster = observation(time, stroke=0.15)
    assert controller().speed(faster[None])[0] == pytest.approx(1.5 * SPEED, rel=1e-3)


def test_speed_excludes_the_ends_of_stance():
    assert np.isnan(controller().speed(observation(0.01)[None])[0])
    both = np.concatenate([observation(0.01), observation(0.24), observation(0.13)])
    assert controller(history=3).speed(both[None])[0] == pytest.approx(SPEED, rel=1e-3)


def test_speed_accounts_for_the_lag_of_the_legs():
    late = controller(lag=0.03)
    # The clock is 0.03 s ahead of the legs.
    seen = np.concatenate([observation(0.06)[:-2], observation(0.09)[-2:]])
    assert late.speed(seen[None])[0] == pytest.approx(SPEED, rel=1e-3)


def test_speed_accounts_for_the_rate_of_pitch():
    # The feet are 0.22 m below motors that are 0.0185 m below the base's origin: a positive pitch rate moves them
    # backward.
    still = observation(0.125, (0.0, 0.0, 0.0, 1.0))
    below = -0.22 + ROBOT.leg_mounts[0, 2]
    assert controller().speed(still[None])[0] == pytest.approx(SPEED - 1.0 * below, rel=1e-3)


@pytest.mark.parametrize(("k", "expected"), [(0.0, 0.125), (0.1, 0.225), (-0.125, 0.0)])
def test_foot_placement_is_proportional_to_excess_speed(k: float, expected: float):
    """An excess speed of 0.1 m/s shifts feet by 0.1 m per second of T / 2 + k, with T = 0.25 s."""
    fast = observation(0.125, stroke=0.125)  # 0.5 m/s
    moved = feet(controller(speed=k).feedback(fast[None]), 0.125)
    np.testing.assert_allclose(moved[:, 0], 0.1 * expected, atol=1e-5)
    np.testing.assert_allclose(moved[:, 1], 0.0, atol=1e-9)


def test_legs_in_stance_level_the_base():
    gains = controller(speed=-0.125, pitch=0.5, pitch_rate=0.02, roll=0.4, roll_rate=0.01)
    # In the middle of the stance of front left and back right, whose weight is then 1.
    nose_down = feet(gains.feedback(observation(0.125, (0.0, 0.1, 0.0, 0.0))[None]), 0.125)[:, 1]
    x, y = np.abs(ROBOT.leg_mounts[0, :2])
    np.testing.assert_allclose(nose_down, [-0.05 * x, 0.0, 0.0, 0.05 * x], atol=1e-9)
    left_up = feet(gains.feedback(observation(0.125, (0.1, 0.0, 0.0, 0.0))[None]), 0.125)[:, 1]
    np.testing.assert_allclose(left_up, [0.04 * y, 0.0, 0.0, -0.04 * y], atol=1e-9)
    rates = feet(gains.feedback(observation(0.125, (0.0, 0.0, 1.0, 0.0))[None]), 0.125)[:, 1]
    np.testing.assert_allclose(rates, [0.01 * y, 0.0, 0.0, -0.01 * y], atol=1e-9)


def test_a_shift_is_limited_and_a_foot_out_of_reach_stays_on_its_path():
    wild = observation(0.125, stroke=0.19)
    moved = feet(controller(speed=10.0, reach=0.02).feedback(wild[None]), 0.125)
    np.testing.assert_allclose(moved[:, 0], 0.02, atol=1e-9)
    assert not controller(speed=10.0, reach=0.5).feedback(wild[None]).any()


def test_robots_may_have_different_gains_and_paths():
    seen = np.stack([observation(0.125, (0.0, 0.1, 0.0, 0.0), stroke=0.125)] * 2)
    single = [controller(pitch=gain).feedback(seen[:1])[0] for gain in (0.2, 0.6)]
    column: Any = np.array([[0.2], [0.6]])
    gains = replace(RaibertConfig(lag=0.0), pitch=column)
    both = RaibertController(ROBOT, FootPaths.stack([paths()] * 2), gains, OBSERVATIONS, 1)
    np.testing.assert_allclose(both.feedback(seen), single, atol=1e-12)


def test_other_observations_are_rejected():
    with pytest.raises(
        SurefootError, match="observations are roll, pitch; Raibert's controller takes roll, pitch, roll_"
    ):
        RaibertController(ROBOT, paths(), RaibertConfig(), ("roll", "pitch"))
