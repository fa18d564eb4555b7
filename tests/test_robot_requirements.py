"""Packages on the robot's computer match `robot-requirements.txt`: version, licence and files."""

from __future__ import annotations

import base64
import csv
import hashlib
import platform
import re
import sys
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.utils import canonicalize_name
from test_install import BARE, ROOT, needed, pins

LINE = re.compile(
    r"(?P<name>\S+)==(?P<version>\S+)(?P<hashes>(?: --hash=sha256:[0-9a-f]{64})+)  # (?P<licence>.+); (?P<files>.+)"
)
DDS = "tensor-ipc-cyclonedds"
IS_TESTED_PLATFORM = sys.version_info[:2] == (3, 11) and (sys.platform, platform.machine()) == ("linux", "x86_64")
FREE = re.compile(r"MIT|BSD|Apache|PSF|EPL-2\.0|Zlib", re.IGNORECASE)


class Entry(NamedTuple):
    """Line of the file."""

    version: str
    licence: str
    files: str


def entries() -> dict[str, Entry]:
    lines = (ROOT / "robot-requirements.txt").read_text(encoding="utf-8").splitlines()
    matches = [LINE.fullmatch(line) or pytest.fail(line) for line in lines if not line.startswith("#")]
    return {match["name"]: Entry(match["version"], match["licence"], match["files"]) for match in matches}


def licence_of(name: str) -> str:
    about = metadata.metadata(name)
    text = about.get("License-Expression") or about.get("License") or ""
    if text and "\n" not in text:
        return text
    # Some packages put the whole text here; the name is in the classifiers, or in the first line.
    named = [line.split(" :: ")[-1] for line in about.get_all("Classifier") or [] if line.startswith("License")]
    return named[0] if named else text.splitlines()[0]


def recorded(name: str) -> list[tuple[str, str]]:
    """Return name and hash of each file installed by a wheel, without files added by pip and Python."""
    text = metadata.distribution(name).read_text("RECORD") or ""
    added = ("INSTALLER", "REQUESTED", "direct_url.json")
    return sorted(
        (path, digest)
        for path, digest, _ in csv.reader(text.splitlines())
        if digest and not path.startswith("..") and not path.endswith(".pyc") and Path(path).name not in added
    )


def files_digest(files: list[tuple[str, str]]) -> str:
    """Return the start of the SHA-256 of lines with names and hashes."""
    return hashlib.sha256("\n".join(f"{path} {digest}" for path, digest in files).encode()).hexdigest()[:32]


def test_the_list_contains_the_bare_install_and_the_go2_link_in_pinned_versions():
    listed = entries()
    assert set(listed) == {*map(canonicalize_name, needed(BARE)), DDS}
    assert {name: entry.version for name, entry in listed.items()} == {name: pins()[name] for name in listed}


@pytest.mark.parametrize("name", entries())
def test_an_installed_package_matches_the_list(name: str):
    try:
        found = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        assert name == DDS, "only the link to a Go2 may be missing"
        pytest.skip(f"{name} is not installed")
    entry = entries()[name]
    assert (found.version, licence_of(name)) == (entry.version, entry.licence)
    assert FREE.search(entry.licence)
    assert "GPL" not in entry.licence
    if entry.files == "source" or not IS_TESTED_PLATFORM:
        return  # compiled here, or another wheel
    files = recorded(name)
    assert f"files {files_digest(files)}" == entry.files
    for path, digest in files:
        kind, _, value = digest.partition("=")
        content = Path(str(found.locate_file(path))).read_bytes()
        assert base64.urlsafe_b64encode(hashlib.new(kind, content).digest()).rstrip(b"=").decode() == value, path


def test_a_file_that_differs_changes_the_digest():
    files = recorded("rich")
    assert files_digest(files) != files_digest([(files[0][0], "sha256=other"), *files[1:]])


def test_republished_packages_are_described_with_their_dependents():
    page = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
    (row,) = [line for line in page.splitlines() if line.startswith(f"| `{DDS}` {entries()[DDS].version} ")]
    assert "every motor command" in row
    assert "When `cyclonedds` has wheels of 0.10 for your Python:" in page
