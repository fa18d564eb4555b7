"""Parameter files."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams
from surefoot.robot.params_file import param_values, read_params, write_params


def test_a_written_file_is_read_back_exactly(robot, tmp_path):
    rng = np.random.default_rng(1)
    params = PhysicalParams.nominal(robot).with_values(
        robot, motor_strength=rng.uniform(0.8, 1.2, (1, 8)), voltage=15.1 + 1e-15, imu_bias=[[0.1, -0.2]]
    )
    tables = {"origin": {"date": '"x" \\ y', "tries": 3, "good": True, "interval": [0.1, 1e-7]}}
    path = write_params(tmp_path / "p.toml", robot, params, tables)
    loaded = read_params(path, robot)
    for name in PhysicalParams.names():
        np.testing.assert_array_equal(getattr(loaded.params, name), getattr(params, name), err_msg=name)
    assert loaded.names == tuple(PhysicalParams.names(robot))
    assert loaded.tables == {"robot": "minitaur", **tables}


def test_values_contain_only_parameters_of_the_file(robot, tmp_path):
    path = tmp_path / "p.toml"
    text = f"[params]\nvoltage = 15\nimu_bias = [0.1, -0.2]\nmotor_friction = {[0.02] * 8}\n"
    path.write_text(text)
    loaded = read_params(path, robot)
    assert loaded.values == {"voltage": 15.0, "imu_bias": (0.1, -0.2), "motor_friction": 0.02}
    assert loaded.params.voltage[0] == 15.0
    assert loaded.params.resistance[0] == robot.dc_motor.resistance
    assert loaded.source == {"file": "p.toml", "sha256": hashlib.sha256(text.encode()).hexdigest()}
    path.write_text("[params]\n")
    assert read_params(path, robot).values == {}
    strength = np.linspace(0.9, 1.1, 8)
    params = PhysicalParams.nominal(robot).with_values(robot, motor_strength=strength)
    assert param_values(params) == {**robot.nominal_params(), "motor_strength": tuple(strength)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("voltage = 15", r"p\.toml: has no table \[params\]"),
        ("params = 3", r"p\.toml: has no table \[params\]"),
        ("[params", r"p\.toml: is not TOML"),
        ('robot = "cat"\n[params]', r"p\.toml: has parameters of robot 'cat', not of 'minitaur'"),
        ("[params]\nvolts = 15", r"p\.toml: 'volts' is not a physical parameter; did you mean voltage\? choices: base"),
        ("[params]\nvoltage = 99", r"p\.toml: voltage is 99; minitaur allows 5 to 30"),
        ("[params]\nvoltage = nan", r"p\.toml: params\.voltage is nan"),
        ('[params]\nvoltage = "15"', r"p\.toml: params\.voltage is '15'; it must be a finite number or a list"),
        ("[params]\nvoltage = true", r"p\.toml: params\.voltage is True"),
        ("[params]\nvoltage = []", r"p\.toml: params\.voltage is \[\]"),
        ("[params]\nmotor_strength = [1.0, 0.9]", r"p\.toml: motor_strength has shape \(2,\); it must fit \(1, 8\)"),
    ],
)
def test_invalid_files_are_rejected(robot, tmp_path, text, message):
    path = tmp_path / "p.toml"
    path.write_text(text)
    with pytest.raises(SurefootError, match=message) as caught:
        read_params(path, robot)
    assert "\n" not in str(caught.value)


def test_a_missing_file_or_folder_is_rejected(robot, tmp_path):
    with pytest.raises(SurefootError, match="No such file"):
        read_params(tmp_path / "p.toml", robot)
    with pytest.raises(SurefootError, match="No such file"):
        write_params(tmp_path / "there" / "p.toml", robot, PhysicalParams.nominal(robot))


def test_other_tables_of_a_file_are_preserved(robot, tmp_path):
    text = """robot = "minitaur"
owner = "lab 3"
since = 2026-01-02
tries = [{ at = 09:30:00, good = true }, { good = false }]
[params]
voltage = 15.0
[empty]
[a.b]
low = [[-inf, 0.5], [1, 2]]
[a."c d".e]
when = 2026-01-02T03:04:05Z
"""
    path = tmp_path / "p.toml"
    path.write_text(text)
    first = read_params(path, robot)
    write_params(path, robot, first.params, first.tables, first.names)
    again = read_params(path, robot)
    assert again.tables == first.tables
    assert again.names == ("voltage",)
    assert again.tables["a"]["b"]["low"] == [[-np.inf, 0.5], [1, 2]]
    write_params(path, robot, first.params, {}, ())
    assert read_params(path, robot).names == ()


def test_numpy_scalars_are_written_as_numbers(robot, tmp_path):
    table = {"a": np.float64(0.1), "b": [np.float32(0.5), np.int64(3)], "c": np.bool_(True), "d": {"e": np.float64(1)}}
    path = write_params(tmp_path / "p.toml", robot, PhysicalParams.nominal(robot), {"table": table}, ())
    assert read_params(path, robot).tables["table"] == {"a": 0.1, "b": [0.5, 3], "c": True, "d": {"e": 1.0}}


def test_a_value_that_toml_can_not_represent_is_rejected(robot, tmp_path):
    with pytest.raises(SurefootError, match=r"can't hold it: .*NoneType"):
        write_params(tmp_path / "p.toml", robot, PhysicalParams.nominal(robot), {"a": {"b": None}})
    assert list(tmp_path.iterdir()) == []
