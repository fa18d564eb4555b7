"""Hidden parameters, and the ensemble of robots that stands for reality."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.randomization import draw_hidden, load_ranges
from surefoot.world.ensemble import ROBOTS, ensemble_params
from surefoot.world.interface import WorldConfig
from surefoot.world.registry import make_world

RANGES = load_ranges("table1")
DRAWN = (*RANGES, "torque_constant", "resistance", "servo_latency")


def test_a_robot_is_the_same_in_every_batch_and_comes_again_after_the_last(robot: RobotDescription) -> None:
    few, many = ensemble_params(robot, 3), ensemble_params(robot, ROBOTS + 2)
    for name in PhysicalParams.names():
        values = getattr(many, name)
        np.testing.assert_array_equal(getattr(few, name), values[:3])
        np.testing.assert_array_equal(values[ROBOTS:], values[:2])


def test_every_robot_is_within_the_ranges_and_differs(robot: RobotDescription) -> None:
    params = ensemble_params(robot, ROBOTS)
    ranges = load_ranges("ensemble")
    for name, (low, high) in ranges.items():
        values = getattr(params, name)
        if name == "control_step":  # the policy's
            assert np.all(values == 0.006)
            continue
        assert np.all((values >= low) & (values <= high)), name
        assert len(np.unique(values)) >= ROBOTS, name


def test_robots_keep_the_policys_control_step_and_take_no_other_parameters(robot: RobotDescription) -> None:
    pytest.importorskip("pybullet")
    nominal = PhysicalParams.nominal(robot, 2)
    config = WorldConfig(threads=1)
    world = make_world("ensemble", robot, 2, nominal.with_values(robot, control_step=0.010), 0, config)
    assert np.all(world.params.control_step == 0.010)
    np.testing.assert_array_equal(world.params.knee_play, ensemble_params(robot, 2).knee_play)
    with pytest.raises(SurefootError, match="voltage is given; robots of the ensemble have their own"):
        make_world("ensemble", robot, 2, nominal.with_values(robot, voltage=15.0), 0, config)


def test_every_number_is_within_its_range_and_the_rest_is_nominal(robot):
    nominal = PhysicalParams.nominal(robot)
    drawn = [draw_hidden(robot, RANGES, seed) for seed in range(200)]
    for name in PhysicalParams.names():
        values = np.array([getattr(params, name)[0] for params in drawn])
        if name not in DRAWN or name == "control_step":  # the control step is the host's
            np.testing.assert_array_equal(values, np.broadcast_to(getattr(nominal, name)[0], values.shape))
            continue
        value = float(np.ravel(getattr(nominal, name))[0])
        around = (0.9 * value, 1.1 * value)
        known = {"torque_constant": around, "resistance": around, "servo_latency": (0.001, 0.005), **RANGES}
        low, high = known[name]
        assert low <= values.min()
        assert values.max() <= high
        assert values.max() - values.min() > 0.9 * (high - low), name


def test_the_ensembles_table_says_the_same_of_motors_and_servo(robot):
    ranges = load_ranges("ensemble")
    alone = {row: bounds for row, bounds in ranges.items() if row not in DRAWN[-3:]}
    with_rows, without = (draw_hidden(robot, given, 3) for given in (ranges, alone))
    for name in DRAWN[-3:]:
        assert getattr(with_rows, name) == getattr(without, name)


def test_a_seed_is_a_robot(robot):
    one, same, other = (draw_hidden(robot, RANGES, seed) for seed in (4, 4, 5))
    for name in PhysicalParams.names():
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert one.voltage != other.voltage
    assert len(set(one.motor_strength[0])) == 8
    assert len(set(one.motor_friction[0])) == 1
    # What one row draws does not change with the others.
    alone = draw_hidden(robot, {"voltage": RANGES["voltage"]}, 4)
    assert alone.voltage == one.voltage
