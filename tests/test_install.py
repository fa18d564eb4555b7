"""Dependencies: the bare install is suitable for the robot's computer, and every version is pinned."""

from __future__ import annotations

import re
import subprocess
import tomllib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
BARE = [Requirement(line) for line in PROJECT["dependencies"]]
EXTRAS = {extra: [Requirement(line) for line in lines] for extra, lines in PROJECT["optional-dependencies"].items()}
DIRECT = [r for r in [*BARE, *(r for lines in EXTRAS.values() for r in lines)] if r.name != PROJECT["name"]]

NOT_ON_THE_ROBOT = {"torch", "mujoco", "mujoco-core", "numba", "gymnasium", "rsl-rl-lib", "pybullet", "scipy", "pandas"}
LEFT_TO_TORCH = ("nvidia-", "cuda-", "triton", "pytorch-triton")  # dependencies of a GPU build of torch
LARGEST_FILE = 5_000_000  # bytes


def pins() -> dict[str, str]:
    """Return the version of each distribution pinned in constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pinned}


def needed(roots: Iterable[Requirement]) -> dict[str, bool]:
    """Return all direct and indirect distributions of requirements, and whether each is installed."""
    todo = list(roots)
    seen: set[tuple[str, frozenset[str]]] = set()
    importable: dict[str, bool] = {}
    while todo:
        requirement = todo.pop()
        name, extras = canonicalize_name(requirement.name), frozenset(requirement.extras)
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            lines = requires(name) or []
        except PackageNotFoundError:
            importable[name] = False
            continue
        importable[name] = True
        for further in map(Requirement, lines):
            marker = further.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras)):
                todo.append(further)
    return importable


def test_the_bare_install_includes_neither_simulation_nor_learning():
    importable = needed(BARE)
    assert all(importable.values()), f"not installed: {[name for name, here in importable.items() if not here]}"
    assert not NOT_ON_THE_ROBOT & set(importable)
    assert not [name for name in importable if name.startswith(LEFT_TO_TORCH)]


def test_the_sim_extra_does_not_include_learning():
    assert "torch" not in needed(EXTRAS["sim"])


@pytest.mark.parametrize("requirement", DIRECT, ids=str)
def test_a_direct_dependency_is_pinned_within_its_bounds(requirement: Requirement):
    version = pins().get(canonicalize_name(requirement.name))
    assert version is not None, f"{requirement.name} is not in constraints.txt"
    assert requirement.specifier.contains(version, prereleases=True)


def test_an_indirect_dependency_is_pinned():
    indirect = {name for name in needed(DIRECT) if not name.startswith(LEFT_TO_TORCH)}
    assert not indirect - set(pins())


def test_torch_is_at_one_version_everywhere():
    (torch,) = [r for r in EXTRAS["train"] if r.name == "torch"]
    assert str(torch.specifier) == "==2.13.0"
    assert pins()["torch"] == "2.13.0"


def test_constraints_name_public_versions_only():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = [line for line in lines if not line.startswith("#")]
    odd = [line for line in pinned if not re.fullmatch(r"[a-z0-9][a-z0-9-]*==[0-9][a-z0-9.]*", line)]
    assert not odd, "a pin is name==version: no path, host, marker or local version"
    assert all(Version(line.split("==")[1]).local is None for line in pinned)


def test_tracked_files_are_small():
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    files = [ROOT / name for name in done.stdout.split("\0") if name]
    sizes = {str(file.relative_to(ROOT)): file.stat().st_size for file in files if file.is_file()}
    assert not {name: size for name, size in sizes.items() if size > LARGEST_FILE}
