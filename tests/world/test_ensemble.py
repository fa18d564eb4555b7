"""Hidden parameters, and the ensemble of robots that replaces a real robot."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.randomization import draw_hidden, load_ranges
from surefoot.world.ensemble import ensemble_params
from surefoot.world.interface import WorldConfig
from surefoot.world.registry import WORLDS, make_world

SEEDS = range(1, 21)
ROBOTS = len(SEEDS)


def test_robots_do_not_depend_on_the_batch_and_repeat_after_the_last_seed(robot: RobotDescription) -> None:
    few, many = ensemble_params(robot, 3, SEEDS), ensemble_params(robot, ROBOTS + 2, SEEDS)
    for name in PhysicalParams.names():
        values = getattr(many, name)
        np.testing.assert_array_equal(getattr(few, name), values[:3])
        np.testing.assert_array_equal(values[ROBOTS:], values[:2])


def test_every_robot_is_within_the_ranges_and_differs(robot: RobotDescription) -> None:
    params = ensemble_params(robot, ROBOTS, SEEDS)
    ranges = load_ranges("ensemble")
    for name, (low, high) in ranges.items():
        values = getattr(params, name)
        if name == "control_step":  # the policy's
            assert np.all(values == 0.006)
            continue
        assert np.all((values >= low) & (values <= high)), name
        assert len(np.unique(values)) >= ROBOTS, name


def test_robots_only_accept_control_step_and_gains_of_the_policy(robot: RobotDescription) -> None:
    pytest.importorskip("pybullet")
    nominal = PhysicalParams.nominal(robot, 2)
    config = WorldConfig(threads=1)
    own = nominal.with_values(robot, control_step=0.010, servo_kp=1.2)
    world = make_world("ensemble", robot, 2, own, 0, config)
    assert np.all(world.params.control_step == 0.010)
    assert np.all(world.params.servo_kp == 1.2)
    np.testing.assert_array_equal(world.params.knee_play, ensemble_params(robot, 2, SEEDS).knee_play)
    with pytest.raises(SurefootError, match="voltage is given, but robots of the ensemble have their own"):
        make_world("ensemble", robot, 2, nominal.with_values(robot, voltage=15.0), 0, config)


def test_go2s_are_between_three_identifications() -> None:
    go2 = RobotDescription.load("go2")
    params = ensemble_params(go2, ROBOTS, SEEDS)
    lag, friction, rotor = params.torque_lag, params.motor_friction, params.rotor_inertia
    assert 0.0 <= lag.min() < lag.max() <= 0.0151
    knees = [k for k, name in enumerate(go2.motor_names) if "calf" in name]
    assert 0.36 <= friction[:, knees].min() < friction[:, knees].max() <= 1.36
    assert np.delete(friction, knees, axis=1).max() <= 0.37
    assert 0.007 <= rotor[:, knees].min() < rotor[:, knees].max() <= 0.037
    assert np.all(params.servo_kp == 70.0)


def test_robots_for_results_differ_from_robots_for_development(robot: RobotDescription) -> None:
    pytest.importorskip("pybullet")
    development, reported = WORLDS["ensemble"].seeds, WORLDS["ensemble-test"].seeds
    assert (development, reported) == (range(1, 21), range(21, 61))
    params = make_world("ensemble-test", robot, 1, None, 0, WorldConfig(threads=1)).params
    expected = draw_hidden(robot, load_ranges("ensemble"), 21)
    for name in PhysicalParams.names():
        np.testing.assert_array_equal(getattr(params, name), getattr(expected, name))
