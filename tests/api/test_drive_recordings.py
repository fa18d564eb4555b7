"""Recordings of the drive page: partial files of a killed page, and finished recordings."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.api.drive_recordings import DriveRecordings
from surefoot.api.policies import find_policy, load_gait
from surefoot.columns import columns_of
from surefoot.errors import SurefootError
from surefoot.evaluation.command_runs import DrivenRobot
from surefoot.evaluation.recorded import find_traces
from surefoot.task.trace import EpisodeTrace


@pytest.fixture(scope="module")
def robot() -> DrivenRobot:
    policy, _, task, _ = load_gait(find_policy("steer"), None)
    return DrivenRobot(policy, task, "mujoco")


def rows_on_disk(folder: Path, steps: int) -> EpisodeTrace:
    """Return the only trace in a folder, after it has a given number of control steps."""
    end = time.monotonic() + 20.0
    while True:
        try:
            ((_, trace),) = find_traces(folder)
            if trace.num_steps == steps or time.monotonic() > end:
                return trace
        except SurefootError:
            if time.monotonic() > end:
                raise
        time.sleep(0.02)


def test_all_written_steps_of_an_interrupted_recording_are_kept(robot: DrivenRobot, tmp_path: Path):
    recordings = DriveRecordings(tmp_path)
    robot.command([0.3, 0.0, 0.0])
    recordings.start({"steer": robot})
    for _ in range(25):
        robot.step()
    cut = rows_on_disk(tmp_path, 25)  # nothing has ended the recording, as in a process that is killed
    assert {"ended": "fault", "reason": "cut off", "policy": "steer", "world": "mujoco"}.items() <= cut.meta.items()
    recordings.stop()
    recordings.close()
    assert recordings.error == ""
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]
    whole = EpisodeTrace.load(recordings.files["npz"])
    for name in columns_of(EpisodeTrace):
        np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name), err_msg=name)
    assert {**cut.meta, "ended": "stopped"} == {**whole.meta, "reason": "cut off"}


def test_robots_that_run_together_are_recorded_in_separate_files(robot: DrivenRobot, tmp_path: Path):
    ghost, recordings = DrivenRobot(robot.policy, robot.env.task, "mujoco"), DriveRecordings(tmp_path / "deep")
    recordings.start({"steer": robot, "other (ghost)": ghost})
    with pytest.raises(SurefootError, match="html, mp4"):
        recordings.export("gif")
    robot.step()
    ghost.step()
    recordings.close()
    names = {kind: EpisodeTrace.load(path).meta["policy"] for kind, path in recordings.files.items()}
    assert names == {"npz": "steer", "ghost": "other (ghost)"}
    assert recordings.files["ghost"].stem == f"{recordings.files['npz'].stem}-ghost"


def test_an_export_shows_the_map_of_the_recording(robot: DrivenRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    commands: list[list[str]] = []
    recordings = DriveRecordings(tmp_path)
    for terrain in (str(tmp_path / "hill.npz"), "stairs:0.1"):
        recordings.start({"steer": robot}, terrain)
        robot.step()
        recordings.stop()
        while recordings.is_recording or recordings._thread is not None:
            recordings.update()
        with monkeypatch.context() as patch:
            patch.setattr(subprocess, "Popen", lambda words, **_: commands.append(words) or SimpleNamespace(pid=0))
            patch.setattr("os.setpriority", lambda *_: None)
            recordings.export("html")
        recordings._process = None
    place = commands[0].index("--terrain")
    assert commands[0][place + 1] == str(tmp_path / "hill.npz")
    assert "--terrain" not in commands[1]


def test_a_folder_that_cannot_be_written_is_rejected_before_the_recording(robot: DrivenRobot, tmp_path: Path):
    (tmp_path / "file").touch()
    recordings = DriveRecordings(tmp_path / "file" / "recordings")
    with pytest.raises(SurefootError, match="recordings: can't be written: Not a directory"):
        recordings.start({"steer": robot})
    assert not recordings.is_recording


def test_a_recording_without_a_control_step_is_an_error(robot: DrivenRobot, tmp_path: Path):
    recordings = DriveRecordings(tmp_path)
    recordings.start({"steer": robot})
    recordings.close()
    assert (recordings.error, recordings.files) == ("the recording is lost: no control step was recorded", {})
    assert list(tmp_path.iterdir()) == []
