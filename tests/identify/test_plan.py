"""Plans of experiments: what they ask for stays within what they say."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.deploy.wire.messages import Mode
from surefoot.emulator.limits import Limits, introduction
from surefoot.identify.experiments.signals import chirps, go_to, hold, steps
from surefoot.identify.registry import EXPERIMENTS
from surefoot.robot import RobotDescription

PERIOD = 0.002


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_plan_asks_for_no_more_than_it_says(name: str, robot: RobotDescription):
    plan = EXPERIMENTS[name].plan(robot)
    said = introduction(robot, Limits(), "", robot.timing.servo_step)
    assert (plan.experiment, plan.rack) == (name, EXPERIMENTS[name].rack)
    assert any(phase.use == "fit" for phase in plan.phases)
    assert plan.duration < plan.limits.duration
    value = robot.resting_angles
    for phase in plan.phases:
        start = value if phase.mode == Mode.POSITION else np.zeros(robot.num_motors)
        for k in range(round(phase.duration / PERIOD)):
            asked = np.asarray(phase.signal(k * PERIOD, start))
            assert asked.shape == (robot.num_motors,)
            if phase.mode == Mode.PWM:
                assert np.abs(asked).max() <= plan.largest_duty + 1e-12
            else:
                value = asked
                if phase.use != "way":
                    # Whatever is fitted is sent as it is: the robot takes it.
                    assert np.all(asked >= np.maximum(plan.angle_low, said.angle_low) - 1e-9), phase.name
                    assert np.all(asked <= np.minimum(plan.angle_high, said.angle_high) + 1e-9), phase.name


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_plan_is_the_same_every_time(name: str, robot: RobotDescription):
    one, other = EXPERIMENTS[name].plan(robot), EXPERIMENTS[name].plan(robot)
    start = np.zeros(robot.num_motors)
    for first, second in zip(one.phases, other.phases, strict=True):
        assert (first.name, first.duration, first.use) == (second.name, second.duration, second.use)
        np.testing.assert_array_equal(first.signal(0.05, start), second.signal(0.05, start))


def test_signals():
    start, target = np.array([1.0, 2.0]), np.array([3.0, 0.0])
    way = go_to(target, 2.0)
    np.testing.assert_allclose(way(0.0, start), start)
    np.testing.assert_allclose(way(1.0, start), (start + target) / 2)
    np.testing.assert_allclose(way(2.0, start), target)
    np.testing.assert_allclose(way(9.0, start), target)
    np.testing.assert_allclose(hold(target)(1.0, start), target)
    rows = np.array([[1.0], [2.0], [3.0]])
    jump = steps(rows, 0.25)
    assert [jump(t, start)[0] for t in (0.0, 0.249, 0.25, 0.5, 5.0)] == [1.0, 1.0, 2.0, 3.0, 3.0]


def test_a_chirp_begins_and_ends_at_its_frequencies():
    sweep = chirps(np.array([0.5]), np.array([0.1]), 2.0, 8.0, 4.0, np.array([0.0]))
    nobody = np.zeros(1)
    time = np.arange(0.0, 4.0, 1e-4)
    values = np.array([sweep(t, nobody)[0] for t in time]) - 0.5
    assert abs(values[0]) < 1e-12
    assert abs(sweep(4.0, nobody)[0] - 0.5) < 1e-12
    assert np.abs(values).max() == pytest.approx(0.1, rel=1e-3)
    # Exponentially growing: the frequency is their geometric mean in the middle.
    crossings = time[1:][np.diff(np.sign(values)) != 0]
    halves = np.diff(crossings)
    middle = np.argmin(np.abs(crossings[1:] - 2.0))
    assert 0.5 / halves[middle] == pytest.approx(4.0, rel=0.1)
    assert 0.5 / halves[0] == pytest.approx(2.0, rel=0.15)
    assert 0.5 / halves[-1] == pytest.approx(8.0, rel=0.15)
