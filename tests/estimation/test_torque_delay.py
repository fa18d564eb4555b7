"""Torques at the time of the other readings."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.estimation.torque_delay import TorqueDelay
from surefoot.robot import RobotDescription

DT = 0.01


@pytest.mark.parametrize(("lead", "steps"), [(0.0, 2.0), (0.015, 0.5), (0.05, 0.0)])
def test_torques_are_as_old_as_angles(lead: float, steps: float):
    # A Minitaur's angles are 20 ms old, two control steps; a state that is sent earlier has newer ones.
    delay = TorqueDelay(RobotDescription.load("minitaur"), lead)
    delayed = [delay.update(np.array([k, 10.0 * k]), DT) for k in range(8)]
    expected = np.maximum(np.arange(8) - steps, 0.0)[:, None] * [1.0, 10.0]
    np.testing.assert_allclose(delayed, expected, atol=1e-9)
    delay.reset()
    np.testing.assert_allclose(delay.update(np.ones(2), DT), 1.0)


def test_missed_states_are_interpolated():
    delay = TorqueDelay(RobotDescription.load("minitaur"))
    delay.update(np.zeros(1), DT)
    # The next state comes after 40 ms; 20 ms before it, half of the change has passed.
    assert delay.update(np.ones(1), 0.04) == pytest.approx(0.5)
