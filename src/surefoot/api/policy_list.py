"""List of policies that a page offers for a robot: the user's runs, newest first, and released policies."""

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
"""Default parent folder of the run folders of `surefoot train`."""
MAX_RUNS = 30
"""Maximum number of policies of the user's runs in a list."""
_MAX_FILES = 200
"""Maximum number of (newest) policy files that are read for a list."""


class PolicyEntry(NamedTuple):
    """A policy in the list."""

    name: str
    """Name or path, for `find_policy`."""
    label: str
    """Short name for display."""
    group: str
    """Heading in the list."""


def list_policies(policy: str, robot: str) -> list[PolicyEntry]:
    """Return the given policy, then policies of the user's runs, then released policies, all for one robot (by name).

    The user's runs are searched in `RUNS`, and next to the given policy.
    """
    file = find_policy(policy)
    released = [
        name
        for name, path in sorted(released_policies().items())
        if name == policy or (_robot_of(path) == robot and path.resolve() != file.resolve())
    ]
    first = [] if policy in released else [PolicyEntry(policy, run_label(file), "selected")]
    runs = [PolicyEntry(str(path), run_label(path), "your runs, newest first") for path in _run_policies(file, robot)]
    return [*first, *runs, *(PolicyEntry(name, name, "released with surefoot") for name in released)]


def run_label(path: Path) -> str:
    """Return a short name of a policy file: its run folder, or folder and file name."""
    path = path.resolve()
    parts = path.parent.parts if path.stem == "policy" else (*path.parent.parts, path.stem)
    return "/".join(parts[-2:])


def _run_policies(policy: Path, robot: str) -> list[Path]:
    """Return policy files for a robot, newest first, without the given one."""
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
    """Return the robot's name in a policy file; empty if the file is not a policy."""
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
