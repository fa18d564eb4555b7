"""Files from workers; complete trainings on Ray are in the tests of `study` and `search`."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")

from surefoot.learn.run_config import copied_files, write_run_config
from surefoot.robot import RobotDescription
from surefoot.studies.training import Training, base_config
from surefoot.studies.workers import _RETURNED_FILES, ProgressReport, _store_files


def test_files_of_a_remote_computer_are_stored_with_the_policy_last(tmp_path: Path):
    training = Training("small", base_config("trot"), tmp_path / "runs" / "small")
    files = {name: name.encode() for name in reversed(_RETURNED_FILES)}
    broken = {name: content for name, content in files.items() if name != "figures.jsonl"}
    with pytest.raises(KeyError):
        _store_files(training, ProgressReport(1, finished=True, files=broken))
    # Partial files do not make a training finished.
    assert not training.policy.exists()
    _store_files(training, ProgressReport(1, finished=True, files=files))
    assert {path.name: path.read_text() for path in training.path.iterdir()} == {name: name for name in _RETURNED_FILES}
    # A shared folder already has all files.
    training.policy.write_text("the worker's own")
    _store_files(training, ProgressReport(1, finished=True, files=files))
    assert training.policy.read_text() == "the worker's own"


def test_a_run_that_train_resumed_and_that_was_stopped_is_not_finished(tmp_path: Path):
    training = Training("small", replace(base_config("trot"), steps=1000), tmp_path)
    (tmp_path / "checkpoints").mkdir()
    for name in ("policy.onnx", "checkpoints/latest.ckpt"):
        (tmp_path / name).touch()
    write_run_config(training.config, tmp_path)
    for steps, state in ((999, "started"), (1024, "finished")):
        (tmp_path / "figures.jsonl").write_text(json.dumps({"steps": steps}) + "\n")
        assert training.state == state
    # A pruned trial ends early.
    (tmp_path / "figures.jsonl").write_text(json.dumps({"steps": 999}) + "\n")
    assert replace(training, trial=True).state == "finished"


def test_a_run_is_returned_with_its_copy_of_a_custom_robot(tmp_path: Path):
    shutil.copytree(RobotDescription.find_folder("solo8"), tmp_path / "mine")
    base = base_config("trot")
    config = replace(base, task=replace(base.task, robot=str(tmp_path / "mine")))
    there, here = tmp_path / "there", Training("small", config, tmp_path / "here")
    there.mkdir()
    write_run_config(config, there)
    for name in _RETURNED_FILES[1:]:
        (there / name).touch()
    names = (*_RETURNED_FILES, *copied_files(there))
    assert {"robot/robot.toml", "robot/solo8.urdf"} <= {*names}
    _store_files(here, ProgressReport(1, finished=True, files={name: (there / name).read_bytes() for name in names}))
    assert here.stored().task.robot == str(tmp_path / "here" / "robot")
    here.check()
