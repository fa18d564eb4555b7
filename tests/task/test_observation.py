"""What the policy sees: names, order, widths and numbers."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.task.observation import IMU_4D, IMU_AND_MOTORS_12D, Moment, Observer
from surefoot.task.reference import make_reference
from surefoot.world.interface import Readings


@pytest.fixture
def moment(robot) -> Moment:
    """Two robots; numbers that tell where they come from."""
    wave = {"amplitude": 0.1, "frequency": 2.0}
    return Moment(
        Readings(
            time=np.array([0.0, 0.125]),
            roll_pitch_yaw=np.array([[0.1, 0.2, 0.3], [1.1, 1.2, 1.3]]),
            angular_velocity_base=np.array([[0.4, 0.5, 0.6], [1.4, 1.5, 1.6]]),
            motor_angle=np.arange(16.0).reshape(2, 8),
            motor_velocity=np.arange(100.0, 116.0).reshape(2, 8),
        ),
        make_reference({"kind": "sine", "swing": wave}, robot),
        np.arange(200.0, 216.0).reshape(2, 8),
    )


def test_four_numbers_of_the_imu(robot, moment):
    observer = Observer(robot, IMU_4D)
    assert observer.columns == ["roll", "pitch", "roll_rate", "pitch_rate"]
    assert observer.observe(moment).tolist() == [[0.1, 0.2, 0.4, 0.5], [1.1, 1.2, 1.4, 1.5]]


def test_twelve_numbers_add_the_motor_angles_in_the_robots_order(robot, moment):
    observer = Observer(robot, IMU_AND_MOTORS_12D)
    assert observer.width == 12
    assert observer.columns[4:] == [f"angle.{name}" for name in robot.motor_names]
    assert observer.observe(moment)[1, 4:].tolist() == list(range(8, 16))


def test_phase_goes_round_with_the_reference(robot, moment):
    # Two hertz: .125 s is a quarter.
    observed = Observer(robot, ("reference_phase",)).observe(moment)
    np.testing.assert_allclose(observed, [[0, 1], [1, 0]], atol=1e-12)


def test_last_action_is_the_feedback_in_leg_space(robot, moment):
    observer = Observer(robot, ("last_action",))
    assert observer.columns[0] == "last_swing.front_left"
    assert observer.columns[-1] == "last_extension.back_right"
    assert np.array_equal(observer.observe(moment), moment.last_feedback)


@pytest.mark.parametrize(
    ("names", "pieces"),
    [
        (("roll", "yaw"), ["observation 'yaw' does not exist", "choices: roll, pitch", "last_action"]),
        ((), ["observations is empty", "choices: roll"]),
        (("roll", "pitch", "roll"), ["roll, pitch, roll", "names must not repeat"]),
    ],
)
def test_parts_that_do_not_fit_are_refused_in_one_line(robot, names, pieces):
    with pytest.raises(SurefootError) as caught:
        Observer(robot, names)
    assert "\n" not in str(caught.value)
    for piece in pieces:
        assert piece in str(caught.value)


def test_phase_without_a_period_is_refused(robot, moment):
    still = Moment(moment.readings, make_reference(None, robot), moment.last_feedback)
    with pytest.raises(SurefootError, match="'reference_phase' needs a periodic reference"):
        Observer(robot, ("reference_phase",)).observe(still)
