"""Hidden robots of a study: random parameters, motors, and values that trainings take from their files."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import read_params, write_params
from surefoot.robot.randomization import draw_hidden, load_ranges
from surefoot.studies.hidden_robots import (
    HiddenRobots,
    OtherMotors,
    check_identified,
    read_identified,
    robot_file,
    select_identified,
)

MINITAUR = RobotDescription.load("minitaur")
LIMITED = {"voltage_clip": 6.0, "viscous_friction": 0.005}
ROBOTS = HiddenRobots((201, 202), load_ranges("ensemble"), other_motors=OtherMotors((202,), LIMITED), robot="minitaur")


def test_robots_are_drawn_from_the_ensembles_ranges(tmp_path: Path) -> None:
    drawn, expected = ROBOTS.params(201, tmp_path), draw_hidden(MINITAUR, load_ranges("ensemble"), 201)
    for name in PhysicalParams.names():
        np.testing.assert_array_equal(getattr(drawn, name), getattr(expected, name))
    offsets = replace(ROBOTS, ranges={**ROBOTS.ranges, "motor_offset": (-0.02, 0.02)}).params(201, tmp_path)
    assert 0 < np.abs(offsets.motor_offset).max() <= 0.02
    assert np.ptp(offsets.motor_offset) > 0  # one value per encoder
    np.testing.assert_array_equal(offsets.motor_strength, drawn.motor_strength)  # other parameters are the same
    assert [ROBOTS.family(seed) for seed in ROBOTS.seeds] == ["own", "other"]


def test_other_motors_have_their_own_robot_description(tmp_path: Path) -> None:
    assert ROBOTS.description(201, tmp_path / "other") == "minitaur"
    folder = ROBOTS.description(202, tmp_path / "other")
    other = RobotDescription.load(folder)
    assert (other.name, other.dc_motor.voltage_clip, MINITAUR.dc_motor.voltage_clip) == ("minitaur", 6.0, 50.0)
    assert other.dc_motor.torque_table_torque == MINITAUR.dc_motor.torque_table_torque
    assert ROBOTS.params(202, tmp_path / "other").motor_viscous_friction[0, 0] == 0.005
    before = (tmp_path / "other" / "robot.toml").stat().st_mtime_ns
    assert ROBOTS.description(202, tmp_path / "other") == folder
    assert (tmp_path / "other" / "robot.toml").stat().st_mtime_ns == before
    wrong = replace(ROBOTS, other_motors=OtherMotors((202,), {"torque_table_current": [0.0, 1.0]}))
    with pytest.raises(SurefootError, match="torque_table_current has 2 points"):
        wrong.description(202, tmp_path / "wrong")


def test_identifications_in_parallel_make_one_robot_description(tmp_path: Path) -> None:
    count, failures, barrier = 16, list[BaseException](), threading.Barrier(16)

    def make(folder: Path) -> None:
        try:
            barrier.wait()
            robot = RobotDescription.load(ROBOTS.description(202, folder))
            assert robot.dc_motor.voltage_clip == 6.0  # never the motors of the data sheet, not even for a moment
        except BaseException as error:
            failures.append(error)

    for attempt in range(5):
        threads = [threading.Thread(target=make, args=(tmp_path / str(attempt),)) for _ in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not failures
        assert not list((tmp_path / str(attempt)).rglob("*.tmp"))


def test_trainings_take_parameters_by_name_or_group_and_never_the_controllers(tmp_path: Path) -> None:
    params = PhysicalParams.nominal(MINITAUR).with_values(MINITAUR, servo_kp=0.9, voltage=15.0, base_mass_ratio=1.1)
    names = ("base_mass_ratio", "control_step", "control_latency", "voltage", "imu_noise", "servo_kp", "servo_kd")
    write_params(robot_file(tmp_path, 201), MINITAUR, params, names=names)
    file = read_params(tmp_path / "robot_201.toml", MINITAUR)
    assert list(select_identified(file, ("body", "imu_noise"))) == ["base_mass_ratio", "imu_noise"]
    everything = select_identified(file, ("body", "motors", "contact", "sensors"))
    assert everything == {"base_mass_ratio": 1.1, "control_latency": 0.02, "voltage": 15.0, "imu_noise": 0.0}
    found = read_identified(tmp_path, 201, "minitaur")
    assert found is not None
    assert (found.names, found.source) == (file.names, file.source)
    assert read_identified(tmp_path, 202, "minitaur") is None
    assert read_identified(None, 201, "minitaur") is None


def test_names_that_no_group_may_take_are_rejected() -> None:
    check_identified(("body", "voltage"), "groups.a.identified")
    with pytest.raises(SurefootError, match=r"^groups\.a\.identified: servo_kp belongs to the controller"):
        check_identified(("body", "servo_kp"), "groups.a.identified")
    with pytest.raises(SurefootError, match="'imu' is neither a physical parameter nor a group of them"):
        check_identified(("imu",), "groups.a.identified")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds": (201, 201)}, r"robots\.seeds is \[201, 201\]; it needs 1 or more, all different"),
        ({"other_motors": OtherMotors((7,), {})}, r"robots\.other_motors\.seeds: 7 is not a robot's seed"),
        ({"ranges": {"mass": (0.0, 1.0)}}, "'mass' is not a physical parameter"),
    ],
)
def test_invalid_hidden_robots_are_rejected(change: dict[str, object], message: str) -> None:
    with pytest.raises(SurefootError, match=message):
        replace(ROBOTS, **change)  # type: ignore[arg-type]


def test_other_motors_have_a_value_for_each_key() -> None:
    with pytest.raises(SurefootError, match=r"other_motors\.actuator\.voltage_clip has no value"):
        OtherMotors((7,), {"voltage_clip": None})
