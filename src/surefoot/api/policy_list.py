"""Policies that a page offers for a robot: those of own runs, the newest first, and those that ship."""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from surefoot.api.policies import SEARCH_PATHS, find_policy, released_policies
from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract
from surefoot.policy.digest import check_digest
from surefoot.policy.network import MAX_BYTES

RUNS = Path("runs")
"""Folder in which `surefoot train` makes run folders, if no other is given."""
MAX_RUNS = 30
"""Most policies of own runs in a list."""
_MAX_FILES = 200
"""Most files that are looked into for a list, the newest."""


class PolicyEntry(NamedTuple):
    """A policy of a list."""

    name: str
    """As `find_policy` takes it."""
    label: str
    """Short name for people."""
    group: str
    """Heading in the list."""


def list_policies(policy: str, robot: str) -> list[PolicyEntry]:
    """Return the policy that is given, then those of own runs, and those that ship, all for one robot by its name.

    Own runs are those below `RUNS` and beside the policy that is given.
    """
    file = find_policy(policy)
    shipped = [
        name
        for name, path in sorted(released_policies().items())
        if name == policy or (_robot_of(path) == robot and path.resolve() != file.resolve())
    ]
    first = [] if policy in shipped else [PolicyEntry(policy, run_label(file), "given")]
    runs = [PolicyEntry(str(path), run_label(path), "own runs, newest first") for path in _run_policies(file, robot)]
    return [*first, *runs, *(PolicyEntry(name, name, "shipped with surefoot") for name in shipped)]


def run_label(path: Path) -> str:
    """Return a short name of a policy's file: its run's folder, or folder and file."""
    path = path.resolve()
    parts = path.parent.parts if path.stem == "policy" else (*path.parent.parts, path.stem)
    return "/".join(parts[-2:])


def _run_policies(policy: Path, robot: str) -> list[Path]:
    """Return files of policies for a robot, the newest first, without the one that is given."""
    modified: dict[Path, float] = {}
    for path in _candidates(policy):
        with contextlib.suppress(OSError):  # a run that is being removed
            modified[path.resolve()] = path.stat().st_mtime
    modified.pop(policy.resolve(), None)
    newest = sorted(modified, key=modified.__getitem__, reverse=True)[:_MAX_FILES]
    return list(itertools.islice((path for path in newest if _robot_of(path) == robot), MAX_RUNS))


def _candidates(policy: Path) -> Iterator[Path]:
    for pattern in ("*/policy.onnx", "*/*/policy.onnx"):
        yield from RUNS.glob(pattern)
    if policy.resolve().parent not in {folder.resolve() for folder in SEARCH_PATHS}:
        yield from policy.parent.glob("*.onnx")
        yield from policy.parent.parent.glob("*/policy.onnx")


def _robot_of(path: Path) -> str:
    """Return the name of the robot of a policy's file; empty for a file that is none."""
    try:
        return _read_robot(path, path.stat().st_mtime_ns)
    except OSError:
        return ""


@functools.lru_cache(maxsize=1024)
def _read_robot(path: Path, _modified: int) -> str:
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    try:
        return Contract.from_json(check_digest(data).contract.decode()).robot
    except (SurefootError, UnicodeDecodeError, RecursionError, OverflowError):
        return ""
