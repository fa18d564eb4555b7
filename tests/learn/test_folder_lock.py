"""Lock of a folder in which one process trains."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("filelock")

from surefoot.errors import SurefootError
from surefoot.learn.folder_lock import folder_lock

HOLD = """
import sys, time
from pathlib import Path
from surefoot.learn.folder_lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_lock_ends_with_its_process_even_if_that_is_killed(tmp_path: Path):
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        assert (tmp_path / "lock").read_text() == f"{holder.pid}\n"
        rule = r": another process trains in this folder; wait for it, or end it$"
        with pytest.raises(SurefootError, match=rule), folder_lock(tmp_path, timeout=0.2):
            pass
        assert (tmp_path / "lock").read_text() == f"{holder.pid}\n"
    finally:
        holder.kill()
        holder.wait()
    for _ in range(2):
        with folder_lock(tmp_path):
            assert (tmp_path / "lock").read_text() == f"{os.getpid()}\n"


def test_an_unwritable_folder_is_rejected_in_one_line(tmp_path: Path):
    (tmp_path / "file").touch()
    (tmp_path / "folder" / "lock").mkdir(parents=True)
    for name in ("file", "folder"):
        with (
            pytest.raises(SurefootError, match=rf"{name}: can't be locked: \w"),
            folder_lock(tmp_path / name),
        ):
            pass


def test_unfinished_files_of_a_killed_run_are_removed(tmp_path: Path):
    (tmp_path / "checkpoints").mkdir()
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    left = [tmp_path / "checkpoints" / f".fresh.ckpt.{dead.pid}.tmp", tmp_path / f".figures.jsonl.{dead.pid}.tmp"]
    for path in left:
        path.touch()
    with folder_lock(tmp_path):
        assert not any(path.exists() for path in left)
