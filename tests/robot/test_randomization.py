"""Domain randomization: samples from a robot's random stream, and their normalization for a critic."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.robot.randomization import Randomizer, Ranges, RelativeRange, draw_hidden, load_ranges
from surefoot.seeding import generators

FULL: Ranges = {
    **load_ranges("table1"),
    "torque_constant": (0.08, 0.11),
    "resistance": (0.15, 0.22),
    "servo_latency": (0.0, 0.010),
    "contact_stiffness": (1500.0, 6000.0),
    "contact_spinning_friction": (0.002, 0.006),
    "knee_friction": (0.0, 0.02),
    "knee_play": (0.0001, 0.0005),
    "floor_unevenness": (0.001, 0.004),
    "imu_mount": (-0.02, 0.02),
    "servo_kp": (0.9, 1.1),
    "imu_yaw_drift": (-0.02, 0.02),
    "contact_shear_ratio": (0.5, 1.5),
}
COUNT = len(FULL) + 7 + 1 + 2
"""Number of samples per episode: motor_strength, imu_bias and imu_mount have one per motor or axis."""


def numbers(params: PhysicalParams, name: str) -> np.ndarray:
    """Samples (N, k) of one parameter; a sample that all motors share counts once."""
    values = getattr(params, name).reshape(params.num_envs, -1)
    return values if PARAMETERS[name].independent else values[:, :1]


def assert_same(first: PhysicalParams, second: PhysicalParams) -> None:
    for name in PhysicalParams.names():
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), name)


@pytest.fixture
def make_randomizer(robot):
    def make(num_envs: int = 4, ranges: Ranges = FULL, **nominal: float) -> Randomizer:
        return Randomizer(ranges, robot, PhysicalParams.nominal(robot, num_envs).with_values(robot, **nominal), seed=5)

    return make


@pytest.fixture(scope="module")
def randomizer(robot) -> Randomizer:
    return Randomizer(FULL, robot, PhysicalParams.nominal(robot, 100), seed=11)


@pytest.fixture(scope="module")
def many(randomizer) -> list[PhysicalParams]:
    """Forty episodes of each of 100 robots."""
    return [randomizer.draw(np.arange(100)) for _ in range(40)]


# --- distribution of samples ------------------------------------------------------------------------------


def test_samples_are_uniform_over_their_ranges(many):
    for name, (low, high) in FULL.items():
        drawn = np.concatenate([numbers(params, name) for params in many])
        assert low <= drawn.min() <= drawn.max() <= high, name
        for column in drawn.T:
            assert stats.kstest(column, "uniform", (low, high - low)).pvalue > 0.002, name


def test_all_samples_are_independent(many):
    drawn = np.array([np.concatenate([numbers(params, name) for name in FULL], axis=1) for params in many])
    assert drawn.shape == (40, 100, COUNT)
    assert np.all(many[0].motor_friction == many[0].motor_friction[:, :1])  # all motors share one
    between = np.corrcoef(drawn.reshape(4000, COUNT), rowvar=False) - np.eye(COUNT)
    # The standard error of a correlation of 4000 pairs is 0.016; this is four of them.
    assert np.abs(between).max() < 0.064
    for first, second in ((drawn[:-1], drawn[1:]), (drawn[:, :-1], drawn[:, 1:])):  # consecutive episodes, and robots
        for k in range(COUNT):
            assert abs(np.corrcoef(first[..., k].ravel(), second[..., k].ravel())[0, 1]) < 0.064


def test_a_parameter_without_a_range_stays_nominal(make_randomizer, robot):
    randomizer = make_randomizer(3, {"base_mass_ratio": (0.8, 1.2)}, servo_kp=1.5, voltage=15.0)
    drawn = randomizer.draw(np.array([2, 0]))
    assert np.all(randomizer.nominal.base_mass_ratio == 1.0)  # drawing does not change the nominal values
    assert np.all(drawn.base_mass_ratio != 1.0)
    drawn.base_mass_ratio[:] = 1.0
    assert_same(drawn, PhysicalParams.nominal(robot, 2).with_values(robot, servo_kp=1.5, voltage=15.0))


# --- independence of samples ------------------------------------------------------------------------------


def test_samples_of_a_robot_do_not_depend_on_batch_and_order(make_randomizer):
    few, lots = make_randomizer(41), make_randomizer(64)
    for _ in range(3):
        assert_same(few.draw(np.array([40, 3])), lots.draw(np.arange(64)).rows([40, 3]))
    few.draw(np.array([0])), few.draw(np.array([2, 1]))
    late = make_randomizer(3)
    assert_same(late.draw(np.arange(3)), make_randomizer(3).draw(np.array([2, 0, 1])).rows([1, 2, 0]))
    assert_same(late.draw(np.array([1])), few.draw(np.array([1])))


@pytest.mark.parametrize("name", FULL)
def test_changing_a_range_does_not_change_other_samples(make_randomizer, name):
    low, high = FULL[name]
    width = high - low
    narrow = (low + 0.25 * width, low + 0.5 * width)
    without = {other: given for other, given in FULL.items() if other != name}
    full, dropped, narrowed = (make_randomizer(ranges=ranges) for ranges in (FULL, without, {**FULL, name: narrow}))
    for _ in range(2):
        drawn = [randomizer.draw(np.arange(4)) for randomizer in (full, dropped, narrowed)]
        for other in without:
            for params in drawn[1:]:
                assert np.array_equal(numbers(drawn[0], other), numbers(params, other)), other
        was, now = getattr(drawn[0], name), getattr(drawn[2], name)
        # The same uniform sample, applied to a quarter of the range.
        np.testing.assert_allclose((now - narrow[0]) / (narrow[1] - narrow[0]), (was - low) / width, atol=1e-12)


def test_later_parameters_do_not_change_the_random_stream(make_randomizer):
    randomizer, streams = make_randomizer(), generators(5, "randomize", 4)
    for _ in range(3):
        params = randomizer.draw(np.arange(4))
        # In the parameters' order: mass 2, motor friction 1, inertia 2, strength 8, control step, latency, voltage, ...
        unit = np.array([stream.uniform(size=23) for stream in streams])
        np.testing.assert_array_equal(params.base_mass_ratio, 0.8 + (1.2 - 0.8) * unit[:, 0])
        np.testing.assert_array_equal(params.voltage, 14.0 + (16.8 - 14.0) * unit[:, 15])
        np.testing.assert_array_equal(params.servo_latency, 0.010 * unit[:, 22])


# --- normalization for a critic ---------------------------------------------------------------------------


def test_normalized_parameters_are_from_minus_one_to_one(randomizer, many):
    scaled = np.concatenate([randomizer.normalize(params) for params in many])
    assert scaled.shape == (4000, COUNT) == (4000, len(randomizer.columns))
    assert np.abs(scaled).max() <= 1 + 1e-12
    assert np.all(scaled.min(axis=0) < -0.99)
    assert np.all(scaled.max(axis=0) > 0.99)


def test_normalize_by_hand(robot, make_randomizer):
    ranges: Ranges = {
        **{"base_mass_ratio": (0.8, 1.2), "voltage": (14.0, 16.0)},
        **{"imu_bias": (-0.05, 0.05), "resistance": (0.2, 0.2)},
    }
    params = PhysicalParams.nominal(robot, 2).with_values(
        robot, base_mass_ratio=[0.8, 1.1], voltage=[14.5, 16.0], imu_bias=[[0.05, 0], [0, -0.025]]
    )
    randomizer = make_randomizer(2, ranges)
    # A range of zero width has no column.
    assert randomizer.columns == ["base_mass_ratio", "voltage", "imu_bias.roll", "imu_bias.pitch"]
    expected = [[-1, -0.5, 1, 0], [0.5, 1, 0, -0.5]]
    np.testing.assert_allclose(randomizer.normalize(params), expected, atol=1e-12)


# --- ranges around nominal values -------------------------------------------------------------------------


def test_relative_ranges_scale_or_shift_nominal_values():
    robot = RobotDescription.load("pupper_v2")
    offsets = np.linspace(-0.02, 0.02, 12)
    nominal = PhysicalParams.nominal(robot, 40).with_values(robot, motor_offset=offsets[None])
    ranges: Ranges = {
        "motor_friction": RelativeRange(scale=(0.0, 2.0), independent=True),
        "servo_kp": RelativeRange(scale=(0.9, 1.1)),
        "motor_offset": RelativeRange(add=(-0.01, 0.01)),
    }
    randomizer = Randomizer(ranges, robot, nominal, 3)
    drawn = randomizer.draw(np.arange(40))
    factors = drawn.servo_kp / nominal.servo_kp
    assert np.ptp(factors, axis=1).max() < 1e-12
    assert 0.9 <= factors.min() < 0.92
    assert 1.08 < factors.max() <= 1.1
    assert np.ptp(drawn.motor_friction / nominal.motor_friction, axis=1).min() > 0.5
    assert np.abs(drawn.motor_offset - offsets).max() <= 0.01
    scaled = randomizer.normalize(drawn)
    assert scaled.shape == (40, 12 + 1 + 12) == (40, len(randomizer.columns))
    np.testing.assert_allclose(scaled[:, 12], 10 * (factors[:, 0] - 1))
    assert np.abs(scaled).max() <= 1.0 + 1e-9
    # Samples of other parameters do not depend on these.
    friction: Ranges = {"contact_friction": (0.5, 1.0)}
    first, second = (Randomizer(one, robot, nominal, 3).draw(np.arange(40)) for one in (ranges | friction, friction))
    np.testing.assert_array_equal(first.contact_friction, second.contact_friction)


def test_a_shared_sample_scales_every_motor_by_one_factor(robot):
    nominal = PhysicalParams.nominal(robot, 5)
    strength = RelativeRange(scale=(0.8, 1.2), independent=False)
    randomizer = Randomizer({"motor_strength": strength, "voltage": (14.0, 15.0)}, robot, nominal, 3)
    drawn = randomizer.draw(np.arange(5))
    assert np.ptp(drawn.motor_strength, axis=1).max() == 0
    assert randomizer.columns == ["motor_strength", "voltage"]
    # Equal to the first motor's sample if each motor draws its own.
    each = Randomizer({"motor_strength": (0.8, 1.2)}, robot, nominal, 3).draw(np.arange(5))
    np.testing.assert_array_equal(drawn.motor_strength[:, 0], each.motor_strength[:, 0])


def test_relative_samples_are_clipped_to_the_allowed_range(robot):
    ranges: Ranges = {"imu_noise": RelativeRange(add=(-0.2, -0.1)), "control_step": RelativeRange(scale=(100.0, 200.0))}
    drawn = Randomizer(ranges, robot, PhysicalParams.nominal(robot, 5), 3).draw(np.arange(5))
    assert np.all(drawn.imu_noise == 0.0)
    assert np.all(drawn.control_step == 0.05)


def test_ranges_widen_from_the_nominal_value_over_a_robots_first_episodes(robot):
    nominal = PhysicalParams.nominal(robot, 3)
    whole, ramped = (Randomizer(FULL, robot, nominal, 3, ramp) for ramp in (0, 4))
    # Robot 1 starts its first episode later than the others.
    episodes = (([0, 2], (0.25, 0.25)), ([0, 1], (0.5, 0.25)), ([0], (0.75,)), ([0, 1], (1.0, 0.5)), ([0], (1.0,)))
    for rows, shares in episodes:
        index = np.array(rows)
        full, narrowed, middle = whole.draw(index), ramped.draw(index), nominal.rows(index)
        for name in FULL:
            at, share = getattr(middle, name), np.reshape(shares, (-1, *[1] * (getattr(middle, name).ndim - 1)))
            expected = at + share * (getattr(full, name) - at)
            np.testing.assert_allclose(getattr(narrowed, name), expected, rtol=1e-12, atol=1e-15)


def test_each_axis_draws_from_its_own_interval(robot):
    ranges: Ranges = {"imu_mount": ((0.0, 0.0), (-0.2, -0.1), (0.1, 0.2))}
    randomizer = Randomizer(ranges, robot, PhysicalParams.nominal(robot, 50), 3)
    drawn = randomizer.draw(np.arange(50)).imu_mount
    assert np.all(drawn[:, 0] == 0.0)
    assert np.all((drawn[:, 1] >= -0.2) & (drawn[:, 1] <= -0.1))
    assert np.all((drawn[:, 2] >= 0.1) & (drawn[:, 2] <= 0.2))
    assert abs(np.corrcoef(drawn[:, 1], drawn[:, 2])[0, 1]) < 0.5


# --- hidden parameters ------------------------------------------------------------------------------------

TABLE_1 = load_ranges("table1")


def test_hidden_parameters_are_within_their_ranges_and_others_nominal(robot):
    nominal, motor = PhysicalParams.nominal(robot), robot.dc_motor
    drawn = [draw_hidden(robot, TABLE_1, seed) for seed in range(200)]
    ranges = {
        name: (0.9 * getattr(motor, name), 1.1 * getattr(motor, name)) for name in ("torque_constant", "resistance")
    }
    ranges |= {"servo_latency": (0.001, 0.005), **TABLE_1}
    del ranges["control_step"]  # belongs to the control computer
    for name in PhysicalParams.names():
        values = np.array([getattr(params, name)[0] for params in drawn])
        if name in ranges:
            low, high = ranges[name]
            assert low <= values.min() <= values.max() <= high
            assert np.ptp(values) > 0.9 * (high - low), name
        else:
            np.testing.assert_array_equal(values, np.broadcast_to(getattr(nominal, name)[0], values.shape))


def test_hidden_robots_are_reproducible_by_seed(robot):
    one, same, other = (draw_hidden(robot, TABLE_1, seed) for seed in (4, 4, 5))
    assert_same(one, same)
    assert one.voltage != other.voltage
    assert len(set(one.motor_strength[0])) == 8
    assert len(set(one.motor_friction[0])) == 1
    # Samples of a parameter do not depend on the other ranges.
    assert draw_hidden(robot, {"voltage": TABLE_1["voltage"]}, 4).voltage == one.voltage
