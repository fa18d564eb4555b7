"""Detection of xacro files, which are templates of URDFs, and instructions to expand one without ROS."""

from __future__ import annotations

import re
import shlex
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from surefoot.errors import SurefootError, choices
from surefoot.files import CONFIGURATION_BYTES, read_configuration

_FIND = re.compile(r"(\$\(find(?:-pkg-share)?\s+([\w.-]+)\s*\))/?([^\s\"'<>$]*)")
"""Reference to a ROS package: the reference itself, the package name, and the path in the package."""
_INCLUDE = re.compile(r"<xacro:include\s[^>]*?filename\s*=\s*[\"']([^\"']+)[\"']")
_SUBSTITUTION = re.compile(r"\$\{[^}]*\}|\$\([a-z-]+\s[^)]*\)")
_FOLDERS = ("urdf", "xacro", "robots", "robot")
"""Usual folders of robot descriptions in a ROS package."""
_MAX_FILES = 100
"""Maximum number of included files that are read."""
_LEVELS = 6
"""Number of parent folders of a file in which packages are searched."""


def is_xacro(root: ElementTree.Element) -> bool:
    """Return whether a description is a xacro template: it has xacro elements, or attributes with expressions.

    A file that only mentions xacro in a comment, its name or a namespace is not a template.
    """
    for element in root.iter():
        if isinstance(element.tag, str) and "xacro" in element.tag.partition("}")[0] and element.tag[:1] == "{":
            return True
        if any(_SUBSTITUTION.search(value) for value in element.attrib.values()):
            return True
    return False


def explain_xacro(path: Path) -> SurefootError:
    """Return the error for a xacro, with the packages to install and the command to expand it."""
    start = f"{path}: is a xacro, which is a template"
    files, missing = _included_files(path)
    matches = [match for text in files.values() for match in _FIND.finditer(text)]
    finds = {match[1]: match[2] for match in matches}
    folders: dict[str, Path | None] = {}
    for match in matches:
        folders[match[2]] = folders.get(match[2]) or _find_package(match[2], path, match[3])
    expand = f"`xacro {shlex.quote(path.name)} > robot.urdf`, and give robot.urdf"
    if absent := [name for name, folder in folders.items() if folder is None]:
        return SurefootError(
            f"{start} and needs the package {choices(absent)}, which is not next to it; put its folder there, "
            f"pip install xacro, replace $(find {absent[0]}) by the path of that folder, run {expand}"
        )
    if missing:
        return SurefootError(f"{start} and includes {choices(missing)}, which is not there; put it where it is named")
    if not finds:
        return SurefootError(f"{start}; in its folder: pip install xacro, then {expand}")
    edits = " ".join(f"-e {shlex.quote(f's|{text}|{folders[name]}|g')}" for text, name in finds.items())
    names = " ".join(shlex.quote(str(file)) for file, text in files.items() if _FIND.search(text))
    places = choices(f"{name} is {folder}" for name, folder in folders.items())
    return SurefootError(
        f"{start}; without ROS, in its folder: pip install xacro, replace $(find ...) by the packages' folders "
        f"({places}): `sed -i.bak {edits} {names}`, then {expand}"
    )


def _included_files(path: Path) -> tuple[dict[Path, str], list[str]]:
    """Return the texts of a xacro and its included files by path, and the names of missing files."""
    texts: dict[Path, str] = {}
    missing: dict[str, None] = {}
    waiting = [path.resolve()]
    while waiting and len(texts) < _MAX_FILES:
        file = waiting.pop()
        if file in texts:
            continue
        try:
            if file.stat().st_size > CONFIGURATION_BYTES:
                continue
            texts[file] = read_configuration(file).decode("utf-8", errors="replace")
        except OSError:
            missing[file.name] = None
            continue
        for name in _INCLUDE.findall(texts[file]):
            start = _FIND.match(name)
            folder = _find_package(start[2], path, start[3]) if start else file.parent
            inside = start[3] if start else name
            if folder is not None and not _SUBSTITUTION.search(inside):
                waiting.append((folder / inside).resolve())
    return texts, list(missing)


def _find_package(name: str, path: Path, inside: str) -> Path | None:
    """Find the folder of a ROS package near a file, by the folder's name or its package.xml.

    The parent of a folder such as `urdf` or `xacro` counts as the package, whatever its name, if it contains the path
    `inside`.
    """
    above = list(path.resolve().parents)[:_LEVELS]
    for folder in above:
        for place in (folder, folder / name):
            if place.is_dir() and (place.name == name or _declares(place, name)):
                return place
    if len(above) > 1 and above[0].name in _FOLDERS and inside and (above[1] / inside).exists():
        return above[1]
    return None


def _declares(folder: Path, name: str) -> bool:
    """Return whether a folder has a package.xml with that package name."""
    file = folder / "package.xml"
    try:
        return file.is_file() and f"<name>{name}</name>" in re.sub(r"\s", "", read_configuration(file).decode("utf-8"))
    except (OSError, ValueError, SurefootError):
        return False
