"""Ranges of physical parameters: tables, files, tasks, identified robots, and invalid ranges."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.params_file import read_params
from surefoot.robot.randomization import Randomizer, Ranges, RelativeRange, load_ranges, range_names
from surefoot.task.config import load_task

TABLE_1: Ranges = {
    "base_mass_ratio": (0.80, 1.20),
    "leg_mass_ratio": (0.80, 1.20),
    "motor_friction": (0.0, 0.05),
    "base_inertia_ratio": (0.50, 1.50),
    "leg_inertia_ratio": (0.50, 1.50),
    "motor_strength": (0.80, 1.20),
    "control_step": (0.003, 0.020),
    "control_latency": (0.0, 0.040),
    "voltage": (14.0, 16.8),
    "contact_friction": (0.5, 1.25),
    "imu_bias": (-0.05, 0.05),
    "imu_noise": (0.0, 0.05),
}
"""Tan et al. 2018, table I, in SI units."""


def test_table1_matches_the_paper():
    assert load_ranges("table1") == TABLE_1
    assert range_names() == ["ensemble", "none", "table1"]
    assert load_ranges("none") == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("voltage: [16,", "mine.yaml: is not YAML"),
        ("voltage: [16, 15]", "mine.yaml: randomize.voltage is [16, 15]; the lower bound must come first"),
        ("voltage: [14, .nan]", "randomize.voltage[1] is nan; it must be a finite number"),
        ("voltage: 0.8", "randomize.voltage is 0.8; it must be a list of 2 values, each a number or a list of values"),
        ("voltage: [low, high]", "randomize.voltage is ['low', 'high']; it must be"),
        ("voltage: {}", "randomize.voltage must have one of scale and add"),
        ("voltage: {scale: [0.9, 1.1], add: [0, 1]}", "randomize.voltage must have one of scale and add"),
        ("voltage: {factor: [0.9, 1.1]}", "randomize.voltage.factor is not a key; choices: scale, add, independent"),
        ("voltage: {add: [1, -1]}", "randomize.voltage.add is [1, -1]; the lower bound must come first"),
        ("servo_kp: {scale: [-0.5, 1]}", "randomize.servo_kp.scale is [-0.5, 1]; factors are 0 or more"),
        ("knee_play: {scale: [0, 2]}", "randomize.knee_play.scale is given; write add, as knee_play is 0 for most"),
        (
            "control_latency: [0, 15]",
            "is [0, 15]; minitaur allows control_latency from 0 to 0.1 (unit: s)",
        ),
        ("imu_noise: [-0.05, 0]", "imu_noise is [-0.05, 0]; minitaur allows imu_noise from 0 to 0.5 (unit: rad)"),
        ("control_latency: [[0, 0], [0, 0]]", "has 2 intervals; it must have one, written [LOW, HIGH]"),
        ("imu_mount: [[0, 0], [0, 0]]", "has 2 intervals; it must have one, or one for each of roll, pitch, yaw"),
        ("imu_mount: []", "randomize.imu_mount has 0 intervals; it must have one"),
        ("colour: [0, 1]", "randomize: 'colour' is not a physical parameter; choices: base_mass_ratio, leg_mass_ratio"),
        ("rotor_inertia: [0, 1]", "rotor_inertia belongs to motors of kind joint; the motors of minitaur are dc"),
        ("latency: [0, 0.02]", "randomize: 'latency' is not a physical parameter; did you mean servo_latency?"),
    ],
)
def test_invalid_ranges_are_rejected(tmp_path: Path, text: str, message: str):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(SurefootError, match=re.escape(message)) as caught:
        load_ranges("mine.yaml", tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["tabel1", ".", "robot"])
def test_a_missing_table_is_rejected(tmp_path: Path, name: str):
    with pytest.raises(
        SurefootError, match=rf"randomize '{re.escape(name)}' .*; .*choices: ensemble, none, table1, or"
    ):
        load_ranges(name, tmp_path)


def test_a_robots_own_tables_have_any_name(tmp_path: Path):
    shutil.copytree(RobotDescription.load("go2").folder, tmp_path / "mine")
    (tmp_path / "mine/ranges").mkdir(exist_ok=True)
    (tmp_path / "mine/ranges/windy.yaml").write_text("base_mass_ratio: [0.9, 1.1]\n")
    assert load_ranges("windy", robot=tmp_path / "mine") == {"base_mass_ratio": (0.9, 1.1)}
    with pytest.raises(SurefootError, match=r"randomize 'wind' .*; did you mean windy"):
        load_ranges("wind", robot=tmp_path / "mine")


OTHERS = {name: given for name, given in TABLE_1.items() if name != "control_latency"}


@pytest.mark.parametrize(
    ("randomize", "expected"),
    [
        ("", {}),
        ("randomize: none", {}),
        ("randomize: table1", TABLE_1),
        ("randomize: mine.yaml", {"voltage": (15.0, 16.0)}),  # the path is relative to the task's file
        ("randomize: {control_latency: [0, 0.02], voltage: null}", {"control_latency": (0.0, 0.02)}),
        (
            "randomize: {table: table1, control_latency: null, contact_stiffness: [3000, 30000]}",
            OTHERS | {"contact_stiffness": (3e3, 3e4)},
        ),
        ("randomize: {servo_kp: {scale: [0.9, 1.1]}}", {"servo_kp": RelativeRange(scale=(0.9, 1.1))}),
        ("randomize: {imu_bias: [[0, 0.1], [0, 0]]}", {"imu_bias": ((0.0, 0.1), (0.0, 0.0))}),
    ],
)
def test_a_task_names_a_table_or_has_its_own_ranges(tmp_path: Path, monkeypatch, randomize: str, expected: Ranges):
    (tmp_path / "mine.yaml").write_text("voltage: [15, 16]\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load_task(task_file(tmp_path, randomize))[0].randomize == expected


@pytest.mark.parametrize(
    ("randomize", "message"),
    [
        ("3", "randomize is 3; it must be a table"),
        (
            "{table: tabel1}",
            "randomize 'tabel1' does not exist; did you mean table1\\? choices: ensemble, none, table1",
        ),
        ("{table: table1, speed: [1, 2]}", "'speed' is not a physical parameter; choices: base_mass_ratio"),
    ],
)
def test_a_task_with_invalid_ranges_is_rejected(tmp_path: Path, randomize: str, message: str):
    with pytest.raises(SurefootError, match=rf"task\.yaml: .*{message}"):
        load_task(task_file(tmp_path, f"randomize: {randomize}"))


def task_file(folder: Path, randomize: str) -> str:
    path = folder / "task.yaml"
    path.write_text(f"feedback: {{extension: [1.5, 2.5]}}\n{randomize}\n")
    return str(path)


# --- ranges of an identified robot ------------------------------------------------------------------------


def test_ranges_of_an_identified_robot_are_its_confidence_intervals():
    robot = RobotDescription.load("pupper_v2")
    file = read_params(robot.folder / "identified.toml", robot)
    intervals, ranges = file.tables["intervals"], load_ranges("identified", robot="pupper_v2")
    assert ranges.keys() == intervals.keys()
    for name in ("contact_friction", "servo_kp", "contact_shear_ratio"):
        assert ranges[name] == tuple(intervals[name])
    for name in ("motor_friction", "motor_offset"):
        assert ranges[name] == tuple(map(tuple, intervals[name]))
    # An axis without an interval keeps its value.
    assert ranges["imu_mount"] == ((0.0, 0.0), (0.0, 0.0), tuple(intervals["imu_mount"][2]))
    drawn = Randomizer(ranges, robot, file.params.rows([0] * 20), 1).draw(np.arange(20))
    assert np.all(drawn.imu_mount[:, :2] == 0.0)
    assert np.ptp(drawn.contact_shear_ratio) > 0.1
    low, high = np.transpose(intervals["motor_friction"])
    assert np.all((drawn.motor_friction >= low) & (drawn.motor_friction <= high))
    with pytest.raises(SurefootError, match="randomize 'identified' does not exist"):
        load_ranges("identified", robot="minitaur")


@pytest.mark.parametrize(
    ("intervals", "message"),
    [
        ("", "has no intervals to draw from"),
        ("[intervals]\ncontact_friction = [nan, nan]", "has no intervals to draw from"),
        ("[intervals]\ncontact_friction = 0.5", r"intervals\.contact_friction: must be a pair of numbers"),
        ('[intervals]\ncontact_friction = ["low", "high"]', r"intervals\.contact_friction: must be a pair of numbers"),
        (f"[intervals]\ncontact_friction = [0, 1{'0' * 400}]", r"contact_friction: must be a pair of numbers"),
        ("intervals = 3", r"fit\.toml: intervals is 3; it must be a table"),
        ("[intervals]\ncontact_friction = [[0.4, 0.6]]", r"friction has 1 intervals; it must have one, written"),
        ("[intervals]\ncontact_friction = [[0.4, 0.5, 0.6]]", r"intervals\.contact_friction: must be a pair"),
        ("[intervals]\nimu_mount = [[0.0, 0.1]]", r"fit\.toml: randomize\.imu_mount has 1 intervals; it must have one"),
    ],
)
def test_a_file_without_intervals_is_rejected(tmp_path: Path, intervals: str, message: str):
    folder = tmp_path / "pupper_v2"
    shutil.copytree(RobotDescription.load("pupper_v2").folder, folder)
    (folder / "fit.toml").write_text(f"{intervals}\n[params]\ncontact_friction = 0.5\n")
    with pytest.raises(SurefootError, match=message):
        load_ranges("fit", robot=folder)
