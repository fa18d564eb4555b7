"""Motion capture in a growing file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.deploy.board.signals import MotorCommand
from surefoot.deploy.messages import Mode
from surefoot.emulator.capture_writer import CaptureWriter
from surefoot.emulator.plant import Plant
from surefoot.errors import SurefootError

DAMPED = MotorCommand(Mode.DISARMED, np.zeros(8))


@pytest.fixture
def plant(robot) -> Plant:
    return Plant(robot)


def run(capture: CaptureWriter, plant: Plant, steps: int) -> None:
    for _ in range(steps):
        plant.step(DAMPED)
        capture.update(plant.ticks * 1000)


@pytest.mark.parametrize("later", [False, True])
def test_rows_have_full_precision(plant, tmp_path, later):
    capture = CaptureWriter(tmp_path / "a.csv", plant, later)
    run(capture, plant, 100)
    seen = plant.capture()
    capture.close()
    header, *rows = (tmp_path / "a.csv").read_text().splitlines()
    assert header.split(",")[:8] == ["time", "x", "y", "z", "qw", "qx", "qy", "qz"]
    assert header.split(",")[8:] == [f"contact_{leg}" for leg in plant.robot.leg_names]
    assert len(rows) == 20
    last = [float(word) for word in rows[-1].split(",")]
    assert last[:4] == [0.1, *seen.position.tolist()]
    np.testing.assert_allclose(last[4:8], seen.quat, atol=1e-15)
    assert last[8:] == [1.0] * 4  # it has not moved yet


def test_capture_writer_rejects_an_unwritable_file_at_once(plant, tmp_path):
    (tmp_path / "a.csv").write_text("mine")
    with pytest.raises(SurefootError, match="exists; give another name"):
        CaptureWriter(tmp_path / "a.csv", plant)
    with pytest.raises(SurefootError, match="No such file or directory"):
        CaptureWriter(tmp_path / "there" / "a.csv", plant)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full disk here")
def test_a_full_disk_ends_the_recording_but_not_the_run(plant, tmp_path):
    capture = CaptureWriter(tmp_path / "a.csv", plant)
    capture.file._file = Path("/dev/full").open("wb", buffering=0)  # noqa: SIM115
    run(capture, plant, 20)
    assert capture.file.error == "No space left on device"
    assert plant.ticks == 20
    capture.close()
