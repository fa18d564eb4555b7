"""Notes that are printed before a training."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")

from surefoot.api.training import replaced_note, start_note
from surefoot.learn.config import load_train_config
from surefoot.learn.run_folder import RunFolder
from surefoot.robot import RobotDescription
from surefoot.robot.randomization import RelativeRange, load_ranges, resolve_range


def note_after_steer(tmp_path: Path, task: str, robot: str) -> str | None:
    """Return the note for a training that starts from a run of the robot's task `steer`."""
    run = RunFolder.create_at(load_train_config("steer", robot), tmp_path / "run")
    return start_note(replace(load_train_config(task, robot), start_from=str(run.path)))


def test_there_is_no_note_if_the_reference_is_unchanged(tmp_path: Path) -> None:
    assert note_after_steer(tmp_path, "steer-robust", "pupper_v2") is None
    assert start_note(load_train_config("steer", "pupper_v2")) is None


def test_a_reference_that_differs_from_the_previous_run_is_reported(tmp_path: Path) -> None:
    # The Minitaur's `steer` lifts one foot after the other, at 3.5 / 2.6 times the frequency of the generic task.
    note = note_after_steer(tmp_path, "steer-robust", "minitaur")
    assert note is not None
    assert "reference.foot.frequency 2.6 (was 3.5), reference.foot.clearance 0.1 (was 0.06)" in note
    assert note.endswith(" more")


def test_gains_that_differ_from_the_previous_run_are_reported(tmp_path: Path) -> None:
    note = note_after_steer(tmp_path, "terrain", "go2")
    assert note is not None
    assert "params.servo_kp not set (was 40.0), params.servo_kd not set (was 1.0), reference." in note


def test_another_robot_than_that_of_the_previous_run_is_reported(tmp_path: Path) -> None:
    run = RunFolder.create_at(load_train_config("trot", "solo8"), tmp_path / "run")
    note = start_note(replace(load_train_config("trot", "go2"), start_from=str(run.path)))
    assert note is not None
    assert "another robot" in note
    assert note.endswith("other effects: robot go2 (was solo8)")
    # The copy in the folder of a run is the same robot.
    folder = tmp_path / "own"
    shutil.copytree(RobotDescription.find_folder("go2"), folder)
    own = load_train_config("trot", str(folder))
    other = RunFolder.create_at(own, tmp_path / "other")
    assert start_note(replace(own, start_from=str(other.path))) is None


def test_ranges_that_replace_given_values_are_reported() -> None:
    config = load_train_config("trot", "minitaur")
    given = {"base_mass_ratio": 1.3, "control_latency": 0.01, "knee_friction": 0.1}
    ranges = load_ranges("table1") | {"control_latency": RelativeRange(scale=(0.9, 1.1))}
    note = replaced_note(replace(config, task=replace(config.task, params=given, randomize=ranges)))
    assert note is not None
    assert note.startswith("ranges replace the given values of base_mass_ratio; --randomize.base-mass-ratio scale")
    assert replaced_note(replace(config, task=replace(config.task, randomize=ranges))) is None


def test_table1_of_any_robot_is_around_identified_values() -> None:
    config = load_train_config("steer", "go2")
    ranges = load_ranges("table1", robot="go2")
    given = {"base_mass_ratio": 1.3, "motor_strength": 0.9, "imu_bias": (0.02, 0.0)}
    task = replace(config.task, params={**config.task.params, **given}, randomize=ranges)
    assert replaced_note(replace(config, task=task)) is None
    robot = RobotDescription.load("go2")
    low, high = resolve_range(ranges["base_mass_ratio"], task.nominal(robot).base_mass_ratio)
    assert (float(low[0]), float(high[0])) == pytest.approx((1.04, 1.56))
    low, high = resolve_range(ranges["imu_bias"], task.nominal(robot).imu_bias)
    np.testing.assert_allclose([low[0], high[0]], [[-0.03, -0.05], [0.07, 0.05]])


def test_no_released_task_has_replaced_values() -> None:
    for robot in ("minitaur", "go2", "pupper_v2", "solo8"):
        for task in ("trot", "trot-robust", "steer", "steer-robust", "terrain"):
            assert replaced_note(load_train_config(task, robot)) is None, (task, robot)
