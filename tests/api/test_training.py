"""Notes that are printed before a training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")

from surefoot.api.training import start_note
from surefoot.learn.config import load_train_config
from surefoot.learn.run_folder import RunFolder


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
    assert "reference.foot.frequency 2.6 (was 3.5), reference.foot.clearance 0.09 (was 0.06)" in note
    assert note.endswith(" more")


def test_gains_that_differ_from_the_previous_run_are_reported(tmp_path: Path) -> None:
    note = note_after_steer(tmp_path, "terrain", "go2")
    assert note is not None
    assert "params.servo_kp not set (was 40.0), params.servo_kd not set (was 1.0), reference." in note
