"""Merging of identified parameters into a parameter file, which keeps all other entries."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from surefoot import __version__
from surefoot.errors import SurefootError
from surefoot.identify.result import NORMAL_95, Identification, ParameterEstimate
from surefoot.identify.robot_params_file import merge_estimates, missing_experiments, read_prior, write_robot_params
from surefoot.robot import RobotDescription

TEXT = """robot = "minitaur"
owner = "lab 3"
[params]
voltage = 15.0
motor_strength = 0.97
contact_friction = 0.8
[note]
by = "hand"
[note.more]
deep = [[1, 2], [3]]
"""


def motor(strength: float = 0.9, missing: int = 3) -> Identification:
    """Return a result in which the resistance and the strength of motor `missing` are not identifiable."""
    estimates = [
        ParameterEstimate("motor_strength", strength + 0.01 * i, 0.005, "1", i, i != missing, low=0.0) for i in range(8)
    ]
    estimates += [
        ParameterEstimate("voltage", 15.4, 0.1, "V", low=0.0),
        ParameterEstimate("resistance", 0.3, 0.1, "Ohm", identifiable=False),
        ParameterEstimate("motor_friction", 0.001, 0.01, "N m", 0, low=0.0),
        ParameterEstimate("base_height", 0.02, 0.001, "m", 0),
    ]
    sensors = {"torque_gain": [0.01, -0.02] * 4, "torque_accuracy": 0.004}
    return Identification("motor", "minitaur", tuple(estimates), sensors=sensors, digest="ab12", date="2026-11-21")


def test_prior_without_a_file_is_nominal(robot: RobotDescription, tmp_path: Path):
    for path in (None, tmp_path / "none.toml"):
        prior = read_prior(path, robot)
        assert (prior.names, prior.tables) == ((), {})
        assert prior.params.voltage[0] == robot.dc_motor.voltage
        assert missing_experiments(prior, ("motor", "mass")) == ("motor", "mass")


def test_merged_parameters_are_read_as_written(robot: RobotDescription, tmp_path: Path):
    path = tmp_path / "folder" / "robot.toml"
    after = merge_estimates(read_prior(path, robot), motor(), robot, "recording.npz")
    write_robot_params(path, robot, after)
    again = read_prior(path, robot)
    # Parameters are in the order of `PhysicalParams`, without unidentifiable ones.
    assert again.names == ("motor_friction", "motor_strength", "voltage")
    assert again.tables == {"robot": "minitaur", **after.tables}
    np.testing.assert_array_equal(again.params.motor_strength, after.params.motor_strength)
    expected = 0.9 + 0.01 * np.arange(8)
    expected[3] = 1.0
    np.testing.assert_array_equal(again.params.motor_strength[0], expected)
    assert again.params.resistance[0] == robot.dc_motor.resistance
    assert again.tables["sensors"] == {"torque_gain": [0.01, -0.02] * 4, "torque_accuracy": 0.004}
    source = again.tables["identified"]["motor"]
    assert source == {"date": "2026-11-21", "data": "ab12", "file": "recording.npz", "surefoot": __version__}
    assert missing_experiments(again, ("motor", "mass")) == ("mass",)


def test_intervals_are_written_for_numbers_and_for_motors(robot: RobotDescription):
    tables = merge_estimates(read_prior(None, robot), motor(), robot).tables
    reach = NORMAL_95 * 0.1
    assert tables["intervals"]["voltage"] == pytest.approx([15.4 - reach, 15.4 + reach])
    strength = tables["intervals"]["motor_strength"]
    assert len(strength) == 8
    assert strength[3] == [-math.inf, math.inf]
    assert strength[0] == pytest.approx([0.9 - NORMAL_95 * 0.005, 0.9 + NORMAL_95 * 0.005])
    # Only the first motor's friction was identifiable, and friction is not negative.
    assert tables["intervals"]["motor_friction"][0][0] == 0.0
    assert tables["intervals"]["motor_friction"][1:] == [[-math.inf, math.inf]] * 7
    # Quantities that no simulator models are also reported, but are not parameters.
    assert tables["intervals"]["base_height"] == [pytest.approx([0.01804, 0.02196], abs=1e-5)]
    assert "resistance" not in tables["intervals"]
    assert tables["identified_by"] == dict.fromkeys(
        ("motor_strength", "voltage", "motor_friction", "base_height"), "motor"
    )


def test_merging_keeps_all_other_entries_of_the_file(robot: RobotDescription, tmp_path: Path):
    path = tmp_path / "robot.toml"
    path.write_text(TEXT)
    write_robot_params(path, robot, merge_estimates(read_prior(path, robot), motor(), robot, "a.npz"))
    contact = ParameterEstimate("contact_friction", 0.7, 0.02, "1")
    identified = Identification(
        "contact", "minitaur", (contact, ParameterEstimate("voltage", 15.2, 0.05, "V")), digest="cd"
    )
    write_robot_params(path, robot, merge_estimates(read_prior(path, robot), identified, robot, "b.npz"))
    prior = read_prior(path, robot)
    assert prior.tables["owner"] == "lab 3"
    assert prior.tables["note"] == {"by": "hand", "more": {"deep": [[1, 2], [3]]}}
    assert prior.names == ("motor_friction", "motor_strength", "voltage", "contact_friction")
    # The motor that was not identifiable keeps the file's value.
    assert prior.params.motor_strength[0, 3] == 0.97
    assert (prior.params.voltage[0], prior.params.contact_friction[0]) == (15.2, 0.7)
    assert prior.tables["identified_by"]["voltage"] == "contact"
    assert prior.tables["identified_by"]["motor_strength"] == "motor"
    assert set(prior.tables["identified"]) == {"motor", "contact"}
    assert prior.tables["sensors"]["torque_accuracy"] == 0.004
    assert missing_experiments(prior, ("motor", "contact")) == ()


def test_a_repeated_experiment_replaces_its_results(robot: RobotDescription, tmp_path: Path):
    path = tmp_path / "robot.toml"
    write_robot_params(path, robot, merge_estimates(read_prior(path, robot), motor(), robot, "a.npz"))
    write_robot_params(path, robot, merge_estimates(read_prior(path, robot), motor(0.8, missing=5), robot, "b.npz"))
    prior = read_prior(path, robot)
    assert prior.params.motor_strength[0, 3] == pytest.approx(0.83)
    # A motor that is not identifiable this time keeps its previous interval.
    assert prior.params.motor_strength[0, 5] == pytest.approx(0.95)
    assert prior.tables["intervals"]["motor_strength"][5][0] == pytest.approx(0.95 - NORMAL_95 * 0.005)
    assert prior.tables["identified"]["motor"]["file"] == "b.npz"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sensors = 3\n[params]", "sensors is 3; it must be a table"),
        ("[params]\n[identified]\nmotor = 1", r"identified\.motor is 1; it must be a table"),
        ('[params]\n[sensors]\ntorque_gain = "high"', r"sensors\.torque_gain is 'high'; it must be 8 numbers within"),
        ("[params]\n[sensors]\ntorque_gain = [0.1, 0.2]", r"torque_gain is \[0\.1, 0\.2\]; it must be 8 numbers"),
        ("[params]\n[sensors]\ntorque_accuracy = nan", r"torque_accuracy is nan; it must be a number within"),
        ('robot = "cat"\n[params]', "has parameters of robot 'cat', not of 'minitaur'"),
    ],
)
def test_prior_rejects_another_robot_and_malformed_tables(
    robot: RobotDescription, tmp_path: Path, text: str, message: str
):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    with pytest.raises(SurefootError, match=message):
        read_prior(path, robot)


def test_training_takes_the_identified_parameters(robot: RobotDescription, tmp_path: Path):
    pytest.importorskip("mujoco")
    from surefoot.cli.helpers.simulator import Simulator
    from surefoot.task.config import TaskConfig

    path = tmp_path / "robot.toml"
    write_robot_params(path, robot, merge_estimates(read_prior(None, robot), motor(), robot))
    task = Simulator(params=path).condition().simulate(TaskConfig())
    assert set(task.params) == {"motor_strength", "motor_friction", "voltage"}
    assert task.nominal(robot).motor_strength[0, 0] == 0.9
