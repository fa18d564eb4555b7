"""Limits of what is read, and files that a killed process left."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from surefoot.files import CONFIGURATION_BYTES, check_readable, read_configuration, remove_abandoned


def test_a_configuration_is_a_regular_file_of_limited_size(tmp_path: Path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"x" * CONFIGURATION_BYTES)
    assert len(read_configuration(path)) == CONFIGURATION_BYTES
    path.write_bytes(b"x" * (CONFIGURATION_BYTES + 1))
    with pytest.raises(OSError, match=f"{CONFIGURATION_BYTES + 1} bytes"):
        read_configuration(path)


@pytest.mark.timeout(10)
def test_what_has_no_end_is_not_begun(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        for read in (check_readable, read_configuration):
            with pytest.raises(OSError, match=r"not a regular file|Is a directory"):
                read(path)


def test_files_under_way_of_killed_processes_are_removed_alone(tmp_path: Path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    gone = [tmp_path / f".fresh.ckpt.{pid}.tmp" for pid in (dead.pid, 10**30)]
    kept = [tmp_path / name for name in (f".fresh.ckpt.{os.getpid()}.tmp", "fresh.ckpt", ".a.tmp", f"b.{dead.pid}.tmp")]
    for path in (*gone, *kept):
        path.touch()
    remove_abandoned(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(kept)
