"""The position servo at points worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.actuator import servo_duty


@pytest.mark.parametrize(
    ("target", "angle", "speed", "expected"),
    [
        (2.0, 2.0, 0.0, 0.0),
        (2.3, 2.0, 0.0, 0.3),
        (1.7, 2.0, 0.0, -0.3),
        (2.0, 2.0, 10.0, -0.15),  # damping: -.015 x 10
        (2.0, 2.0, -10.0, 0.15),
        (2.3, 2.0, 10.0, 0.15),
        (3.5, 2.0, 0.0, 1.0),
        (0.0, 2.0, 0.0, -1.0),
        (2.0, 2.0, 1000.0, -1.0),
        (3.5, 2.0, 50.0, 0.75),  # the sum is clipped, not its parts: 1.5 - .75
    ],
)
def test_duty(target: float, angle: float, speed: float, expected: float):
    assert servo_duty(target, angle, speed, 1.0, 0.015) == pytest.approx(expected)


def test_what_is_no_number_gives_no_duty():
    assert np.isnan(servo_duty(np.nan, 2.0, 0.0, 1.0, 0.015))
    assert np.isnan(servo_duty(2.0, 2.0, np.nan, 1.0, 0.015))


def test_duty_broadcasts_over_robots_and_motors_with_gains_of_their_own(rng: np.random.Generator):
    target, angle, speed = rng.normal(size=(3, 5, 8))
    kp, kd = rng.uniform(0.5, 2, (5, 1)), rng.uniform(0, 0.1, (5, 1))
    duty = servo_duty(target, angle, speed, kp, kd)
    np.testing.assert_allclose(duty, np.clip(kp * (target - angle) - kd * speed, -1, 1), rtol=1e-13)
