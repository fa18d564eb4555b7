"""What comes back from workers; whole trainings on Ray are in tests of `study` and `search`."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("torch")

from surefoot.studies.training import Training, base_config
from surefoot.studies.workers import _FILES, ProgressReport, _store_files


def test_files_of_a_computer_that_shares_no_folder_are_kept_and_the_policy_comes_last(tmp_path: Path):
    training = Training("small", base_config("trot"), tmp_path / "runs" / "small")
    files = {name: name.encode() for name in reversed(_FILES)}
    broken = {name: content for name, content in files.items() if name != "figures.jsonl"}
    with pytest.raises(KeyError):
        _store_files(training, ProgressReport(1, finished=True, files=broken))
    # What came in part makes no training finished.
    assert not training.policy.exists()
    _store_files(training, ProgressReport(1, finished=True, files=files))
    assert {path.name: path.read_text() for path in training.path.iterdir()} == {name: name for name in _FILES}
    # A folder that is shared has it all.
    training.policy.write_text("the worker's own")
    _store_files(training, ProgressReport(1, finished=True, files=files))
    assert training.policy.read_text() == "the worker's own"
