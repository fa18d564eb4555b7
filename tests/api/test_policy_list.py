"""List of policies on a page: the user's runs, newest first, then released policies, all for one robot."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from surefoot.api.policies import find_policy
from surefoot.api.policy_list import MAX_RUNS, list_policies


def make_run(path: Path, policy: str, modified: float) -> Path:
    path.parent.mkdir(parents=True)
    shutil.copy(find_policy(policy), path)
    os.utime(path, (modified, modified))
    return path


def test_the_users_runs_come_newest_first_before_released_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    make_run(Path("runs/steer/monday/policy.onnx"), "go2-steer", 100.0)
    make_run(Path("runs/steer/tuesday/policy.onnx"), "go2-trot", 200.0)
    make_run(Path("runs/other/robot/policy.onnx"), "pupper_v2-trot", 300.0)
    make_run(Path("runs/broken/file/policy.onnx"), "go2-trot", 400.0).write_bytes(b"no policy")
    names = [(entry.label, entry.group.split()[0]) for entry in list_policies("go2-steer", "go2")]
    assert names[:2] == [("steer/tuesday", "your"), ("steer/monday", "your")]
    shipped = {"scratch", "steer", "terrain", "terrain-seeing", "trot", "trot-robust"}
    assert {name for name, _ in names[2:]} == {f"go2-{one}" for one in shipped}
    for entry in list_policies("go2-steer", "go2"):
        assert find_policy(entry.name).is_file()


def test_the_given_policy_is_first_and_listed_once(tmp_path: Path):
    for k in range(MAX_RUNS + 3):
        make_run(tmp_path / f"run{k}" / "policy.onnx", "go2-steer", 100.0 + k)
    for given in (tmp_path / "run1" / "policy.onnx", tmp_path / "run1"):
        entries = list_policies(str(given), "go2")
        assert (entries[0].name, entries[0].group) == (str(given), "selected")
        assert [Path(entry.name).parent.name for entry in entries[1:3]] == [f"run{MAX_RUNS + 2}", f"run{MAX_RUNS + 1}"]
        assert len([entry for entry in entries if entry.group.startswith("your")]) == MAX_RUNS
        assert "run1" not in [Path(entry.name).parent.name for entry in entries[1:]]
