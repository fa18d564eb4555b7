"""Physical parameters: shapes, values, and rejected values."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription, parse_settings

PER_MOTOR = {
    *("motor_strength", "motor_friction", "motor_viscous_friction", "servo_kp", "servo_kd"),
    *("load_friction", "rotor_inertia", "torque_limit", "presliding", "motor_offset"),
}


@pytest.fixture
def params(robot: RobotDescription) -> PhysicalParams:
    return PhysicalParams.nominal(robot, 5)


@pytest.mark.parametrize("name", PhysicalParams.names())
def test_every_array_has_one_row_per_robot(params: PhysicalParams, name: str):
    width = (8,) if name in PER_MOTOR else {"imu_bias": (2,), "imu_mount": (3,), "base_offset": (3,)}.get(name, ())
    value = getattr(params, name)
    assert value.shape == (5, *width)
    assert value.dtype == np.float64


def test_nominal_values_are_the_data_sheets(params: PhysicalParams):
    expected = dict.fromkeys(PhysicalParams.names(), 0.0) | {
        **dict.fromkeys(("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio"), 1.0),
        **{"motor_strength": 1.0, "torque_constant": 0.0954, "resistance": 0.186, "voltage": 16.0},
        "voltage_clip": 50.0,
        **{"servo_kp": 1.0, "servo_kd": 0.015, "servo_latency": 0.003, "control_latency": 0.02, "control_step": 0.006},
        **{"contact_friction": 1.0, "contact_stiffness": 3000.0, "contact_spinning_friction": 0.004},
        "contact_shear_ratio": 1.0,
    }
    for name, value in expected.items():
        assert np.all(getattr(params, name) == value), name


ROBOTS, MOTORS = [0.8, 0.9, 1.0, 1.1, 1.2], np.linspace(0.8, 1.2, 8)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("motor_strength", 0.8, 0.8),
        ("voltage", [14, 15, 16, 16.5, 16.8], [14, 15, 16, 16.5, 16.8]),
        ("motor_strength", ROBOTS, np.array(ROBOTS)[:, None]),  # one number per robot applies to all its motors
        ("motor_strength", MOTORS, MOTORS),  # one number per motor applies to all robots
        ("servo_kp", MOTORS, MOTORS),
        ("servo_kd", [0.01, 0.02, 0.03, 0.04, 0.05], np.array([0.01, 0.02, 0.03, 0.04, 0.05])[:, None]),
    ],
)
def test_values_broadcast_to_robots_and_motors(robot, params, name, value, expected):
    assert np.all(getattr(params.with_values(robot, **{name: value}), name) == expected)


def test_with_values_does_not_change_the_original(robot, params):
    params.with_values(robot, voltage=15.0)
    assert np.all(params.voltage == 16.0)


@pytest.mark.parametrize(
    ("values", "pieces"),
    [
        ({"motor_power": 1.0}, ["'motor_power' is not a physical parameter", "motor_strength", "imu_noise"]),
        # Milliseconds instead of seconds.
        ({"control_latency": 15}, ["control_latency is 15", "allows 0 to 0.1", "unit: s"]),
        ({"base_mass_ratio": -1.0}, ["base_mass_ratio is -1", "allows 0.2 to 5"]),
        ({"motor_viscous_friction": 0.2}, ["motor_viscous_friction is 0.2", "allows 0 to 0.1", "unit: N m s/rad"]),
        ({"voltage": float("nan")}, ["voltage is nan", "allows 5 to 30", "unit: V"]),
        ({"voltage": [16, 16, 16, 16, 40]}, ["voltage is 40"]),
        # A parameter of joint actuators.
        ({"load_friction": 0.1}, ["load_friction belongs to motors of kind joint", "the motors of minitaur are dc"]),
        ({"speed_filter": 0.001}, ["speed_filter belongs to motors of kind joint", "motors of minitaur are dc"]),
        ({"rotor_inertia": 0.0}, ["rotor_inertia belongs to motors of kind joint", "motors of minitaur are dc"]),
        ({"voltage": [16.0, 15.0]}, ["voltage has shape (2,)", "(5,)"]),
        ({"motor_strength": np.ones((5, 3))}, ["motor_strength has shape (5, 3)", "(5, 8)"]),
    ],
)
def test_invalid_values_are_rejected(robot, params, values, pieces):
    with pytest.raises(SurefootError) as caught:
        params.with_values(robot, **values)
    message = str(caught.value)
    assert "\n" not in message
    for piece in pieces:
        assert piece in message


def test_rows_selects_robots_by_index(robot, params):
    changed = params.with_values(robot, voltage=[14, 15, 16, 16.5, 16.8])
    rows = changed.rows([4, 0])
    assert rows.num_envs == 2
    assert rows.voltage.tolist() == [16.8, 14]
    assert rows.motor_strength.shape == (2, 8)


def test_set_rows_replaces_robots_by_index(robot, params):
    rows = params.rows([0, 0]).with_values(robot, voltage=[14.0, 15.0])
    params.set_rows([4, 1], rows)
    assert params.voltage.tolist() == [16.0, 15.0, 16.0, 16.0, 14.0]
    rows.imu_noise[0] = 9.0
    with pytest.raises(SurefootError, match="imu_noise is 9"):
        rows.check(robot)


def test_parse_settings_of_a_command_line():
    assert parse_settings(["voltage=15.5", "imu_bias=1e-2"]) == {"voltage": 15.5, "imu_bias": 0.01}
    assert parse_settings([]) == {}


@pytest.mark.parametrize(
    ("word", "piece"),
    [
        ("volts=3", "'volts' is not a physical parameter; did you mean voltage? choices: "),
        ("voltage", "write voltage=VALUE"),
    ],
)
def test_invalid_settings_are_rejected(word: str, piece: str):
    with pytest.raises(SurefootError) as caught:
        parse_settings([word])
    assert piece in str(caught.value)
