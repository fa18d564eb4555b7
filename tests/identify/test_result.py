"""Results of an identification: intervals, and values for a robot's parameters."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.identify.result import Identification, ParameterEstimate, add_model_error
from surefoot.robot import PhysicalParams, RobotDescription


def identification(*estimates: ParameterEstimate) -> Identification:
    return Identification("motor", "minitaur", estimates)


def test_intervals_stay_within_bounds():
    assert ParameterEstimate("a", 2.0, 0.5, "1").interval == pytest.approx((2 - 1.959964 / 2, 2 + 1.959964 / 2))
    low, high = ParameterEstimate("motor_friction", 0.01, 0.02, "N m", 3, low=0.0, high=0.04).interval
    assert (low, high) == (0.0, 0.04)


def test_params_take_identifiable_estimates(robot: RobotDescription):
    base = PhysicalParams.nominal(robot, 3).with_values(robot, motor_strength=0.7)
    result = identification(
        ParameterEstimate("resistance", 0.21, 0.01, "Ohm"),
        ParameterEstimate("motor_strength", 0.8, 0.01, "1", 2),
        ParameterEstimate("motor_strength", 0.9, 0.4, "1", 3, identifiable=False),
        ParameterEstimate("motor_friction", -0.01, 0.01, "N m", 1),
        ParameterEstimate("imu_bias", 0.02, 0.01, "rad", 1),
        ParameterEstimate("motor_viscous_friction", 0.003, 0.001, "N m s/rad"),
        ParameterEstimate("total_mass", 8.0, 0.1, "kg"),
        ParameterEstimate("torque_constant", 0.2, 0.1, "N m/A", identifiable=False),
    )
    params = result.params(robot, base)
    assert params.num_envs == 1
    assert params.resistance[0] == 0.21
    # The fourth motor's strength is not identifiable: it stays, as all that was not asked for does.
    np.testing.assert_array_equal(params.motor_strength[0], [0.7, 0.7, 0.8, 0.7, 0.7, 0.7, 0.7, 0.7])
    # Below what the robot allows is at its bound.
    assert params.motor_friction[0, 1] == 0.0
    np.testing.assert_array_equal(params.imu_bias[0], [0.0, 0.02])
    np.testing.assert_array_equal(params.motor_viscous_friction[0], np.full(8, 0.003))
    assert params.torque_constant[0] == robot.dc_motor.torque_constant
    np.testing.assert_array_equal(base.motor_strength, np.full((3, 8), 0.7))
    assert result.identified_names() == (
        "resistance",
        "motor_strength",
        "motor_friction",
        "imu_bias",
        "motor_viscous_friction",
    )


def test_estimate_is_selected_by_name_and_index():
    result = identification(
        ParameterEstimate("motor_strength", 0.8, 0.1, "1", 2), ParameterEstimate("resistance", 0.2, 0.1, "Ohm")
    )
    assert result.estimate("motor_strength", 2).value == 0.8
    with pytest.raises(KeyError, match=r"motor_strength\[1\]"):
        result.estimate("motor_strength", 1)
    with pytest.raises(KeyError, match="voltage"):
        result.estimate("voltage")


def test_deviations_include_the_simulators_accuracy():
    # 3-4-5: 0.5 % of 6 is 0.03.
    assert add_model_error("resistance", 6.0, 0.04) == pytest.approx(0.05)
    assert add_model_error("torque_constant", 3.0, 0.04) == pytest.approx(0.05)
    assert add_model_error("motor_friction", 0.0, 0.0) == pytest.approx(2e-4)
    assert add_model_error("motor_strength", 0.0, 0.3) == pytest.approx(0.3)
