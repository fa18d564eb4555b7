"""Run folders and their lock."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

pytest.importorskip("torch")

from surefoot.cli.main import main
from surefoot.configuration import read_yaml, write_yaml
from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.folder_lock import folder_lock
from surefoot.learn.run_folder import RunFolder, read_checkpoint


def test_a_second_resume_is_rejected_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = RunFolder.create_at(TrainConfig(), tmp_path / "run")
    before, rule = sorted(folder.path.rglob("*")), "another process trains in this folder; wait for it, or end it"
    with folder_lock(folder.path):
        assert main(["train", "--resume", str(folder.path)]) == 2
        with pytest.raises(SurefootError, match=rule), folder_lock(folder.path, timeout=0.1):
            pass
    assert capsys.readouterr() == ("", f"surefoot: error: {folder.path}: {rule}\n")
    assert sorted(folder.path.rglob("*")) == sorted([*before, folder.path / "lock"])


@pytest.mark.parametrize("content", ["{", "[]", "{}", "[" * 10_000])
def test_a_damaged_run_json_is_rejected(tmp_path: Path, content: str):
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(SurefootError, match=r"run\.json: is damaged; it must be the JSON that surefoot wrote"):
        RunFolder.open(tmp_path)


def test_a_run_with_the_keys_of_every_kind_of_reference_opens(tmp_path: Path):
    """Runs of earlier versions have the keys of all kinds."""
    config = load_train_config("trot", "go2")
    folder = RunFolder.create_at(config, tmp_path / "run")
    data = read_yaml(folder.path / "config.yaml")
    data["task"]["reference"] |= {"swing": {"amplitude": 0.2}, "file": None, "stride_gain": 1.2, "over_holes": None}
    write_yaml(folder.path / "config.yaml", data)
    assert RunFolder.open(folder.path)[1] == config


def test_a_folder_that_can_not_be_made_is_rejected(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(SurefootError, match=r"file/run: a run folder can't be made there: Not a directory"):
        RunFolder.create_at(TrainConfig(), tmp_path / "file" / "run")


def test_a_failed_write_leaves_saved_checkpoints_unchanged(tmp_path: Path):
    folder = RunFolder.create_at(TrainConfig(), tmp_path / "run")
    for steps in (1, 2):
        folder.save({"steps": steps, "weights": "w" * 80_000})
    saved = [path.read_bytes() for path in (folder.latest, folder.previous)]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(SurefootError, match=r"can't be written: .*; files saved earlier are unchanged"):
            folder.save({"steps": 3, "weights": "w" * 80_000})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.read_bytes() for path in (folder.latest, folder.previous)] == saved


def test_a_file_of_another_kind_is_no_checkpoint(tmp_path: Path):
    (tmp_path / "checkpoint.pt").write_bytes(b"PK" + bytes(100))
    with pytest.raises(SurefootError, match="is not a surefoot checkpoint, or its start is damaged"):
        read_checkpoint(tmp_path / "checkpoint.pt")
